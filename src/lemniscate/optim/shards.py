"""Gradients over several shards: that of each alone, and their mean in the order of the shards."""

from collections.abc import Iterator, Sequence
from typing import Any
from weakref import WeakValueDictionary

import torch
from torch import Tensor

from lemniscate.maths import Shards
from lemniscate.optim.adam import Adam, LossFunction
from lemniscate.types import Metrics, Record

_SHARDS: WeakValueDictionary[int, Shards] = WeakValueDictionary()
"""by their ids, which compiled programs know"""


@torch.library.custom_op("lemniscate::gather", mutates_args=())
def _gather(mine: Tensor, count: int, shards: int) -> Tensor:
    """`Shards.gather` as one operation of a compiled program, which neither looks into it nor merges it with others."""
    rows = _SHARDS[shards].gather(mine)
    return rows.clone() if rows is mine else rows


@_gather.register_fake
def _(mine: Tensor, count: int, shards: int) -> Tensor:
    return mine.new_empty(count, *mine.shape[1:])


@torch.library.custom_op("lemniscate::after", mutates_args=())
def _after(x: Tensor, before: Tensor) -> Tensor:
    """A copy of a tensor, once `before` is there."""
    return x.clone()


@_after.register_fake
def _(x: Tensor, before: Tensor) -> Tensor:
    return torch.empty_like(x)


class GradientOverShards:
    """`Adam.gradient` over all shards of a world.

    Each shard's gradient is computed of that shard's rows alone, in the same shapes whichever process does it; then all
    are gathered, with the metrics of the loss, and averaged. So the result is the same for any number of processes.
    """

    def __init__(self, optimizer: Adam, shards: Shards) -> None:
        self._optimizer, self._shards, self._key = optimizer, shards, id(shards)
        _SHARDS[self._key] = shards

    def __call__(self, loss: LossFunction, *args: Any) -> tuple[Tensor, Metrics]:
        """The mean of the shards' gradients [P], and of their metrics."""
        compiling, metrics = torch.compiler.is_compiling(), {}
        rows: list[Tensor] = []
        for part in _parts(args, len(self._shards.held)):
            vector = self._optimizer.vector
            if compiling:
                part, vector = _apart(part, vector, rows[-1] if rows else vector)
            gradient, metrics = self._optimizer.gradient(loss, *part, vector=vector)
            rows.append(torch.cat([gradient, *(value.detach().reshape(1).to(gradient) for value in metrics.values())]))
        mine = torch.stack(rows)
        gathered = _gather(mine, self._shards.count, self._key) if compiling else self._shards.gather(mine)
        size, mean = len(self._optimizer.vector), gathered.mean(0)
        return mean[:size], dict(zip(metrics, mean[size:], strict=True))


def _apart(args: Sequence[Any], vector: Tensor, before: Tensor) -> tuple[list[Any], Tensor]:
    """Copies of the arguments and of the parameters, made once `before` is there: those of each type by one operation.

    So a compiler cannot merge the program of a shard with that of another one, and it is the same beside any others.
    """
    several = [list(vars(arg).values()) if isinstance(arg, Record) else [arg] for arg in args]
    tensors = [x for xs in several for x in xs if isinstance(x, Tensor)] + [vector]
    rest = {}
    for dtype in dict.fromkeys(x.dtype for x in tensors):
        same = [x.reshape(-1) for x in tensors if x.dtype == dtype]
        rest[dtype] = iter(_after(torch.cat(same), before).split([len(x) for x in same]))

    def copy(x: Any) -> Any:
        return next(rest[x.dtype]).view(x.shape) if isinstance(x, Tensor) else x

    copied = [arg.map(copy) if isinstance(arg, Record) else copy(arg) for arg in args]
    return copied, copy(vector)


def _parts(args: Sequence[Any], count: int) -> Iterator[tuple[Any, ...]]:
    """The arguments with each of `count` equal parts of their rows."""
    return zip(*(_split(arg, count) for arg in args), strict=True)


def _split(arg: Any, held: int) -> list[Any]:
    """The equal parts of rows; what has no rows is every shard's."""
    if isinstance(arg, Record):
        size = len(next(iter(vars(arg).values()))) // held
        return [arg[size * i : size * (i + 1)] for i in range(held)]
    return list(arg.chunk(held)) if isinstance(arg, Tensor) and arg.ndim else [arg] * held
