"""Data records of tensors. Shapes: T time, N environments, B batch, O observation, A action."""

from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from typing import Self

import torch
from torch import Tensor

Metrics = dict[str, Tensor]
"""scalars by name"""
Loss = tuple[Tensor, Metrics]
"""a scalar to minimize, and its metrics"""
Flags = tuple[bool, ...]
"""a constant for each gradient step, [K]"""


class Schedule(str):
    """The text "FIRST>LAST" of two numbers: from the first at the beginning of a run to the last at its end."""

    def at(self, progress: float) -> float:
        """The number at a progress of 0 to 1 of the run, linear in between; at 1 and beyond it is the last."""
        first, last = map(float, self.split(">"))
        return first + (last - first) * min(1.0, progress)


def wide_float(device: torch.device) -> torch.dtype:
    """The type of sums over a whole run: float64; float32 on mps, which has no float64.

    There, moments lose digits only after some ten million observations.
    """
    return torch.float32 if device.type == "mps" else torch.float64


@dataclass(frozen=True)
class Record:
    """Tensors that share their leading dimensions."""

    def __getitem__(self, rows: Tensor | slice | tuple[slice, slice]) -> Self:
        pick = itemgetter(rows)
        if isinstance(rows, Tensor) and rows.dim() and rows.dtype == torch.int64:
            if rows.dim() > 1:
                return type(self)(*(tensor.unflatten(0, rows.shape) for tensor in vars(self[rows.flatten()]).values()))
            pick = partial(torch.index_select, dim=0, index=rows)  # takes a half to a quarter of the time
        return type(self)(*map(pick, vars(self).values()))

    def flatten(self) -> Self:
        """[T, N, …] to [T · N, …]."""
        return type(self)(*(tensor.flatten(0, 1) for tensor in vars(self).values()))

    def detach(self) -> Self:
        """The same, of which nothing can be differentiated."""
        return type(self)(*(tensor.detach() for tensor in vars(self).values()))

    @classmethod
    def stack(cls, rows: list[Self]) -> Self:
        """Stack records along a new first dimension: T records [N, …] become one [T, N, …]."""
        return cls(*map(torch.stack, zip(*(vars(row).values() for row in rows), strict=True)))


@dataclass(frozen=True)
class Step:
    """The answer of N parallel environments to one action.

    Attributes:
        obs: [N, O], where to act next. It differs from `next_obs` only where an episode ended: there it is the first
            observation of the next episode.
        next_obs: [N, O], the true successor, before any reset.
        reward: [N] float32.
        terminated: [N] bool, the episode ended by its own rules.
        truncated: [N] bool, the episode was cut by a time limit; never together with `terminated`.
        valid: [N] bool, False where the environment ignored the action in order to reset itself. Such a row reaches no
            loss, no replay buffer and no statistic.
        measures: what the environment measures besides the reward, such as `tracking_error` or `is_success`: [N] each,
            by name; NaN in a row that has none. The other numbers in an `info` begin with "info/". Evaluation and the
            lines of metrics have their means; nothing learns from them.
    """

    obs: Tensor
    next_obs: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    valid: Tensor
    measures: dict[str, Tensor] = field(default_factory=dict)

    def detach(self) -> Self:
        """The same, of which nothing can be differentiated."""
        names = ("obs", "next_obs", "reward")
        measures = {name: values.detach() for name, values in self.measures.items()}
        return replace(self, **{name: getattr(self, name).detach() for name in names}, measures=measures)


@dataclass(frozen=True)
class Rollout(Record):
    """T steps of N environments, [T, N, …]. Row t is everything action t caused; no flag is about the past."""

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    terminated: Tensor
    truncated: Tensor
    valid: Tensor

    @property
    def num_rows(self) -> int:
        """T · N."""
        return self.reward.numel()

    @property
    def done(self) -> Tensor:
        """[T, N]: the episode ended here, by its own rules or by a time limit."""
        return self.terminated | self.truncated

    @property
    def valid_rows(self) -> Tensor:
        """The indices [B] of the rows whose action was not ignored, in the flattened rollout."""
        return self.valid.flatten().nonzero()[:, 0]


@dataclass(frozen=True)
class Transition(Record):
    """Steps without their order, [B, …]: the rows of a replay buffer.

    `next_obs` is the true successor; `terminated` is an end by the environment's rules alone, since a time-out does not
    end the value.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    terminated: Tensor


@dataclass(frozen=True)
class Batch(Record):
    """The rows of a rollout with V(s), advantage and value target, [B, …]: the input of on-policy losses."""

    obs: Tensor
    action: Tensor
    value: Tensor
    advantage: Tensor
    target: Tensor


@dataclass(frozen=True)
class DrawnBatch(Batch):
    """A batch with log π_old(a|s), of the policy that drew the actions, [B]: for losses that hold the new one to it."""

    log_prob: Tensor
