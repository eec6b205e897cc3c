# pyright: reportAttributeAccessIssue=false
"""The meaning of crazyflow's observations and actions."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lemniscate.drones.drones import STATE_PARTS
from lemniscate.envs.interface import Interface, Quantity, Reference

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
}
ACTION = (
    *(Quantity(name, "rad", "Euler angles x-y-z, body to world") for name in ("roll", "pitch", "yaw")),
    Quantity("thrust", "N", "body: along z, all rotors together"),
)


PAST_ACTION = tuple(Quantity(q.name, "1", "-1 and 1 are the bounds of the action") for q in ACTION)


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
    seen = [*(quantity for name in STATE_PARTS for quantity in PARTS[name]), *PAST_ACTION]
    steps = range(1, history + 1)
    parts["history"] = tuple(
        Quantity(f"{q.name}_{ago}_steps_ago{'' if q in PAST_ACTION else '_less_now'}", q.unit, q.frame)
        for ago in steps
        for q in seen
    )
    drone = str(env.sim.drone)
    return Interface(
        parts=parts,
        action=ACTION if str(env.sim.control) == "attitude" else (),
        period=1 / env.freq,
        delay=delay,
        history=history,
        action_before=tuple(map(float, hover)),
        dynamics=tuple(dynamics),
        vehicle="crazyflie" if drone.startswith("cf") else drone,
        reference=reference,
    )
