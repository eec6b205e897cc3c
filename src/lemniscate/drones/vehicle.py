# pyright: reportAttributeAccessIssue=false
"""The meaning of a drone's numbers: units and frames of what crazyflow observes, the conditions of a flight, and PD.

A condition is a number, or a range [low, high] from which one is drawn for every episode of every drone. All of them
together are what is called domain randomization (Tobin et al. 2017, arXiv:1703.06907).
"""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.backend import Interface, Quantity, Reference
from lemniscate.errors import UserError, shown
from lemniscate.maths import Deterministic
from lemniscate.spec import Box

DYNAMICS = ("so_rpy", "so_rpy_rotor", "so_rpy_rotor_drag", "first_principles")
STATE_PARTS = ("pos", "quat", "vel", "ang_vel")
STATE_SIZE = 13
"""position 3 (m), quaternion 4 (xyzw), velocity 3 (m/s), angular velocity 3 (rad/s)"""
NOISE = {"pos": 0.002, "attitude": math.radians(0.5), "vel": 0.03, "ang_vel": 0.05}
"""standard deviations: of a motion-capture system (m, rad), of velocities estimated from it (m/s), of a gyroscope
(rad/s)"""
GRAVITY = 9.81
GAINS = {
    "so_rpy": (37.7, 9.6, 79.2, 16.0),
    "so_rpy_rotor": (47.4, 11.6, 74.8, 22.6),
    "so_rpy_rotor_drag": (50.2, 14.4, 66.3, 24.0),
    "first_principles": (17.8, 9.3, 27.9, 11.8),
}
"""kp (1/s²) and kd (1/s) of the horizontal axes, then of the vertical one: in each dynamics the best of 60, by the
return from 192 starts of the figure eight (`benchmarks/air.py --gains`)"""


@dataclass(frozen=True)
class Condition:
    """The value of a condition in the simulator as it is, the limits of what can be asked for, and its meaning."""

    nominal: float
    low: float
    high: float
    meaning: str


_FILE = files("lemniscate.drones").joinpath("conditions.toml")
TABLES: Mapping[str, Any] = tomllib.loads(_FILE.read_text(encoding="utf-8"))
CONDITIONS = {name: Condition(**row) for name, row in TABLES["conditions"].items()}

Ranges = Mapping[str, tuple[float, float]]


def read_ranges(kwargs: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """The ranges of the conditions among the arguments of an environment, without those that change nothing.

    Raises:
        UserError: a value that is neither a number nor a range, or outside what a drone could fly with.
    """
    ranges = {name: _range(name, kwargs[name]) for name in CONDITIONS if name in kwargs}
    return {name: ends for name, ends in ranges.items() if ends != (CONDITIONS[name].nominal,) * 2}


def _range(name: str, value: Any) -> tuple[float, float]:
    ends = list(value) if isinstance(value, list | tuple) else [value, value]
    numbers = all(isinstance(end, int | float) and not isinstance(end, bool) for end in ends)
    if len(ends) != 2 or not numbers:
        raise UserError(f"{name} must be a number or a range [low, high], not {shown(value)}.")
    condition, (low, high) = CONDITIONS[name], ends
    if low > high:
        raise UserError(f"{name} has a range whose low end {low:g} is above its high end {high:g}.")
    if not condition.low <= low <= high <= condition.high:
        limits = f"from {condition.low:g} to {condition.high:g}"
        raise UserError(f"{name} must be {limits} ({condition.meaning}), not {shown(value)}.")
    return float(low), float(high)


WORLD, BODY = "world: x, y, z, z is up", "body: x is ahead, y to the left, z up"


def _vector(name: str, unit: str, frame: str) -> tuple[Quantity, ...]:
    return tuple(Quantity(f"{name}_{axis}", unit, frame) for axis in "xyz")


PARTS = {
    "pos": _vector("position", "m", WORLD),
    "quat": tuple(Quantity(f"attitude_{axis}", "1", "unit quaternion, body to world") for axis in "xyzw"),
    "vel": _vector("velocity", "m/s", WORLD),
    "ang_vel": _vector("angular_velocity", "rad/s", BODY),
    "difference_to_goal": _vector("to_goal", "m", WORLD),
    "difference_to_target_vel": _vector("to_goal_velocity", "m/s", WORLD),
    "gates": tuple(
        quantity
        for which in ("next", "second")
        for quantity in (*_vector(f"to_{which}_gate", "m", WORLD), *_vector(f"{which}_gate_direction", "1", WORLD))
    )
    + _vector("position_at_next_gate", "m", "gate: x is flown along, y to the left"),
    "obstacles": tuple(q for which in ("nearest", "second") for q in _vector(f"to_{which}_obstacle", "m", WORLD)[:2]),
    "last_action": tuple(Quantity(f"last_action_{i}", "1", "-1 and 1 are the bounds of the action") for i in range(4)),
    "race": (
        Quantity("gates_left", "1", "share of all"),
        Quantity("next_gate_seen", "1", "0 or 1"),
        Quantity("second_gate_seen", "1", "0 or 1"),
    ),
}
ACTION = (
    *(Quantity(name, "rad", "Euler angles x-y-z, body to world") for name in ("roll", "pitch", "yaw")),
    Quantity("thrust", "N", "body: along z, all rotors together"),
)
RATES = (*_vector("body_rate", "rad/s", BODY), ACTION[-1])
"""the action where body rates are controlled"""


def interface_of(
    env: Any, dynamics: Sequence[str], delay: tuple[float, float], history: int, hover: Sequence[float] = ()
) -> Interface:
    """The interface of a crazyflow environment with attitude control, flown in these dynamics.

    `hover` is the command that is taken to have gone before the first.
    """
    parts, reference = dict(PARTS), None
    if hasattr(env, "trajectory"):
        offsets = np.asarray(env.sample_offsets)
        reference = Reference(np.asarray(env.trajectory, dtype=np.float32), offsets)
        seconds = [f"{offset / env.freq:g}s" for offset in offsets]
        ahead = [_vector(f"to_reference_in_{text}", "m", WORLD) for text in seconds]
        parts["local_samples"] = tuple(quantity for vector in ahead for quantity in vector)
    action = {"attitude": ACTION, "body_rate": RATES}.get(str(env.sim.control), ())
    past = tuple(Quantity(q.name, "1", "-1 and 1 are the bounds of the action") for q in action)
    seen = [*(quantity for name in STATE_PARTS for quantity in PARTS[name]), *past]
    parts["history"] = tuple(
        Quantity(f"{q.name}_{ago}_steps_ago{'' if q in past else '_less_now'}", q.unit, q.frame)
        for ago in range(1, history + 1)
        for q in seen
    )
    drone = str(env.sim.drone)
    return Interface(
        parts=parts,
        action=action,
        period=1 / env.freq,
        delay=delay,
        history=history,
        action_before=tuple(map(float, hover)),
        dynamics=tuple(dynamics),
        vehicle="crazyflie" if drone.startswith("cf") else drone,
        reference=reference,
    )


@dataclass(frozen=True)
class PD:
    """A proportional-derivative controller that flies a drone along a previewed reference: the classical baseline.

    Wished acceleration = kp · position error + kd · velocity error + the reference's acceleration + gravity. The drone
    turns its thrust axis there, without yaw, and pushes as hard as that takes: Mellinger and Kumar 2011, section III,
    without their attitude loop, which the drone has itself. It is a function of flat observations.

    Attributes:
        gains: kp, kd, kp_z, kd_z of each of K dynamics, in which the drones are by turns.
        mass: that it believes in, kg, [K].
        action: the bounds of roll, pitch, yaw (rad) and thrust (N).
        reference: where the observation has the reference less the position, at least three points, x, y, z each (m).
        velocity: where it has the velocity (m/s).
        preview: seconds from one point to the next.
    """

    gains: Sequence[Sequence[float]]
    mass: Sequence[float]
    action: Box
    reference: slice
    velocity: slice
    preview: float

    def __call__(self, obs: Tensor) -> Deterministic:
        """The action [N, 4] at each observation [N, O]."""
        turn = torch.arange(len(obs)) % len(self.mass)
        gains, mass = torch.tensor(self.gains)[turn], torch.tensor(self.mass)[turn]
        kp, kd = gains[:, [0, 0, 2]], gains[:, [1, 1, 3]]
        points = obs[:, self.reference].unflatten(1, (-1, 3))
        here, next_, after = points[:, 0], points[:, 1], points[:, 2]
        velocity = (-3 * here + 4 * next_ - after) / (2 * self.preview)  # derivatives of the parabola through them
        acceleration = (here - 2 * next_ + after) / self.preview**2
        wish = kp * here + kd * (velocity - obs[:, self.velocity]) + acceleration
        wish = wish + torch.tensor((0.0, 0.0, GRAVITY))
        size = wish.norm(dim=1)
        x, y, z = (wish / size[:, None]).unbind(1)
        roll, pitch = -torch.asin(y.clamp(-1, 1)), torch.atan2(x, z)
        command = torch.stack([roll, pitch, torch.zeros_like(roll), mass * size], dim=1)
        low, high = torch.tensor(self.action.low), torch.tensor(self.action.high)
        return Deterministic((2 * (command - low) / (high - low) - 1).clamp(-1, 1))
