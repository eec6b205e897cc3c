"""The folder with which the Crazyflie's firmware takes a policy as its controller."""

import re
from collections.abc import Mapping

import numpy as np

from lemniscate.envs.backend import Interface, Quantity, Reference
from lemniscate.errors import UserError
from lemniscate.exporting.c_code import TEMPLATES, comment, fill, literal
from lemniscate.exporting.manifest import version
from lemniscate.spec import Action, Box

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
    """The texts of the folder's files, by name.

    Args:
        interface: of the environment of training.
        quantities: of the whole observation, in its order.
        action: the kind of actions.
        c_files: the texts of `policy.c` and `policy.h`.
        title: what the policy is for.

    Raises:
        UserError: actions other than attitude and thrust; quantities that the firmware does not have; a rate that does
            not divide the firmware's.
    """
    if tuple(quantity.name for quantity in interface.action) != COMMANDS or not isinstance(action, Box):
        raise UserError("its actions are not roll, pitch, yaw and thrust")
    rate = round(1 / interface.period) if interface.period else 0
    if not rate or LOOP % rate:
        raise UserError(f"its {rate} actions a second do not divide the firmware's {LOOP}")
    reference, names = interface.reference, [quantity.name for quantity in quantities]
    past = [name for name in names if PAST.fullmatch(name)]
    shared = {"title": comment(title), "version": version(), "rate": rate}
    controller = {
        "reference": _reference(reference) if reference else "",
        "counter": "static uint32_t step; /* the point of the curve */\n" if reference else "",
        "observe": _observe([name for name in names if name not in past], reference),
        "history": _history(names, past, action, interface.action_before) if past else "",
        "recall": "        recall(obs);\n" if past else "",
        "remember": "        remember(obs, action);\n" if past else "",
        "restart": "        step = acting ? (step + 1) % REFERENCE_STEPS : REFERENCE_STEPS - 1;\n" if reference else "",
    }
    start = reference.points[-1] if reference else ()
    readme = {
        "thrust": f"{action.low[3]:.3f} to {action.high[3]:.3f}",
        "start": f", near ({', '.join(f'{x:.1f}' for x in start)})" if reference else "",
        "goal": "" if reference else " The policy flies to the setpoint.",
        "dynamics": ", ".join(interface.dynamics or ()),
    }
    folder = "crazyflie"
    return {
        **c_files,
        "policy_controller.c": fill(f"{folder}/policy_controller.c", {**shared, **controller}),
        "README.md": fill(f"{folder}/README.md", {**shared, **readme}),
        **{name: (TEMPLATES / folder / name).read_text() for name in ("Makefile", "Kbuild", "app-config")},
    }


def _reference(reference: Reference) -> str:
    """The curve as constants."""
    points = ",\n".join(f"    {{{', '.join(map(literal, point))}}}" for point in reference.points)
    sizes = {"steps": len(reference.points), "samples": len(reference.offsets)}
    return fill("crazyflie/reference.c", {**sizes, "points": points, "offsets": ", ".join(map(str, reference.offsets))})


def _history(names: list[str], past: list[str], action: Box, before: tuple[float, ...]) -> str:
    """The functions that keep observations and actions of earlier steps, the newest first, and give them to the policy.

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
    remembered, recalled = [], []
    for i, name in enumerate(each):
        now = f"obs[{names.index(name)}]" if name in names else ""
        remembered.append(f"    past[0][{i}] = {now or _normalized(COMMANDS.index(name), action)};")
        recalled.append(f"        then[{i}] = past[i][{i}]{f' - {now}' if now else ''};")
    lines = {"remembered": "\n".join(remembered), "recalled": "\n".join(recalled)}
    numbers = {"steps": steps, "size": len(each), "first": first, "before": ", ".join(map(literal, before))}
    return fill("crazyflie/history.c", {**numbers, **lines})


def _normalized(i: int, action: Box) -> str:
    """The C expression of a coordinate of the action between -1 and 1, the ends of its range."""
    low, high = action.low[i], action.high[i]
    return f"(action[{i}] - {literal((low + high) / 2)}) / {literal((high - low) / 2)}"


def _observe(names: list[str], reference: Reference | None) -> str:
    """The body of `observe`, for the quantities of this step."""
    strangers = [name for name in names if name not in SENSED and not (reference and TO_REFERENCE.fullmatch(name))]
    if strangers:
        raise UserError(f"nothing in the firmware gives {strangers[0]}")
    unused = [] if any("setpoint" in SENSED.get(name, "") for name in names) else ["    (void)setpoint;"]
    unused += [] if any("sensors" in SENSED.get(name, "") for name in names) else ["    (void)sensors;"]
    lines = [f"    obs[{i}] = {SENSED[name]};" for i, name in enumerate(names) if name in SENSED]
    if reference:
        first = int(np.argmax([bool(TO_REFERENCE.fullmatch(name)) for name in names]))
        axes = [
            f"        obs[{first + i} + 3 * i] = point[{i}] - state->position.{axis};" for i, axis in enumerate("xyz")
        ]
        point = "        const float *const point = reference[(step + ahead[i]) % REFERENCE_STEPS];"
        lines += ["    for (int i = 0; i < REFERENCE_SAMPLES; ++i) {", point, *axes, "    }"]
    return "\n".join([*unused, *lines])
