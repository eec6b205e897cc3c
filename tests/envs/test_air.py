"""The conditions of drones' flights, each against an oracle: physics by hand, or crazyflow's own simulation."""

import os

os.environ.setdefault("SCIPY_ARRAY_API", "1")

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("crazyflow")

from lemniscate.envs import registry
from lemniscate.envs.air import CONDITIONS, NOISE, disturb, read_ranges
from lemniscate.envs.crazyflow import DYNAMICS
from lemniscate.envs.spaces import scale_action
from lemniscate.errors import UserError

ENV = "DroneFigureEightTrajectory-v0"
N, MASS, G, SUBSTEPS, DT = 8, 0.0328, 9.81, 10, 0.02


def make(num_envs=N, stagger=False, **kwargs):
    return registry.make(ENV, num_envs, stagger=stagger, kwargs=kwargs)


def hover(env, factor=1.0):
    """The action of level attitude and a thrust of the weight."""
    action = torch.zeros(env.num_envs, 4)
    low, high = env.spec.action.low[3], env.spec.action.high[3]
    action[:, 3] = 2 * (factor * MASS * G - low) / (high - low) - 1
    return action


def actions(steps, num_envs=N, size=0.3):
    generator = torch.Generator().manual_seed(0)
    return size * torch.randn(steps, num_envs, 4, generator=generator)


def fly(env, plan, seed=3):
    """The observations [T + 1, N, O] of a flight by a plan [T, N, 4]."""
    return torch.stack([env.restart(seed), *(env.step(action).next_obs for action in plan)])


def substeps_by_hand(env, plan, delay, seed=3):
    """The true states [10 T + 1, N, 13] of crazyflow's own simulation, its commands late by so many substeps."""
    env.restart(seed)
    drones = env.backend._drones
    data, _, _ = env.backend._state
    sim = drones.env.sim
    level = np.zeros((env.num_envs, 4), np.float32)
    level[:, 3] = MASS * G
    commands = [scale_action(action.numpy(), env.spec.action) for action in plan]
    sim.data, states = data, []
    for i in range(len(plan) * SUBSTEPS + 1):
        state = sim.data.states
        states.append(
            np.concatenate([np.asarray(getattr(state, n))[:, 0] for n in ("pos", "quat", "vel", "ang_vel")], -1)
        )
        acting = (i - delay) // SUBSTEPS if i >= delay else -1
        if acting < len(commands):
            sim.attitude_control((commands[acting] if acting >= 0 else level)[:, None])
            sim.step(1)
    drones._put(drones._initial)
    return torch.tensor(np.array(states))


@pytest.fixture(scope="module")
def plain():
    return make()


def test_conditions_that_change_nothing_are_none():
    nominal = {name: condition.nominal for name, condition in CONDITIONS.items()}
    assert read_ranges(nominal) == {}
    assert read_ranges({"mass": [1, 1], "wind": 0.0, "jitter": [0, 0.2]}) == {"jitter": (0.0, 0.2)}


def test_a_condition_of_almost_nothing_changes_no_flight(plain):
    """Every path of the code is taken, and what is simulated is the same."""
    tiny = {"action_delay": [0, 1e-6], "observation_delay": [0, 1e-6], "wind": 1e-12, "mass": [1, 1 + 1e-7]}
    plan = actions(30)
    torch.testing.assert_close(fly(make(**tiny), plan), fly(plain, plan), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("name", "factor"), [("mass", 1.3), ("motor_gain", 0.8)])
def test_thrust_accelerates_by_its_factor_over_mass(plain, name, factor):
    ratio = 1 / factor if name == "mass" else factor
    speeds = []
    for env in (plain, make(**{name: factor})):
        obs = fly(env, hover(env).expand(10, N, 4))
        speeds.append((obs[10, :, 9] - obs[0, :, 9]) / (10 * DT) + G)
    torch.testing.assert_close(speeds[1], ratio * speeds[0], rtol=1e-3, atol=0)


@pytest.mark.parametrize("dynamics", DYNAMICS)
def test_a_heavier_and_weaker_drone_sinks_in_all_dynamics(dynamics):
    plain, changed = make(dynamics=dynamics, rotors=1), make(dynamics=dynamics, mass=1.2, motor_gain=0.9, rotors=1)
    drop = fly(plain, hover(plain).expand(20, N, 4))[-1, :, 2] - fly(changed, hover(changed).expand(20, N, 4))[-1, :, 2]
    expected = 0.5 * G * (1 - 0.9 / 1.2) * 0.4**2
    torch.testing.assert_close(drop, torch.full((N,), expected), rtol=0.15, atol=0)


@pytest.mark.parametrize("dynamics", ["so_rpy", "first_principles"])
def test_inertia_slows_the_turn(dynamics):
    turns = []
    for factor in (1.0, 3.0):
        env = make(dynamics=dynamics, rotors=1, inertia=factor)
        tilt = hover(env)
        tilt[:, 0] = 0.3
        turns.append(fly(env, tilt.expand(2, N, 4))[-1, :, 10].abs().mean())
    assert turns[1] < 0.6 * turns[0]


def test_rotors_follow_in_their_time():
    """In the fitted model the rotors' thrust nears its command by exp(−t / τ)."""
    speeds = {}
    for factor in (0.5, 2.0):
        env = make(dynamics="so_rpy_rotor", motor_time=factor)
        speeds[factor] = fly(env, hover(env).expand(25, N, 4))[-1, :, 9].mean()
    params = env.backend._drones._initial[0].params
    tau, gain = 1 / float(params.thrust_dyn_coef.mean()), float(params.cmd_f_coef.mean())
    lost = {f: G * gain * f * tau * (1 - math.exp(-0.5 / (f * tau))) for f in speeds}
    assert speeds[0.5] - speeds[2.0] == pytest.approx(lost[2.0] - lost[0.5], rel=0.05)


def test_the_thrust_curve_bends_in_the_middle_and_not_at_the_ends(plain):
    bent, (low, high) = make(thrust_curve=0.1), (0.0512703, 0.48)
    for share, more in ((0.5, 0.1), (0.25, 0.075), (1.0, 0.0)):
        action = torch.zeros(N, 4)
        action[:, 3] = 2 * share - 1
        gain = fly(bent, action.expand(5, N, 4))[-1, :, 9] - fly(plain, action.expand(5, N, 4))[-1, :, 9]
        expected = 1.0232 * more * (high - low) / MASS * 5 * DT
        torch.testing.assert_close(gain, torch.full((N,), expected), rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("substeps", [0, 3, 10, 17])
def test_actions_that_come_late_act_as_in_a_simulation_by_hand(plain, substeps):
    plan = actions(12)
    obs = fly(make(action_delay=substeps * 0.002) if substeps else plain, plan)
    by_hand = substeps_by_hand(plain, plan, substeps)
    torch.testing.assert_close(obs[..., :13], by_hand[::SUBSTEPS], rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("substeps", [4, 10, 23])
def test_observations_that_are_late_are_the_states_of_then(plain, substeps):
    plan = actions(12)
    env = make(observation_delay=substeps * 0.002)
    obs, by_hand = fly(env, plan), substeps_by_hand(plain, plan, 0)
    then = (torch.arange(13) * SUBSTEPS - substeps).clamp(min=0)
    torch.testing.assert_close(obs[..., :13], by_hand[then], rtol=1e-4, atol=2e-5)
    env.restart(3)
    step = env.step(plan[0])
    true = by_hand[SUBSTEPS, :, :3]
    reference = step.next_obs[:, :3] + step.next_obs[:, 13:16]
    torch.testing.assert_close(step.measures["tracking_error"], (reference - true).norm(dim=1), rtol=1e-3, atol=1e-5)


def test_noise_and_bias_have_their_sizes_and_rewards_are_of_the_truth():
    num_envs = 512
    plain, noisy = make(num_envs), make(num_envs, observation_noise=2.0)
    biased = make(num_envs, observation_bias=2.0)
    plan = hover(plain).expand(4, num_envs, 4)
    truth = fly(plain, plan)
    for env, is_constant in ((noisy, False), (biased, True)):
        error = fly(env, plan)[..., :13] - truth[..., :13]
        for part, name in ((slice(0, 3), "pos"), (slice(7, 10), "vel"), (slice(10, 13), "ang_vel")):
            assert error[..., part].std() == pytest.approx(2 * NOISE[name], rel=0.05)
        angle = 2 * error[..., 3:6]
        assert angle.std() == pytest.approx(2 * NOISE["attitude"], rel=0.1)
        drift = (error[4] - error[1])[:, :3].std()
        assert (drift < 1e-5) == is_constant
    for env in (plain, noisy):
        env.restart(3)
    steps = [env.step(plan[0]) for env in (plain, noisy)]
    torch.testing.assert_close(steps[0].reward, steps[1].reward)
    torch.testing.assert_close(steps[0].measures["tracking_error"], steps[1].measures["tracking_error"])


def test_a_disturbed_attitude_is_a_small_rotation():
    state, noise = torch.zeros(1, 13), torch.zeros(1, 12)
    state[:, 3:7] = torch.tensor([0.5, 0.5, 0.5, 0.5])
    noise[:, 3] = 1.0
    quat = np.asarray(disturb(state.numpy(), noise.numpy()))[0, 3:7]
    half = NOISE["attitude"] / 2
    x, y, z, w = 0.5, 0.5, 0.5, 0.5
    turned = np.array([x + w * half, y + z * half, z - y * half, w - x * half])  # q ⊗ (half, 0, 0, 1)
    np.testing.assert_allclose(quat, turned / np.linalg.norm(turned), atol=1e-6)


def test_wind_is_a_constant_force_from_any_side():
    env = make(64, wind=0.05)
    obs = fly(env, hover(env).expand(10, 64, 4))
    gained = obs[10, :, 7:9] - obs[0, :, 7:9]
    speed = gained.norm(dim=1)
    torch.testing.assert_close(speed, torch.full((64,), 0.05 / MASS * 0.2), rtol=0.02, atol=0)
    angle = torch.atan2(gained[:, 1], gained[:, 0])
    assert angle.cos().mean().abs() < 0.3
    assert angle.sin().mean().abs() < 0.3


def test_gusts_have_their_size_and_die_away():
    env = make(512, gusts=0.03)
    obs = fly(env, hover(env).expand(51, 512, 4))
    force = (obs[1:, :, 7] - obs[:-1, :, 7]) / DT * MASS
    assert force.std() == pytest.approx(0.03, rel=0.05)
    correlation = (force[:-25] * force[25:]).mean() / force.var()
    assert correlation == pytest.approx(math.exp(-1), abs=0.05)


def test_lost_actions_hold_the_one_before():
    env = make(512, lost_actions=0.3)
    plan = torch.zeros(2, 512, 4)
    plan[0], plan[1] = hover(env), hover(env, 1.3)
    obs = fly(env, plan)
    gained = (obs[2, :, 9] - obs[1, :, 9]) / DT
    held = gained < 1.0
    assert held.float().mean() == pytest.approx(0.3, abs=0.06)


def test_jitter_delays_each_action_by_itself():
    env = make(512, jitter=1.0)
    plan = torch.zeros(2, 512, 4)
    plan[0], plan[1] = hover(env), hover(env, 1.3)
    obs = fly(env, plan)
    gained = (obs[2, :, 9] - obs[1, :, 9]) / DT
    assert gained.std() > 0.5
    assert gained.min() < 0.5
    assert gained.max() > 2.5


def test_starts_are_spread_by_their_factor_and_rotors_turn():
    wide, narrow = make(64, start_spread=2.0).restart(1), make(64, start_spread=0.0).restart(1)
    plain = make(64).restart(1)
    middle = torch.tensor([0.0, 0.0, 1.2])
    torch.testing.assert_close(wide[:, :3] - middle, 2 * (plain[:, :3] - middle))
    torch.testing.assert_close(wide[:, 7:10], 2 * plain[:, 7:10])
    assert (narrow[:, :3] == middle).all()
    still, turning = make(dynamics="first_principles"), make(dynamics="first_principles", rotors=1.0)
    falls = [fly(env, hover(env).expand(5, N, 4))[-1, :, 9].mean() for env in (still, turning)]
    assert falls[1] - falls[0] > 0.4


@pytest.mark.parametrize("dynamics", ["so_rpy", ["so_rpy", "first_principles"]])
def test_the_history_is_what_was_seen_and_done_before_the_newest_first(dynamics):
    env, plan = make(history=3, dynamics=dynamics, observation_noise=1.0), actions(6, size=2.0)
    obs = fly(env, plan)
    past = obs[..., 43:].unflatten(-1, (3, 17))
    for t in range(1, 7):
        for age in range(min(t, 3)):
            torch.testing.assert_close(past[t, :, age, :13], obs[t - 1 - age, :, :13] - obs[t, :, :13])
            torch.testing.assert_close(past[t, :, age, 13:], plan[t - 1 - age].clamp(-1, 1))
    assert (past[0, ..., :13] == 0).all()
    torch.testing.assert_close(past[0, :, 2, 13:], hover(env))


def test_each_drone_has_conditions_of_its_own_which_end_with_its_episode():
    env = make(64, mass=[0.5, 2.0], max_episode_time=0.1)
    env.restart(1)
    masses = []
    for _ in range(7):
        masses.append(torch.tensor(np.asarray(env.backend._state[0].params.mass)).flatten() / MASS)
        step = env.step(hover(env))
    assert step.terminated.sum() == 0
    assert all(torch.equal(masses[0], masses[i]) for i in range(1, 5))
    assert (masses[5] != masses[0]).all()
    assert masses[5].min() >= 0.5
    assert masses[5].max() <= 2.0
    assert masses[5].std() > 0.3
    drawn = torch.tensor(np.asarray(env.backend._state[2]["drawn"]["mass"]))
    torch.testing.assert_close(masses[6], drawn)


def test_rows_of_drones_that_go_on_are_not_measured_again():
    """next_obs of a row is the obs of the next one, noise included, unless the episode ended."""
    env = make(64, observation_noise=1.0, stagger=True)
    env.restart(1)
    for _ in range(3):
        step = env.step(hover(env))
        goes_on = ~(step.terminated | step.truncated)
        assert torch.equal(env.obs[goes_on], step.next_obs[goes_on])


def test_drones_of_several_dynamics_take_turns():
    env = make(8, dynamics=list(DYNAMICS), rotors=0.0)
    plan = hover(env).expand(20, 8, 4)
    obs = fly(env, plan)
    fall = (obs[-1, :, 9] - obs[0, :, 9]).unflatten(0, (2, 4))
    alone = []
    for dynamics in DYNAMICS:
        one = make(8, dynamics=dynamics)
        alone.append((fly(one, plan)[-1, :, 9] - fly(one, plan)[0, :, 9]).mean())
    torch.testing.assert_close(fall.mean(0), torch.stack(alone), rtol=0.05, atol=0.02)


@pytest.mark.parametrize(
    ("kwargs", "sentence"),
    [
        ({"mass": [1.2, 0.8]}, "mass is a range upside down: 1.2 is above 0.8."),
        ({"mass": "heavy"}, "mass must be a number or a range [low, high], not 'heavy'."),
        ({"mass": [1, 2, 3]}, "mass must be a number or a range"),
        ({"mass": True}, "mass must be a number or a range"),
        ({"mass": 0}, "mass must be from 0.2 to 3 (factor of the mass), not 0."),
        ({"mass": float("nan")}, "mass"),
        ({"action_delay": -0.01}, "action_delay must be from 0 to 0.2"),
        ({"dynamics": "second_principles"}, "second_principles"),
        ({"dynamics": ["so_rpy", "warp"]}, "warp"),
        ({"dynamics": ["so_rpy", "so_rpy_rotor", "so_rpy_rotor_drag"]}, "8 drones cannot be divided equally among 3"),
        ({"history": -1}, "history must be a whole number of steps from 0 to 50, not -1."),
        ({"history": 2.5}, "history must be a whole number of steps"),
        ({"winds": 1}, "winds"),
    ],
)
def test_what_is_no_condition_has_its_sentence(kwargs, sentence):
    with pytest.raises(UserError) as error:
        make(**kwargs)
    assert sentence in str(error.value)
    assert str(error.value).count("\n") == 0


def test_the_page_names_every_condition_with_its_nominal_value():
    page = (Path(__file__).parents[2] / "docs" / "vehicle.md").read_text()
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| `")]
    named = {name: row[-1].strip(" |") for row in rows for name in re.findall(r"`(\w+)`", row[0])}
    for name, condition in CONDITIONS.items():
        assert float(named[name]) == condition.nominal, name
