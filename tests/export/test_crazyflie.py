"""The glue for the Crazyflie's firmware, built against stand-ins of its headers and flown by a program."""

import ctypes
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from exported import exported, needs_compiler, policy_for

from lemniscate.drones.vehicle import PARTS, interface_of
from lemniscate.errors import UserError
from lemniscate.exporting.c_code import crazyflie_files
from lemniscate.exporting.compiled import CORE, TARGET_COMPILER, host_compiler, run_tool
from lemniscate.spec import Box

pytestmark = needs_compiler
FIRMWARE = Path(__file__).parent / "firmware"
ACTION = Box((-1.5, -1.5, -1.5, 0.05), (1.5, 1.5, 1.5, 0.48))
STATE = [0.5, -0.25, 1.0, 0.0, 0.0, 0.0, 1.0, 0.1, 0.2, 0.3, 90.0, -45.0, 10.0]
TRAJECTORY = np.stack([np.sin(np.arange(40) / 40 * math.tau), np.zeros(40), np.arange(40) / 40], axis=1)


HOVER = (0.0, 0.0, 0.0, 0.32)


def interface(curve=True, history=0, **changed):
    sim = SimpleNamespace(drone="cf2x_L250", control="attitude", dynamics="so_rpy")
    curve = {"trajectory": TRAJECTORY, "sample_offsets": np.array([0, 3])} if curve else {}
    return interface_of(
        SimpleNamespace(**{"freq": 50, "sim": sim, **curve, **changed}), ["so_rpy"], (0.0, 0.0), history, HOVER
    )


def quantities(meaning, *parts):
    return [quantity for name in ("pos", "quat", "vel", "ang_vel", *parts) for quantity in meaning.parts[name]]


class Firmware:
    """The controller in a shared library, one call of it with `tick`."""

    def __init__(self, folder, meaning, seen, copy):
        self.texts = crazyflie_files(meaning, seen, ACTION, copy.files(), "A policy.")
        for name, text in self.texts.items():
            (folder / name).write_text(text)
        warnings = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion"]
        sources = ["policy.c", "policy_controller.c", str(FIRMWARE / "firmware.c")]
        command = [host_compiler(), *warnings, "-Os", "-fPIC", "-shared", "-I.", f"-I{FIRMWARE}", *sources]
        run_tool([*command, "-o", "firmware.so"], folder)
        self.library = ctypes.CDLL(str(folder / "firmware.so"))
        self.library.controllerOutOfTreeTest.restype = ctypes.c_bool
        assert self.library.controllerOutOfTreeTest()
        self.library.controllerOutOfTreeInit()

    def tick(self, step, state=STATE, on=1, silence=20):
        """(thrust, roll, pitch, yaw) of the setpoint that is followed, None for the operator's own; the fault."""
        numbers = (ctypes.c_float * 14)(*state, silence)
        fault = self.library.tick(numbers, on, step)
        followed = (ctypes.c_float * 5)()
        self.library.last(followed)
        return (None if followed[0] == -1 else tuple(followed[:4])), fault


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("firmware")


@pytest.fixture(scope="module")
def built(folder):
    copy = exported(policy_for(ACTION, observations=19, normalize_observations=True), rows=20)
    meaning = interface()
    return Firmware(folder, meaning, quantities(meaning, "local_samples"), copy), copy, copy.host()


@pytest.fixture
def flying(built):
    firmware, _, host = built
    firmware.library.controllerOutOfTreeInit()
    firmware.tick(0, on=0)
    return firmware, host


def seen_at(state, point):
    """The flat observation in a state of the firmware, at a point of the curve."""
    samples = [TRAJECTORY[(point + ahead) % 40] - state[:3] for ahead in (0, 3)]
    return np.float32([[*state[:10], *np.radians(state[10:]), *np.ravel(samples)]])


def commanded(host, obs):
    roll, pitch, yaw, thrust = host.act(obs)[0]
    return np.array([thrust / 0.6 * 65535, *np.degrees([roll, -pitch, yaw])])


def test_it_observes_and_commands_in_the_firmwares_units(flying):
    firmware, host = flying
    followed, fault = firmware.tick(7)
    assert not fault
    assert np.allclose(followed, commanded(host, seen_at(STATE, 39)), rtol=1e-4, atol=1e-3)


def test_the_policy_acts_at_its_own_rate_and_the_curve_goes_on_with_it(flying):
    firmware, host = flying
    first, _ = firmware.tick(7)
    other = [0.4, *STATE[1:]]
    for step in (8, 13, 19):
        assert np.array_equal(firmware.tick(step, other)[0], first)
    followed, _ = firmware.tick(20, other)
    assert np.allclose(followed, commanded(host, seen_at(other, 0)), rtol=1e-4, atol=1e-3)
    followed, _ = firmware.tick(40, other)
    assert np.allclose(followed, commanded(host, seen_at(other, 1)), rtol=1e-4, atol=1e-3)


def test_who_lets_go_stops_the_policy(flying):
    firmware, host = flying
    assert firmware.tick(0, on=0)[0] is None
    assert firmware.tick(1)[0] is not None
    assert firmware.tick(2, silence=199)[0] is not None
    assert firmware.tick(3, silence=200) == (None, 0)
    followed, _ = firmware.tick(4)  # it begins at the beginning of the curve
    assert np.allclose(followed, commanded(host, seen_at(STATE, 39)), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("wrong", [{0: math.nan}, {10: math.inf}, {3: 0.6, 6: 0.8}, {3: math.nan}])
def test_after_a_fault_it_stays_off_until_it_was_switched_off(flying, wrong):
    firmware, _ = flying
    assert firmware.tick(20)[1] == 0
    state = [wrong.get(i, x) for i, x in enumerate(STATE)]
    assert firmware.tick(40, state) == (None, 1)
    assert firmware.tick(60) == (None, 1)
    assert firmware.tick(80, on=0) == (None, 0)
    assert firmware.tick(100)[0] is not None


def test_goals_are_the_operators_setpoints(tmp_path):
    copy = exported(policy_for(ACTION, observations=19), rows=20)
    meaning = interface(curve=False)
    seen = quantities(meaning, "difference_to_goal", "difference_to_target_vel")
    firmware = Firmware(tmp_path, meaning, seen, copy)
    obs = np.float32([[*STATE[:10], *np.radians(STATE[10:]), *(-np.array(STATE[:3])), *(-np.array(STATE[7:10]))]])
    assert np.allclose(firmware.tick(0)[0], commanded(copy.host(), obs), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("steps", [1, 3])
def test_it_keeps_what_it_saw_and_did(steps, tmp_path):
    def less_now(past, now):
        changes = np.array(past)
        changes[:, :13] -= now[0, :13]
        return np.float32(changes.reshape(1, -1))

    copy = exported(policy_for(ACTION, observations=19 + 17 * steps), rows=20)
    meaning = interface(history=steps)
    firmware = Firmware(tmp_path, meaning, quantities(meaning, "local_samples", "history"), copy)
    host, past = copy.host(), None
    low, high = np.float32(ACTION.low), np.float32(ACTION.high)
    states = [[0.5 + 0.01 * i, *STATE[1:]] for i in range(5)]
    for i, state in enumerate(states):
        now = seen_at(state, (39 + i) % 40)
        if past is None:  # level, and with a thrust of the weight
            past = [np.concatenate([now[0, :13], 2 * (np.float32(HOVER) - low) / (high - low) - 1])] * steps
        obs = np.concatenate([now, less_now(past, now)], axis=1)
        followed, fault = firmware.tick(20 * i, state)
        assert not fault
        assert np.allclose(followed, commanded(host, obs), rtol=1e-3, atol=2e-2)
        action = 2 * (host.act(obs)[0] - low) / (high - low) - 1
        past = [np.concatenate([now[0, :13], action]), *past[:-1]]
    firmware.tick(100, on=0)
    begun = seen_at(states[0], 39)
    level = [np.concatenate([begun[0, :13], 2 * (np.float32(HOVER) - low) / (high - low) - 1])] * steps
    obs = np.concatenate([begun, less_now(level, begun)], axis=1)
    assert np.allclose(firmware.tick(120, states[0])[0], commanded(host, obs), rtol=1e-3, atol=2e-2)


def test_a_history_in_another_order_is_refused():
    meaning = interface(history=2)
    seen = quantities(meaning, "local_samples", "history")
    with pytest.raises(UserError, match="nothing in the firmware gives position_x_2_steps_ago_less_now"):
        crazyflie_files(meaning, seen[:19] + seen[36:] + seen[19:36], ACTION, {}, "A policy.")


def test_the_folder_says_what_a_pilot_must_know(flying):
    texts = flying[0].texts
    assert set(texts) == {
        "policy.c",
        "policy.h",
        "policy_controller.c",
        "README.md",
        "Makefile",
        "Kbuild",
        "app-config",
    }
    assert texts["policy_controller.c"].startswith("/* SPDX-License-Identifier: GPL-3.0-only")
    assert "GPL" not in texts["policy.c"]
    assert "CONFIG_CONTROLLER_OOT=y" in texts["app-config"]
    for word in ("M1 front right", "Dead-man", "opposite", "0.050 to 0.480", "policy.on", "so_rpy", "GPL", "so_rpy"):
        assert word in texts["README.md"], word
    assert "$" not in texts["README.md"]


@pytest.mark.parametrize(
    ("changed", "parts", "said"),
    [
        ({}, ("history",), "nothing in the firmware gives action_1"),
        ({"freq": 300}, (), "its 300 actions a second do not divide the firmware's 1000"),
        ({"sim": SimpleNamespace(drone="cf2x_L250", control="force_torque", dynamics="so_rpy")}, (), "no.*roll, pitch"),
    ],
)
def test_what_the_firmware_cannot_do_is_refused(changed, parts, said, monkeypatch):
    meaning = interface(**changed)
    parts_of = {**meaning.parts, "history": (SimpleNamespace(name="action_1"),)}
    seen = [quantity for name in ("pos", *parts) for quantity in parts_of[name]]
    with pytest.raises(UserError, match=said):
        crazyflie_files(meaning, seen, ACTION, {}, "A policy.")


@pytest.mark.skipif(not shutil.which("arm-none-eabi-gcc"), reason="arm-none-eabi-gcc is not installed")
def test_it_compiles_for_the_crazyflies_processor(built, folder):
    options = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", f"-I{FIRMWARE}", "-I."]
    for source in ("policy.c", "policy_controller.c"):
        run_tool([TARGET_COMPILER, *CORE, *options, "-c", source, "-o", "x.o"], folder)


def test_parts_have_their_sizes():
    assert {name: len(part) for name, part in PARTS.items()}["quat"] == 4
