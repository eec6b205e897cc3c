"""The records that flow through the house. Shapes: T time, N environments, B batch, O observation, A action."""

from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor


@dataclass(frozen=True)
class Box:
    """Continuous actions. A policy acts in [-1, 1]^A; the environment floor maps that onto [low, high].

    Where a bound is infinite there is nothing to scale to: that coordinate passes unchanged, clipped to the bounds.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def size(self) -> int:
        """A, the number of coordinates."""
        return len(self.low)


@dataclass(frozen=True)
class Discrete:
    """One of n actions. A policy chooses 0 … n-1; the environment floor adds `start`."""

    n: int
    start: int = 0


@dataclass(frozen=True)
class Spec:
    """What a policy has to know of an environment; saved with every checkpoint.

    `layout` names the parts of the flat observation in their order, with their sizes; their sum is O.
    `time_step` is the control period in seconds, where the environment has one.
    `one_hot_from` is the smallest value of a Discrete observation, which reaches the policy as a one-hot vector.
    `tracking` is where the tracking error (x, y, z in metres) stands in the observation, as (start, stop).
    """

    env_id: str
    layout: tuple[tuple[str, int], ...]
    action: Box | Discrete
    max_episode_steps: int | None = None
    time_step: float | None = None
    one_hot_from: int | None = None
    tracking: tuple[int, int] | None = None

    @property
    def observation_size(self) -> int:
        """O, the length of the flat observation."""
        return sum(size for _, size in self.layout)


@dataclass(frozen=True)
class _Record:
    """Tensors that share their leading dimensions."""

    def __getitem__(self, rows: Tensor | slice) -> Self:
        return type(self)(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    @classmethod
    def stack(cls, rows: list[Self]) -> Self:
        """Stack records along a new first dimension: T records [N, …] become one [T, N, …]."""
        return cls(**{f.name: torch.stack([getattr(row, f.name) for row in rows]) for f in fields(cls)})


@dataclass(frozen=True)
class Step(_Record):
    """What the environments answered to one action, [N, …].

    `next_obs` is the true successor, before any reset; `obs` is where to act next, after it. They differ only where
    an episode ended. `valid` is False where the environment ignored the action (the reset row of NEXT_STEP).
    """

    obs: Tensor
    next_obs: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    valid: Tensor


@dataclass(frozen=True)
class Rollout(_Record):
    """T steps of N environments, [T, N, …]. Row t is everything action t caused; no flag speaks about the past."""

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    terminated: Tensor
    truncated: Tensor
    valid: Tensor

    @property
    def num_steps(self) -> int:
        """T · N."""
        return self.reward.numel()

    @property
    def done(self) -> Tensor:
        """[T, N]: the episode ended here, by its own rules or by the clock."""
        return self.terminated | self.truncated


@dataclass(frozen=True)
class Batch(_Record):
    """What an on-policy loss looks at, [B, …]: the rows of a rollout that were really played."""

    obs: Tensor
    action: Tensor
    log_prob: Tensor
    value: Tensor
    advantage: Tensor
    target: Tensor

    def __len__(self) -> int:
        return len(self.obs)
