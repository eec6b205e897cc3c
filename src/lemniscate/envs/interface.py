"""The physical meaning of an environment's numbers: names, units, frames, times."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Quantity:
    """One number of an observation or of an action: its name, its unit, and the frame that it is given in."""

    name: str
    unit: str | None = None
    frame: str | None = None


@dataclass(frozen=True)
class Reference:
    """A closed curve that is followed: `points` [T, 3], one for each control step; what is seen of it at each step.

    That are the points `offsets` [K] steps ahead. The first step of an episode is the last point, number T − 1.
    """

    points: np.ndarray
    offsets: np.ndarray


@dataclass(frozen=True)
class Interface:
    """The meaning of an environment's observations and actions, for a policy that leaves it.

    Attributes:
        parts: the quantities of each part of the observation, by its name.
        action: those of the action.
        period: seconds between two actions.
        delay: seconds from an observation to the action's effect, besides the vehicle's own: the least, the most.
        history: the number of earlier observations and actions that are seen beside the present one.
        action_before: the action, in its units, that is taken to have gone before the first, where there is a history.
        dynamics: the models of the vehicle.
        vehicle: its name, such as crazyflie.
        reference: the curve that it follows, if it does.
    """

    parts: Mapping[str, tuple[Quantity, ...]] = field(default_factory=dict)
    action: tuple[Quantity, ...] = ()
    period: float | None = None
    delay: tuple[float, float] | None = None
    history: int | None = None
    action_before: tuple[float, ...] = ()
    dynamics: tuple[str, ...] | None = None
    vehicle: str | None = None
    reference: Reference | None = None
