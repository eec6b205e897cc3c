"""The findings of a pre-flight as numbers: shares that are alive, margins, and the smoothness of actions."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.probe import Axis, Flown, Value

ALIVE = 0.95
"""the share of the episodes that are alive within a margin"""
FAST = 10.0
"""Hz; motors and servos cannot follow faster changes of an action, and a flight does not need them"""
EDGE = 0.999
"""the size of an action from which on it counts as saturated"""


@dataclass(frozen=True)
class Side:
    """One side of an axis.

    Attributes:
        last: the value furthest from the nominal one up to which at least `ALIVE` are alive; None if not even there.
        first: the value after it, at which fewer are; None if no value was tried beyond.
    """

    last: Value | None
    first: Value | None


@dataclass(frozen=True)
class AxisMargins:
    """The episodes along an axis.

    Attributes:
        axis: with its values [V].
        episodes: E, at each value.
        alive: the number of episodes that are alive at each value, [V].
        mean_returns: [V].
    """

    axis: Axis
    episodes: int
    alive: tuple[int, ...]
    mean_returns: tuple[float, ...]

    @cached_property
    def sides(self) -> dict[str, Side]:
        """By "below" and "above", where values were tried there; an axis without an order has none."""
        values, nominal, found = self.axis.values, self.axis.nominal, dict[str, Side]()
        if isinstance(nominal, str):
            return found
        middle = values.index(nominal)
        for name, places in (("below", range(middle, -1, -1)), ("above", range(middle, len(values)))):
            flies = [self.alive[place] >= ALIVE * self.episodes for place in places]
            count = flies.index(False) if False in flies else len(flies)
            outward = [None, *(values[place] for place in places), None]
            if len(places) > 1:
                found[name] = Side(outward[count], outward[count + 1])
        return found

    def lost_at(self, value: Value) -> int:
        """The number of episodes that are not alive at a value."""
        return self.episodes - self.alive[self.axis.values.index(value)]

    def return_at(self, value: Value) -> float:
        """The mean return at a value."""
        return self.mean_returns[self.axis.values.index(value)]

    def within(self) -> list[Value]:
        """The values within the margins; of an axis without an order those at which at least `ALIVE` are alive."""
        values = self.axis.values
        if not self.sides:
            pairs = zip(values, self.alive, strict=True)
            return [value for value, alive in pairs if alive >= ALIVE * self.episodes]
        places = [values.index(side.last) for side in self.sides.values() if side.last is not None]
        if not places:
            return []
        places.append(values.index(self.axis.nominal))
        return list(values[min(places) : max(places) + 1])

    def to_json(self) -> dict[str, Any]:
        """The axis as an object of JSON."""
        nominal: Any = self.axis.nominal
        lasts: dict[str, Any] = {name: side.last for name, side in self.sides.items()}
        margin = {name: None if last is None else float(f"{abs(last - nominal):.10g}") for name, last in lasts.items()}
        return {
            "unit": self.axis.unit or "factor",
            "nominal": nominal,
            "values": list(self.axis.values),
            "alive": [alive / self.episodes for alive in self.alive],
            "mean_return": list(self.mean_returns),
            "margin": margin if self.sides else self.within(),
        }


def worst_accepted(nominal: Flown) -> float:
    """The least return of an episode that is alive, where environments do not say that one has failed.

    It is the return that 95 % of the nominal episodes reach, less a tenth of the size of their mean.
    """
    returns = nominal.returns.numpy()
    return float(np.quantile(returns, 1 - ALIVE, method="lower") - 0.1 * abs(returns.mean()))


def margins_of(axis: Axis, flown: Sequence[Flown], least: float | None) -> AxisMargins:
    """The margins of an axis. Alive are episodes with the `least` return; without it, those that did not terminate."""
    alive = [one.terminated.logical_not() if least is None else one.returns >= least for one in flown]
    counts, episodes = tuple(int(each.sum()) for each in alive), len(alive[0])
    returns = tuple(float(one.returns.mean()) for one in flown)
    return AxisMargins(axis, episodes, counts, returns)


def smoothness(episodes: Sequence[Tensor], period: float) -> dict[str, float]:
    """The smoothness of a policy's actions.

    Args:
        episodes: actions [T, A] in [-1, 1] of each, one every `period`.
        period: in seconds.

    Returns:
        `action_rate`, the root mean square of the change of an action in a second, where from one bound to the other is
        2; `fast_share`, the share of the power of the actions, without their means, at frequencies above 10 Hz;
        `saturated_share`, the share of the actions at a bound.
    """
    changes = torch.cat([actions.diff(dim=0).square() for actions in episodes])
    total = fast = 0.0
    for actions in episodes:
        power = torch.fft.rfft(actions - actions.mean(0), dim=0).abs().square().sum(1) / len(actions)
        total += power.sum().item()
        fast += power[torch.fft.rfftfreq(len(actions), period) > FAST].sum().item()
    return {
        "action_rate": (changes.sum() / max(1, changes.numel())).sqrt().item() / period,
        "fast_share": fast / max(total, 1e-12),
        "saturated_share": (torch.cat([*episodes]).abs() >= EDGE).float().mean().item(),
    }
