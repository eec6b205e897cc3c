"""The records that flow through the house. Shapes: T time, N environments, B batch, O observation, A action."""

import math
from dataclasses import dataclass, fields
from typing import Self

import torch
from torch import Tensor

from lemniscate.errors import UserError


@dataclass(frozen=True)
class Box:
    """Continuous actions. A policy acts in [-1, 1]^A; the environment floor maps that onto [low, high].

    Where a bound is infinite the unit stays what it is: see `envs.spaces.scale_action`.
    `shape` is how the environment wants the A coordinates, if not in a row, and `dtype` in which numbers.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    shape: tuple[int, ...] | None = None
    dtype: str = "float32"

    @property
    def size(self) -> int:
        """A, the number of coordinates."""
        return len(self.low)

    def same_as(self, other: "Action") -> bool:
        """Whether both mean the same, up to the rounding of their bounds."""
        if not isinstance(other, Box) or (self.size, self.shape) != (other.size, other.shape):
            return False
        bounds = zip((*self.low, *self.high), (*other.low, *other.high), strict=True)
        return all(math.isclose(mine, its, rel_tol=1e-6) for mine, its in bounds)


@dataclass(frozen=True)
class Discrete:
    """One of n actions. A policy chooses 0 … n-1; the environment floor adds `start`.

    With `masked`, the environment says at each step which of them are valid, and the observation ends in that mask:
    n numbers, 1 or 0.
    """

    n: int
    start: int = 0
    masked: bool = False


@dataclass(frozen=True)
class MultiDiscrete:
    """One of n_k actions for each of K levers; the environment floor adds `start`."""

    nvec: tuple[int, ...]
    start: tuple[int, ...]
    shape: tuple[int, ...] | None = None


@dataclass(frozen=True)
class MultiBinary:
    """n switches, each on or off."""

    n: int
    shape: tuple[int, ...] | None = None


Action = Box | Discrete | MultiDiscrete | MultiBinary


@dataclass(frozen=True)
class Part:
    """A piece of the flat observation: where it is in the environment's own, and its shape there.

    `path` leads through Dict keys and Tuple indices; it is empty where the observation is the piece itself. With
    `nvec`, each number of the piece becomes a one-hot vector, counted from `start`.
    """

    path: tuple[str | int, ...]
    shape: tuple[int, ...]
    nvec: tuple[int, ...] = ()
    start: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """The path as one word."""
        return "/".join(map(str, self.path)) or "obs"

    @property
    def size(self) -> int:
        """How many numbers it is in the flat observation."""
        return sum(self.nvec) if self.nvec else math.prod(self.shape)


@dataclass(frozen=True)
class Spec:
    """What a policy has to know of an environment; saved with every checkpoint.

    `layout` names the parts of the flat observation in their order; their sizes sum to O. With `image`, the only part
    is an image of bytes, height × width × channels, and stays bytes.
    `time_step` is the control period in seconds, where the environment has one.
    `tracking` is where the tracking error (x, y, z in metres) stands in the observation, as (start, stop).
    """

    env_id: str
    layout: tuple[Part, ...]
    action: Action
    max_episode_steps: int | None = None
    time_step: float | None = None
    tracking: tuple[int, int] | None = None
    image: bool = False

    def fits(self, other: "Spec") -> bool:
        """Whether a policy for one environment can act in the other."""
        mine, its = self.action, other.action
        same_action = mine.same_as(its) if isinstance(mine, Box) else mine == its
        return same_action and (self.layout, self.image) == (other.layout, other.image)

    def bounded_box(self) -> Box:
        """The actions. Raises `UserError` unless they are numbers between finite bounds."""
        if not isinstance(self.action, Box):
            kind = type(self.action).__name__
            raise UserError(f"{self.env_id} has {kind} actions; this algorithm needs continuous ones. ppo learns here.")
        if not all(map(math.isfinite, (*self.action.low, *self.action.high))):
            raise UserError(
                f"{self.env_id} has actions without bounds, and this algorithm explores between bounds: give its Box a"
                " finite low and high. ppo learns here."
            )
        return self.action

    @property
    def observation_size(self) -> int:
        """O, the length of the flat observation, without the action mask."""
        return sum(part.size for part in self.layout)


@dataclass(frozen=True)
class Record:
    """Tensors that share their leading dimensions."""

    def __getitem__(self, rows: Tensor | slice) -> Self:
        return type(self)(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def flatten(self) -> Self:
        """[T, N, …] to [T · N, …]."""
        return type(self)(**{f.name: getattr(self, f.name).flatten(0, 1) for f in fields(self)})

    @classmethod
    def stack(cls, rows: list[Self]) -> Self:
        """Stack records along a new first dimension: T records [N, …] become one [T, N, …]."""
        return cls(**{f.name: torch.stack([getattr(row, f.name) for row in rows]) for f in fields(cls)})


@dataclass(frozen=True)
class Step(Record):
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
class Rollout(Record):
    """T steps of N environments, [T, N, …]. Row t is everything action t caused; no flag speaks about the past."""

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
        """[T, N]: the episode ended here, by its own rules or by the clock."""
        return self.terminated | self.truncated

    @property
    def played(self) -> Tensor:
        """The numbers, in the flattened rollout, of the rows in which an action was taken."""
        return self.valid.flatten().nonzero()[:, 0]


@dataclass(frozen=True)
class Transition(Record):
    """What an action caused, without its when and where, [B, …].

    `next_obs` is the true successor; `terminated` tells an end by the rules alone, since a time-out ends no value.
    """

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    terminated: Tensor


@dataclass(frozen=True)
class Batch(Record):
    """What an on-policy loss looks at, [B, …]: a rollout with its advantages."""

    obs: Tensor
    action: Tensor
    log_prob: Tensor
    value: Tensor
    advantage: Tensor
    target: Tensor

    def __len__(self) -> int:
        return len(self.obs)
