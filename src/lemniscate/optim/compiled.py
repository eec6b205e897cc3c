"""Methods of tensors, each compiled into one call."""

import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from threading import Event
from types import FunctionType, MethodType
from typing import Any, Generic, ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


stopping = Event()
"""set while a run that was asked to stop ends its update: nothing more is compiled, and a compiler that Ctrl-C has
reached, too, has not failed"""


around: Callable[[], AbstractContextManager[None]] = nullcontext
"""entered while a program is compiled; several processes of a run let each other know"""


class Compiled(Generic[P, R]):
    """A method, compiled at its first call; every later call must have arguments of the same shapes.

    Nothing is checked at a call: for small networks the checks would cost as much as the work. Where `torch.compile`
    fails, a sentence says so (unless the run is `stopping`) and `fallback` is called instead.
    """

    def __init__(self, method: Callable[P, R], device: torch.device, fallback: Callable[P, R] | None = None) -> None:
        options: dict[str, Any] = {"guard_filter_fn": torch.compiler.skip_all_guards_unsafe}
        options["deterministic"] = torch.are_deterministic_algorithms_enabled()
        if device.type == "cpu":
            options["cpp_wrapper"] = True
        self._compiled = torch.compile(_with_own_code(method), fullgraph=True, dynamic=False, options=options)
        self._fallback = fallback or method
        self._chosen: Callable[P, R] | None = None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """The method's result."""
        return self._chosen(*args, **kwargs) if self._chosen else self._first_call(*args, **kwargs)

    def _first_call(self, *args: P.args, **kwargs: P.kwargs) -> R:
        if not stopping.is_set():
            self._chosen = self._compiled
            try:
                with around():
                    return self._compiled(*args, **kwargs)
            except RuntimeError as error:
                if not stopping.is_set():
                    reason = str(error).strip().partition("\n")[0]
                    print(f"torch.compile failed ({reason}); continuing without compilation.", file=sys.stderr)
        self._chosen = self._fallback
        return self._fallback(*args, **kwargs)


def _with_own_code(method: Callable[P, R]) -> Callable[P, R]:
    """A copy of the method with a code object of its own.

    torch.compile caches programs by code object; with the guards off, a shared one could return the program of another
    object's method.
    """
    assert isinstance(method, MethodType)
    function = method.__func__
    code, names = function.__code__.replace(), function.__globals__
    copied = FunctionType(code, names, function.__name__, function.__defaults__, function.__closure__)
    copied.__kwdefaults__ = function.__kwdefaults__
    return MethodType(copied, method.__self__)
