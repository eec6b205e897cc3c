"""Functions of tensors as one compiled call each."""

import sys
from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any, Generic, ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


class Native(Generic[P, R]):
    """`function`, compiled at its first call; every later call must have arguments of the same shapes.

    Nothing is checked at a call but what the function itself needs: for small networks the checks would cost as much
    as the work. Where no compiler works, says so and goes on with `otherwise`.
    """

    def __init__(self, function: Callable[P, R], otherwise: Callable[P, R], device: torch.device) -> None:
        options: dict[str, Any] = {"guard_filter_fn": torch.compiler.skip_all_guards_unsafe}
        if device.type == "cpu":
            options["cpp_wrapper"] = True
        self._compiled = torch.compile(_own(function), fullgraph=True, dynamic=False, options=options)
        self._otherwise = otherwise
        self._chosen: Callable[P, R] | None = None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """As `function`."""
        return self._chosen(*args, **kwargs) if self._chosen else self._first(*args, **kwargs)

    def _first(self, *args: P.args, **kwargs: P.kwargs) -> R:
        self._chosen = self._compiled
        try:
            return self._compiled(*args, **kwargs)
        except RuntimeError as error:
            reason = str(error).strip().partition("\n")[0]
            print(f"Nothing can be compiled here ({reason}); going on without.", file=sys.stderr)
            self._chosen = self._otherwise
            return self._otherwise(*args, **kwargs)


def _own(method: Callable[P, R]) -> Callable[P, R]:
    """The same method with code of its own: programs are kept by code, and without checks the wrong one would serve."""
    assert isinstance(method, MethodType)
    function = method.__func__
    copied = FunctionType(function.__code__.replace(), function.__globals__, function.__name__)
    return MethodType(copied, method.__self__)
