"""Compiled calls: methods of tensors, and the gradient steps of an algorithm's `learn`."""

import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from threading import Event
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.func import functional_call

from lemniscate.maths import means
from lemniscate.optim.adam import Adam, Function
from lemniscate.types import Metrics

P = ParamSpec("P")
R = TypeVar("R")


class Compiler:
    """What a run shares with its compiled functions.

    Args:
        busy: entered while a program is compiled, so that the other processes of a run know.
    """

    def __init__(self, busy: Callable[[], AbstractContextManager[None]] = nullcontext) -> None:
        self.busy = busy
        self.stopping = Event()
        """set while a run that was asked to stop ends its update: nothing more is compiled, and a compiler that Ctrl-C
        has reached, too, has not failed"""


class Compiled(Generic[P, R]):
    """A method, compiled at its first call; every later call must have arguments of the same shapes.

    Nothing is checked at a call: for small networks the checks would cost as much as the work. Where `torch.compile`
    fails, a sentence says so (unless the run is stopping) and `fallback` is called instead.
    """

    def __init__(
        self,
        method: Callable[P, R],
        device: torch.device,
        compiler: Compiler,
        fallback: Callable[P, R] | None = None,
    ) -> None:
        options: dict[str, Any] = {"guard_filter_fn": torch.compiler.skip_all_guards_unsafe}
        options["deterministic"] = torch.are_deterministic_algorithms_enabled()
        if device.type == "cpu":
            options["cpp_wrapper"] = True
        self._compiled = torch.compile(_with_own_code(method), fullgraph=True, dynamic=False, options=options)
        self._compiler, self._fallback = compiler, fallback or method
        self._chosen: Callable[P, R] | None = None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """The method's result."""
        return self._chosen(*args, **kwargs) if self._chosen else self._first_call(*args, **kwargs)

    def _first_call(self, *args: P.args, **kwargs: P.kwargs) -> R:
        if not self._compiler.stopping.is_set():
            self._chosen = self._compiled
            try:
                with self._compiler.busy():
                    return self._compiled(*args, **kwargs)
            except RuntimeError as error:
                if not self._compiler.stopping.is_set():
                    reason = str(error).strip().partition("\n")[0]
                    print(f"torch.compile failed ({reason}); continuing without compilation.", file=sys.stderr)
        self._chosen = self._fallback
        return self._fallback(*args, **kwargs)


def _with_own_code(method: Callable[P, R]) -> Callable[P, R]:
    """A call of the method in a code object of its own.

    torch.compile caches programs by code object; with the guards off, a shared one, of a method or of its decorator,
    could return the program of another object's method.
    """

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return method(*args, **kwargs)

    return FunctionType(call.__code__.replace(), call.__globals__, call.__name__, None, call.__closure__)


Learn = Callable[..., list[Metrics]]
"""learn(config, state, data, *by_step, **flags) -> the metrics of each gradient step

data: a record of tensors [B, …]; by_step: tensors [K, …], row k of which is for gradient step k; flags: constants, of
which a tuple has a value for each step.
"""

STEPS_PER_CALL = 4
"""gradient steps in one compiled call, where K is divisible by it; more are hardly faster, and compile longer"""


class Learner:
    """`learn` as compiled calls of up to four gradient steps each.

    Between the steps of one call, `learn` may gather rows and move target networks as well. Every call must have the
    same shapes. Each combination of flags is a program of its own.

    Args:
        learn: the function to compile. It may change the tensors of `state`, and nothing else of it.
        optimizers: all optimizers that it steps.
        compiler: of the run.
    """

    def __init__(self, learn: Learn, optimizers: Sequence[Adam], compiler: Compiler) -> None:
        self._learn, self._optimizers, self._compiler = learn, optimizers, compiler
        self._module = Function(learn, [optimizer.module for optimizer in optimizers])
        self._programs: dict[Any, Compiled[..., Metrics]] = {}

    def __call__(self, config: Any, state: Any, data: Any, *by_step: Tensor, **flags: Any) -> list[Metrics]:
        """The metrics of `learn`, averaged over the gradient steps of each compiled call."""
        size = next(n for n in range(STEPS_PER_CALL, 0, -1) if len(by_step[0]) % n == 0)
        metrics = []
        for i, chunk in enumerate(zip(*(tensor.split(size) for tensor in by_step), strict=True)):
            part = slice(size * i, size * (i + 1))
            here = {name: flag[part] if isinstance(flag, tuple) else flag for name, flag in flags.items()}
            key = tuple(here.values())
            if key not in self._programs:
                device = self._optimizers[0].vector.device
                self._programs[key] = Compiled(self._functional, device, self._compiler, fallback=self._eager)
            metrics.append(self._programs[key](config, state, data, *chunk, **here))
        return metrics

    def rehearse(self, *args: Any, **flags: Any) -> None:
        """`learn` once, without the compiler, while its optimizers move nothing."""
        try:
            for optimizer in self._optimizers:
                vars(optimizer)["descend"] = torch.norm  # it returns ‖g‖, and moves nothing
            self._learn(*args, **flags)
        finally:
            for optimizer in self._optimizers:
                vars(optimizer).pop("descend", None)

    def _eager(self, *args: Any, **flags: Any) -> Metrics:
        return means(self._learn(*args, **flags))

    def _functional(self, *args: Any, **flags: Any) -> Metrics:
        """`learn`, while every network that an optimizer moves is made of views of that optimizer's vector."""
        owned = enumerate(optimizer.views(optimizer.vector) for optimizer in self._optimizers)
        views = {f"networks.{i}.{name}": view for i, parameters in owned for name, view in parameters.items()}
        return means(functional_call(self._module, views, args, flags))
