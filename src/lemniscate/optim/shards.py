"""The work of several shards: gradients and estimates of each shard's rows alone, shared among processes.

A batch [B, …] is S = `World.shards` equal parts of its rows. Whichever process computes a part, it does so in one call
of the same shapes; the results of all parts are gathered in their order, and every process goes on with all of them. So
a run gives the same bits on any number of processes that divides S.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from lemniscate.optim.adam import Adam, LossFunction
from lemniscate.optim.compiled import Compiled, Compiler
from lemniscate.system.world import World
from lemniscate.types import Metrics, Record


class GradientOverShards:
    """The gradient of an optimizer's loss as the mean over all shards, with the means of the metrics.

    Args:
        optimizer: whose `gradient` is taken of each shard.
        world: the processes that share the shards.
        compiler: of the run, to compile the gradient of a shard, once for each loss function, and the descent; or None.
    """

    def __init__(self, optimizer: Adam, world: World, compiler: Compiler | None) -> None:
        self._optimizer, self._world, self._compiler = optimizer, world, compiler
        self._programs: dict[Any, Callable[..., tuple[Tensor, Metrics]]] = {}
        if compiler:
            vars(optimizer)["descend"] = Compiled(optimizer.descend, optimizer.vector.device, compiler)

    def __call__(self, loss: LossFunction, *args: Any) -> tuple[Tensor, Metrics]:
        """The mean gradient [P] of `loss(networks, *args)` over the shards, and of its metrics."""
        gradient, rows, metrics = self._program(loss), [], {}
        for part in zip(*(self._parts_held(arg) for arg in args), strict=True):
            one, metrics = gradient(loss, *part)
            rows.append(torch.cat([one, *(value.detach().reshape(1).to(one) for value in metrics.values())]))
        mean, size = self._world.gather(torch.stack(rows)).mean(0), len(self._optimizer.vector)
        return mean[:size], dict(zip(metrics, mean[size:], strict=True))

    def _program(self, loss: LossFunction) -> Callable[..., tuple[Tensor, Metrics]]:
        """The gradient, or its compiled form for this loss function, which may be a `partial` of one."""
        if not self._compiler:
            return self._optimizer.gradient
        function = getattr(loss, "func", loss)
        if function not in self._programs:
            device = self._optimizer.vector.device
            self._programs[function] = Compiled(self._optimizer.gradient, device, self._compiler)
        return self._programs[function]

    def _parts_held(self, arg: Any) -> Sequence[Any]:
        """The rows of an argument in the shards held here; what has no rows is every shard's."""
        shards, held = self._world.shards, self._world.held
        if isinstance(arg, Record):
            size = len(next(iter(vars(arg).values()))) // shards
            return [arg[size * i : size * (i + 1)] for i in held]
        return arg.chunk(shards)[held.start : held.stop] if isinstance(arg, Tensor) and arg.ndim else [arg] * len(held)


def estimates_over_shards(function: Callable[..., Sequence[Tensor]], world: World) -> Callable[..., list[Tensor]]:
    """A function of tensors [T, N, …] to tensors [T, N], computed of an equal part of the N for each shard."""
    shards, held = world.shards, world.held

    def estimates(*rows: Tensor) -> list[Tensor]:
        parts = zip(*(x.chunk(shards, 1)[held.start : held.stop] for x in rows), strict=True)
        columns = zip(*(function(*(x.contiguous() for x in part)) for part in parts), strict=True)
        return [torch.cat(list(world.gather(torch.stack(column))), dim=1) for column in columns]

    return estimates
