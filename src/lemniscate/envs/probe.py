"""The axes along which margins are measured: one thing that may be other than it is nominally, and its values."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import Tensor

from lemniscate.spec import Spec

Value = float | str


@dataclass(frozen=True)
class Axis:
    """One thing that may be other than it is nominally, and the values that are flown.

    Attributes:
        name: of the argument of the environment, or of what stands between policy and environment.
        values: in ascending order, the nominal one among them; words where they have no order.
        nominal: the value of the environment as it is.
        unit: of the values; a factor where it is empty.
        title: in tables and pictures.
        phrase: in sentences, with the value in the place of the braces.
        shown: the unit that people read, and how many of it are one of `unit`.
    """

    name: str
    values: tuple[Value, ...]
    nominal: Value
    unit: str
    title: str
    phrase: str
    shown: tuple[str, float] = ("", 1.0)

    def number(self, value: Value) -> float:
        """A value in the unit that people read; of a factor its deviation, in percent."""
        assert not isinstance(value, str)
        return 100 * (value - 1) if self.is_factor else value * self.shown[1]

    @property
    def is_factor(self) -> bool:
        """The values are factors of what is nominal."""
        return not self.unit

    @property
    def shown_unit(self) -> str:
        """The unit of `number`."""
        return "%" if self.is_factor else self.shown[0]

    def text(self, value: Value) -> str:
        """A value in words: 24 ms, 15 % more, so_rpy."""
        if isinstance(value, str):
            return value
        number, unit = self.number(value), f" {self.shown_unit}" if self.shown_unit else ""
        if self.is_factor:
            return f"{abs(number):.4g} % {'more' if number > 0 else 'less'}" if number else "nominal"
        text = f"{number:.4g}{unit}".replace("-", "−")
        return "1 step" if text == "1 steps" else text

    def around(self, nominal: float) -> "Axis":
        """The same axis about another nominal value."""
        return replace(self, values=tuple(sorted({*self.values, nominal})), nominal=nominal)


PERCENT = ("%", 100.0)
"""how shares are shown"""

CHANNEL_AXES = (
    Axis("action_delay", (0, 1, 2, 3, 4, 6, 8), 0, "steps", "action delay", "{} of action delay", ("steps", 1)),
    Axis("observation_noise", (0, 0.05, 0.1, 0.2, 0.5, 1), 0, "std", "observation noise", "{} of noise", ("std", 1)),
    Axis("lost_actions", (0, 0.01, 0.05, 0.1, 0.2, 0.5), 0, "1", "lost actions", "{} of the actions lost", PERCENT),
)
"""of every environment; std is the standard deviation of each number of the observations in nominal episodes"""

MODEL_AXES = (
    Axis("mass", (0.7, 0.85, 0.95, 1, 1.05, 1.15, 1.3), 1, "", "mass", "{} mass"),
    Axis("friction", (0.5, 0.7, 0.9, 1, 1.1, 1.3, 1.5), 1, "", "friction", "{} friction"),
)
"""of MuJoCo's models"""


@dataclass(frozen=True)
class Flown:
    """The episodes of a point of an axis, one from each start; E of them.

    Attributes:
        returns: [E].
        terminated: [E], the episodes that ended by the environment's rules.
        actions: [T, A] in [-1, 1] of each episode, as long as it lasted, where they were asked for; else None.
    """

    returns: Tensor
    terminated: Tensor
    actions: list[Tensor] | None = field(default=None, compare=False)


Act = Callable[[Tensor], Tensor]
"""flat observations [N, O] to actions [N, …] as `VecEnv.step` takes them"""
Begin = Callable[[], Act]
"""a policy at the beginning of N episodes, which remembers nothing yet"""


class Probe(Protocol):
    """An environment that can be flown along axes, from the same E starts at each point.

    Attributes:
        spec: of the environment.
        axes: along which it can be flown.
        period: seconds between two actions, where they are known.
        ends_by_failure: an episode that terminates has failed.
    """

    spec: Spec
    axes: tuple[Axis, ...]
    period: float | None
    ends_by_failure: bool

    def fly(self, begin: Begin, seed: int) -> tuple[Flown, Mapping[str, list[Flown]]]:
        """The nominal episodes; then those at each value of each axis, by its name. The nominal value repeats them."""
        ...


class Tally:
    """Returns and ends of N episodes, step by step; what follows the first end of each does not count."""

    def __init__(self, num_envs: int) -> None:
        self.returns = torch.zeros(num_envs, dtype=torch.float64)
        self.terminated = torch.zeros(num_envs, dtype=torch.bool)
        self.going = torch.ones(num_envs, dtype=torch.bool)
        """[N], the episodes that have not ended"""

    def add(self, reward: Tensor, terminated: Tensor, truncated: Tensor) -> None:
        """One step of every environment, [N] each."""
        self.returns += torch.where(self.going, reward.double(), 0.0)
        self.terminated |= terminated & self.going
        self.going &= ~(terminated | truncated)
