"""The description of an environment that a policy needs: its observations, its actions, its time limit."""

import math
from dataclasses import dataclass, field
from functools import cached_property

from lemniscate.errors import UserError


@dataclass(frozen=True)
class Box:
    """Continuous actions. A policy acts in [-1, 1]^A; the backend maps that onto [low, high].

    Where a bound is infinite the unit stays what it is: see `envs.conversion.scale_action`.
    `shape` is how the environment wants the A coordinates, if not in a row, and `dtype` in which numbers; whole ones
    are rounded to.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    shape: tuple[int, ...] | None = None
    dtype: str = "float32"

    mask_size = 0

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
    """One of n actions. A policy chooses 0 … n-1; the backend adds `start`, and gives them as `dtype`.

    With `masked`, the environment says at each step which of them are valid, and the observation ends in that mask:
    n numbers, 1 or 0.
    """

    n: int
    start: int = 0
    masked: bool = False
    dtype: str = field(default="int64", compare=False)

    @property
    def mask_size(self) -> int:
        """The length of the mask behind the observation."""
        return self.n if self.masked else 0


@dataclass(frozen=True)
class MultiDiscrete:
    """One of n_k actions for each of K components; the backend adds `start`.

    With `masked`, the observation ends in the masks of all components, Σ n_k numbers: see `Discrete`.
    """

    nvec: tuple[int, ...]
    start: tuple[int, ...]
    shape: tuple[int, ...] | None = None
    masked: bool = False
    dtype: str = field(default="int64", compare=False)

    @property
    def mask_size(self) -> int:
        """The length of the masks behind the observation."""
        return sum(self.nvec) if self.masked else 0


@dataclass(frozen=True)
class MultiBinary:
    """n binary components, each 1 or 0."""

    n: int
    shape: tuple[int, ...] | None = None

    mask_size = 0


Action = Box | Discrete | MultiDiscrete | MultiBinary


def action_shape(action: Action) -> tuple[int, ...]:
    """The shape of one action of a policy: (A,) of a Box, () of a Discrete, (K,) of a MultiDiscrete, else (n,)."""
    if isinstance(action, Discrete):
        return ()
    if isinstance(action, MultiDiscrete):
        return (len(action.nvec),)
    return (action.size if isinstance(action, Box) else action.n,)


@dataclass(frozen=True)
class ObservationPart:
    """A piece of the flat observation: where it is in the environment's own, and its shape there.

    `path` leads through Dict keys and Tuple indices; it is empty where the observation is the piece itself. With
    `nvec`, each number of the piece becomes a one-hot vector, counted from `start`. With `axes`, the environment's own
    array has the shape `own_shape`, and its axes are put in that order to get `shape`: an image with its channels
    first, or a stack of images. With `image`, it is a picture of bytes, height × width × channels.
    """

    path: tuple[str | int, ...]
    shape: tuple[int, ...]
    nvec: tuple[int, ...] = ()
    start: tuple[int, ...] = ()
    own_shape: tuple[int, ...] = ()
    axes: tuple[int, ...] = ()
    image: bool = False

    @property
    def name(self) -> str:
        """The path as one word."""
        return "/".join(map(str, self.path)) or "obs"

    @cached_property
    def size(self) -> int:
        """The number of its values in the flat observation."""
        return sum(self.nvec) if self.nvec else math.prod(self.shape)


@dataclass(frozen=True)
class Spec:
    """The description of an environment that a policy needs; saved with every checkpoint.

    `observation_parts` are the parts of the flat observation in their order; their sizes sum to O. Where all of them
    are images the observation stays bytes; else it is float32. `max_episode_steps` is the time limit.
    In training, P = `privileged` numbers follow the observation: what a simulator knows and a vehicle does not. Critics
    see them and policies do not (Pinto et al. 2018, arXiv:1710.06542), so a policy acts without them.
    """

    env_id: str
    observation_parts: tuple[ObservationPart, ...]
    action: Action
    max_episode_steps: int | None = None
    privileged: int = 0

    def fits(self, other: "Spec") -> bool:
        """Whether a policy for one environment can act in the other."""
        mine, its = self.action, other.action
        same_action = mine.same_as(its) if isinstance(mine, Box) else mine == its
        return same_action and self.observation_parts == other.observation_parts

    @cached_property
    def image(self) -> bool:
        """Whether observations are images alone, and stay bytes."""
        return self.has_images and all(part.image for part in self.observation_parts)

    @property
    def has_images(self) -> bool:
        """Whether a part of the observation is an image."""
        return any(part.image for part in self.observation_parts)

    def bounded_box(self) -> Box:
        """The actions. Raises `UserError` unless they are numbers between finite bounds."""
        if not isinstance(self.action, Box):
            kind = type(self.action).__name__
            raise UserError(f"{self.env_id} has {kind} actions; this algorithm needs continuous ones. ppo learns here.")
        if not all(map(math.isfinite, (*self.action.low, *self.action.high))):
            raise UserError(
                f"{self.env_id} has actions without bounds, and this algorithm explores between bounds: give its Box a"
                " finite low and high, of everyday size. ppo learns here."
            )
        return self.action

    @property
    def observation_size(self) -> int:
        """O, the length of the flat observation, without the action mask and without what is privileged."""
        return sum(part.size for part in self.observation_parts)
