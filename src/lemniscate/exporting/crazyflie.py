"""The folder with which the Crazyflie's firmware takes a policy as its controller."""

import re
from collections.abc import Mapping

import numpy as np

from lemniscate.envs.interface import Interface, Quantity, Reference
from lemniscate.errors import UserError
from lemniscate.exporting.c_code import braces
from lemniscate.exporting.c_files import TEMPLATES, comment, fill
from lemniscate.exporting.provenance import version
from lemniscate.spec import Action, Box

COMMANDS = ("roll", "pitch", "yaw", "thrust")
LOOP = 1000
"""Hz, of the firmware's stabilizer, which a controller's rate divides"""

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


def crazyflie_files(
    interface: Interface, quantities: list[Quantity], action: Action, c_files: Mapping[str, str], title: str
) -> dict[str, str]:
    """The texts of the folder's files, by name.

    Args:
        interface: of the environment of training.
        quantities: of the whole observation, in its order.
        action: the kind of actions.
        c_files: the texts of `policy.c` and `policy.h`.
        title: what it is a policy for.

    Raises:
        UserError: actions that are no attitude and thrust; quantities that the firmware does not have; a rate that does
            not divide the firmware's.
    """
    if tuple(quantity.name for quantity in interface.action) != COMMANDS or not isinstance(action, Box):
        raise UserError("its actions are not roll, pitch, yaw and thrust")
    rate = round(1 / interface.period) if interface.period else 0
    if not rate or LOOP % rate:
        raise UserError(f"its {rate} actions a second do not divide the firmware's {LOOP}")
    reference = interface.reference
    shared = {"title": comment(title), "version": version(), "rate": rate}
    controller = {
        "reference": _reference(reference) if reference else "",
        "counter": "static uint32_t step; /* the point of the curve */\n" if reference else "",
        "observe": _observe(quantities, reference),
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
    points = (
        "".join(f"    {braces(point)},\n" for point in reference.points).replace("{\n    ", "{").replace(",\n}", "}")
    )
    offsets = ", ".join(map(str, reference.offsets))
    return (
        (
            f"\n#define REFERENCE_STEPS {len(reference.points)}\n"
            f"#define REFERENCE_SAMPLES {len(reference.offsets)}\n\n"
            f"static const float reference[REFERENCE_STEPS][3] = {{ /* m, in the world */\n{points}}};\n\n"
            f"static const uint32_t ahead[REFERENCE_SAMPLES] = {{{offsets}}}; /* steps */\n"
        )
        .replace("F,", "f,")
        .replace("F}", "f}")
    )


def _observe(quantities: list[Quantity], reference: Reference | None) -> str:
    """The body of `observe`."""
    names = [quantity.name for quantity in quantities]
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
