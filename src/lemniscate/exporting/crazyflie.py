"""The folder with which the Crazyflie's firmware takes a policy as its controller."""

import re
from collections.abc import Mapping
from typing import Any

from lemniscate.envs.backend import Interface, Quantity
from lemniscate.errors import UserError
from lemniscate.exporting.c_code import TEMPLATES, comment, literal
from lemniscate.spec import Action, Box
from lemniscate.system.files import filled
from lemniscate.system.machine import version

COMMANDS = ("roll", "pitch", "yaw", "thrust")
LOOP = 1000
"""Hz, the rate of the firmware's stabilizer, which the policy's rate has to divide"""

SENSED = {f"attitude_{axis}": f"state->attitudeQuaternion.{axis}" for axis in "xyzw"}
for _axis in "xyz":
    SENSED |= {
        f"position_{_axis}": f"state->position.{_axis}",
        f"velocity_{_axis}": f"state->velocity.{_axis}",
        f"angular_velocity_{_axis}": f"sensors->gyro.{_axis} * RADIANS",
        f"to_goal_{_axis}": f"setpoint->position.{_axis} - state->position.{_axis}",
        f"to_goal_velocity_{_axis}": f"setpoint->velocity.{_axis} - state->velocity.{_axis}",
    }
"""the firmware's expression for each quantity, by its name"""
TO_REFERENCE = re.compile(r"to_reference_in_.*s_[xyz]")
PAST = re.compile(r"(.+)_(\d+)_steps_ago(_less_now)?")


def crazyflie_files(
    interface: Interface, quantities: list[Quantity], action: Action, c_files: Mapping[str, str], title: str
) -> dict[str, str]:
    """The texts of the folder's files, by name, those of `c_files` among them.

    The policy sees `quantities`, in their order, in an environment with this interface.

    Raises:
        UserError: actions other than attitude and thrust; quantities that the firmware does not have; a rate that does
            not divide the firmware's.
    """
    if tuple(quantity.name for quantity in interface.action) != COMMANDS or not isinstance(action, Box):
        raise UserError("its actions are not roll, pitch, yaw and thrust")
    rate = round(1 / interface.period) if interface.period else 0
    if not rate or LOOP % rate:
        raise UserError(f"its {rate} actions a second do not divide the firmware's {LOOP}")
    names = [quantity.name for quantity in quantities]
    references = [name for name in names if interface.reference and TO_REFERENCE.fullmatch(name)]
    past = [name for name in names if PAST.fullmatch(name)]
    for name in names:
        if name not in (*SENSED, *references, *past):
            raise UserError(f"nothing in the firmware gives {name}")
    context = {
        "title": title,
        "version": version(),
        "rate": rate,
        "remembers": "POLICY_MEMORY" in c_files.get("policy.h", ""),
        "action": action,
        "interface": interface,
        "reference": interface.reference,
        "to_reference": names.index(references[0]) if references else None,
        "sensed": {i: SENSED[name] for i, name in enumerate(names) if name in SENSED},
        "history": _history(names, past, action, interface.action_before) if past else None,
    }
    folder, filters = TEMPLATES / "crazyflie", {"literal": literal, "comment": comment}
    names_of_files = ("policy_controller.c", "README.md", "Makefile", "Kbuild", "app-config")
    return {**c_files, **{name: filled(folder / name, filters, **context) for name in names_of_files}}


def _history(names: list[str], past: list[str], action: Box, before: tuple[float, ...]) -> dict[str, Any]:
    """The quantities of earlier steps that are given to the policy, the newest first.

    `kept` has the expressions of a quantity: among the observations, where it is one, and among the actions.

    Raises:
        UserError: a history of other quantities, or in another order.
    """
    each = [found[1] for name in past if (found := PAST.fullmatch(name)) and found[2] == "1"]
    steps = len(past) // max(1, len(each))
    first, known = names.index(past[0]), (*names, *COMMANDS)
    steps_ago = [(ago, name) for ago in range(1, steps + 1) for name in each]
    expected = [f"{name}_{ago}_steps_ago{'_less_now' if name in names else ''}" for ago, name in steps_ago]
    if names[first : first + len(past)] != expected or not set(each) <= set(known) or len(before) != len(COMMANDS):
        raise UserError(f"nothing in the firmware gives {past[0]}")
    now = {name: f"obs[{i}]" for i, name in enumerate(names)}
    kept = [(now.get(name, ""), "" if name in now else _normalized(name, action)) for name in each]
    return {"steps": steps, "first": first, "before": before, "kept": kept}


def _normalized(command: str, action: Box) -> str:
    """The C expression of a coordinate of the action between -1 and 1, the ends of its range."""
    i = COMMANDS.index(command)
    low, high = action.low[i], action.high[i]
    return f"(action[{i}] - {literal((low + high) / 2)}) / {literal((high - low) / 2)}"
