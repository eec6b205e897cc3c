"""Gradients over several shards: that of each alone, and their mean in the order of the shards."""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from lemniscate.maths import Shards, at_most_8
from lemniscate.optim.adam import Adam, LossFunction
from lemniscate.optim.compiled import Compiled
from lemniscate.types import Metrics, Record


class GradientOverShards:
    """`Adam.gradient` over all shards of a world.

    Each shard's gradient is computed of that shard's rows alone, in the same shapes whichever process does it; then all
    are gathered, with the metrics of the loss, and averaged. So the result is the same for any number of processes.
    """

    def __init__(self, optimizer: Adam, shards: Shards) -> None:
        self._optimizer, self._shards = optimizer, shards
        self._names: dict[Any, list[str]] = {}
        self._programs: dict[Any, Compiled[..., Tensor]] | None = None

    def compile(self) -> None:
        """Compile the gradient of each loss, and the step that follows it, from the next call on."""
        self._programs = {}
        optimizer, device = self._optimizer, self._optimizer.vector.device
        vars(optimizer)["descend"] = Compiled(optimizer.descend, device)

    def __call__(self, loss: LossFunction, *args: Any) -> tuple[Tensor, Metrics]:
        """The mean of the shards' gradients [P], and of their metrics."""
        held, function = len(self._shards.held), getattr(loss, "func", loss)  # without what is bound to it
        if function not in self._names:
            with torch.no_grad():
                self._names[function] = list(self._optimizer.module(loss, *next(_parts(args, held)))[1])
        at_once = at_most_8(held)
        rows = self._rows if self._programs is None else self._program(function)
        mean = self._shards.gather(torch.cat([rows(at_once, loss, *part) for part in _parts(args, held // at_once)]))
        size, mean = len(self._optimizer.vector), mean.mean(0)
        return mean[:size], dict(zip(self._names[function], mean[size:], strict=True))

    def _rows(self, count: int, loss: LossFunction, *args: Any) -> Tensor:
        """The gradient of each of so many shards, and after it the metrics, [count, P + m]."""
        rows = []
        for part in _parts(args, count):
            gradient, metrics = self._optimizer.gradient(loss, *part)
            rows.append(torch.cat([gradient, *(value.detach().reshape(1).to(gradient) for value in metrics.values())]))
        return torch.stack(rows)

    def _program(self, function: Any) -> Compiled[..., Tensor]:
        assert self._programs is not None
        if function not in self._programs:
            self._programs[function] = Compiled(self._functional, self._optimizer.vector.device, fallback=self._rows)
        return self._programs[function]

    def _functional(self, count: int, loss: LossFunction, *args: Any) -> Tensor:
        with torch.no_grad():  # of networks that only take part in a loss; `grad_and_value` differentiates all the same
            return self._rows(count, loss, *args)


def _parts(args: Sequence[Any], count: int) -> Iterator[tuple[Any, ...]]:
    """The arguments with each of `count` equal parts of their rows."""
    return zip(*(_split(arg, count) for arg in args), strict=True)


def _split(arg: Any, held: int) -> list[Any]:
    """The equal parts of rows; what has no rows is every shard's."""
    if isinstance(arg, Record):
        size = len(next(iter(vars(arg).values()))) // held
        return [arg[size * i : size * (i + 1)] for i in range(held)]
    return list(arg.chunk(held)) if isinstance(arg, Tensor) and arg.ndim else [arg] * held
