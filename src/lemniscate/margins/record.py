"""The findings of a pre-flight: the share that is alive at each point, margins, and the record for programs."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lemniscate.envs.probe import Axis, Flown, Value

ALIVE = 0.95
"""the share of the episodes that are alive within a margin"""
SIDES = ("below", "above")


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
        alive: of E episodes at each value, [V].
        mean_returns: [V].
        sides: by their names; of an axis without an order there are none.
    """

    axis: Axis
    alive: tuple[int, ...]
    mean_returns: tuple[float, ...]
    sides: dict[str, Side]

    def alive_at(self, value: Value) -> int:
        """The number of episodes that are alive at a value."""
        return self.alive[self.axis.values.index(value)]

    def return_at(self, value: Value) -> float:
        """The mean return at a value."""
        return self.mean_returns[self.axis.values.index(value)]

    def survived(self, episodes: int) -> list[Value]:
        """The values at which at least `ALIVE` are alive."""
        pairs = zip(self.axis.values, self.alive, strict=True)
        return [value for value, alive in pairs if alive >= ALIVE * episodes]

    def to_json(self, episodes: int) -> dict[str, Any]:
        """The axis as an object of JSON."""
        axis = self.axis
        margin = {name: _deviation(axis, side.last) for name, side in self.sides.items()}
        return {
            "unit": axis.unit or "factor",
            "nominal": axis.nominal,
            "values": list(axis.values),
            "alive": [alive / episodes for alive in self.alive],
            "mean_return": list(self.mean_returns),
            "margin": margin if self.sides else self.survived(episodes),
        }


def _deviation(axis: Axis, value: Value | None) -> float | None:
    """The distance of a value from the nominal one."""
    if value is None:
        return None
    assert not isinstance(value, str)
    assert not isinstance(axis.nominal, str)
    return float(f"{abs(value - axis.nominal):.10g}")


def worst_accepted(nominal: Flown) -> float:
    """The least return of an episode that is alive, where environments do not say that one has failed.

    It is the return that 95 % of the nominal episodes reach, less a tenth of the size of their mean.
    """
    returns = nominal.returns.numpy()
    return float(np.quantile(returns, 1 - ALIVE, method="lower") - 0.1 * abs(returns.mean()))


def margins_of(axis: Axis, flown: Sequence[Flown], least: float | None) -> AxisMargins:
    """Margins of an axis. Alive are episodes with the `least` return; if it is None, those that did not terminate."""
    alive = [one.terminated.logical_not() if least is None else one.returns >= least for one in flown]
    counts = tuple(int(each.sum()) for each in alive)
    episodes = len(alive[0])
    returns = tuple(float(one.returns.mean()) for one in flown)
    return AxisMargins(axis, counts, returns, dict(_sides(axis, counts, episodes)))


def _sides(axis: Axis, alive: Sequence[int], episodes: int) -> Iterable[tuple[str, Side]]:
    if isinstance(axis.nominal, str):
        return
    middle = axis.values.index(axis.nominal)
    for name, step in zip(SIDES, (-1, 1), strict=True):
        places = range(middle, -1 if step < 0 else len(axis.values), step)
        if len(places) > 1:
            flies = [alive[place] >= ALIVE * episodes for place in places]
            count = flies.index(False) if False in flies else len(flies)
            outward = [axis.values[place] for place in places]
            yield name, Side(outward[count - 1] if count else None, outward[count] if count < len(flies) else None)
