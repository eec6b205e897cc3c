"""The compiled form of an algorithm's `learn`."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from lemniscate.maths import means
from lemniscate.optim.adam import Adam
from lemniscate.optim.compiled import Compiled
from lemniscate.types import Metrics

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
    """

    def __init__(self, learn: Learn, optimizers: Sequence[Adam]) -> None:
        self._learn = learn
        self._optimizers = optimizers
        self._module = _Networks(learn, [optimizer.module for optimizer in optimizers])
        self._programs: dict[Any, Compiled[..., Metrics]] = {}

    def __call__(self, config: Any, state: Any, data: Any, *by_step: Tensor, **flags: Any) -> list[Metrics]:
        """The metrics of `learn`, averaged over the gradient steps of each compiled call."""
        most = 1 if self._optimizers[0].over_shards else STEPS_PER_CALL
        size = next(n for n in range(most, 0, -1) if len(by_step[0]) % n == 0)
        metrics = []
        for i, chunk in enumerate(zip(*(tensor.split(size) for tensor in by_step), strict=True)):
            part = slice(size * i, size * (i + 1))
            here = {name: flag[part] if isinstance(flag, tuple) else flag for name, flag in flags.items()}
            key = tuple(here.values())
            if key not in self._programs:
                device = self._optimizers[0].vector.device
                self._programs[key] = Compiled(self._functional, device, fallback=self._eager)
            metrics.append(self._programs[key](config, state, data, *chunk, **here))
        return metrics

    def _eager(self, *args: Any, **flags: Any) -> Metrics:
        return means(self._learn(*args, **flags))

    def _functional(self, *args: Any, **flags: Any) -> Metrics:
        """`learn`, while every network that an optimizer moves is made of views of that optimizer's vector."""
        owned = enumerate(optimizer.views() for optimizer in self._optimizers)
        views = {f"modules_of.{i}.{name}": view for i, parameters in owned for name, view in parameters.items()}
        with torch.no_grad():  # of networks that only take part in a loss; `grad_and_value` differentiates all the same
            return means(functional_call(self._module, views, args, flags))


class _Networks(nn.Module):
    """`learn` as a module, so that `functional_call` can replace the parameters of all networks at once."""

    def __init__(self, learn: Learn, modules: list[nn.Module]) -> None:
        super().__init__()
        self.modules_of = nn.ModuleList(modules)
        self._learn = learn

    def forward(self, *args: Any, **flags: Any) -> list[Metrics]:
        return self._learn(*args, **flags)
