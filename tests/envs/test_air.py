"""The conditions of drones' flights, each against an oracle: physics by hand, or crazyflow's own simulation.

All conditions are in one program here, as data: each flight is flown at several points side by side, from the same
starts, with the same random numbers.
"""

import math
import os
import re
from contextlib import closing
from functools import cache
from pathlib import Path

os.environ.setdefault("SCIPY_ARRAY_API", "1")

import numpy as np
import pytest
import torch

pytest.importorskip("crazyflow")

import lemniscate as lem
from lemniscate.drones.air import disturb
from lemniscate.drones.crazyflow import CrazyflowBackend, make_drones
from lemniscate.drones.vehicle import CONDITIONS, DYNAMICS, NOISE, read_ranges
from lemniscate.envs import registry
from lemniscate.envs.conversion import scale_action
from lemniscate.errors import UserError
from lemniscate.exporting.deployed import act_with
from lemniscate.exporting.parity import fly
from lemniscate.spec import Box

ENV = "DroneFigureEightTrajectory-v0"
POINTS, N, HISTORY, MASS, G, SUBSTEPS, DT = 3, 256, 2, 0.0328, 9.81, 10, 0.02
WIDE = {name: (condition.low, condition.high) for name, condition in CONDITIONS.items()}
WIDE |= {"action_delay": (0.0, 0.06), "observation_delay": (0.0, 0.06)}
NAMES = list(WIDE)


class Program:
    """Drones of some dynamics, and what flies them at `POINTS` points."""

    def __init__(self, dynamics):
        import jax

        self.drones = drones = make_drones(ENV, N, "cpu", {"history": HISTORY}, dynamics, WIDE)
        drones.env.sim.device = None  # crazyflow places actions on a device, which jax.vmap cannot
        self.box = Box(tuple(drones.low.tolist()), tuple(drones.high.tolist()))
        every, calm = np.ones(N, dtype=bool), np.bool_(False)

        def begin(seed, ends):
            data, arrays, air = drones.init(jax.random.key(seed))
            return drones.reset((data, arrays, {**air, "ends": ends}), jax.numpy.asarray(every), calm)[:2]

        self.begin = jax.jit(jax.vmap(begin, in_axes=(None, 0)))
        self.step = jax.jit(jax.vmap(drones.step))

    def fly(self, plan, *points, seed=3):
        """Observations [T + 1, P, N, O] and (reward, measure) [T, P, N] of a plan [T, N, 4] at points of conditions.

        The first point is nominal.
        """
        ends = np.array([[[CONDITIONS[name].nominal] * 2 for name in NAMES]] * POINTS, np.float32)
        for point, conditions in zip(ends[1:], points, strict=False):
            for name, value in conditions.items():
                point[NAMES.index(name)] = value
        self.state, first = self.begin(np.uint32(seed), ends)
        observed, told = [np.asarray(first)], []
        for action in plan:
            given = np.broadcast_to(action.numpy(), (POINTS, *action.shape))
            self.state, (obs, reward, _, _, measures) = self.step(self.state, given)
            observed.append(np.asarray(obs))
            told.append(np.stack([np.asarray(reward), np.asarray(measures["tracking_error"])]))
        return torch.tensor(np.stack(observed)), torch.tensor(np.array(told))

    def hover(self, factor=1.0):
        """The action of level attitude and a thrust of the weight, [N, 4]."""
        action = torch.zeros(N, 4)
        low, high = self.box.low[3], self.box.high[3]
        action[:, 3] = 2 * (factor * MASS * G - low) / (high - low) - 1
        return action

    def by_hand(self, plan, delay, seed=3):
        """The true states [10 T + 1, N, 13] of crazyflow's own simulation, its commands late by so many substeps."""
        import jax

        self.fly(plan[:0], seed=seed)
        sim = self.drones.env.sim
        level = np.zeros((N, 4), np.float32)
        level[:, 3] = MASS * G
        commands = [scale_action(action.numpy(), self.box) for action in plan]
        sim.data, states = jax.tree.map(lambda x: x[0], self.state[0]), []
        for i in range(len(plan) * SUBSTEPS + 1):
            state = sim.data.states
            parts = [np.asarray(getattr(state, name))[:, 0] for name in ("pos", "quat", "vel", "ang_vel")]
            states.append(np.concatenate(parts, -1))
            acting = (i - delay) // SUBSTEPS if i >= delay else -1
            if acting < len(commands):
                sim.attitude_control((commands[acting] if acting >= 0 else level)[:, None])
                sim.step(1)
        self.drones._put(self.drones._initial)
        return torch.tensor(np.array(states))


program = cache(Program)


def actions(steps, size=0.3):
    generator = torch.Generator().manual_seed(0)
    return size * torch.randn(steps, N, 4, generator=generator)


def repeat(action, steps):
    return action.expand(steps, N, 4)


def test_conditions_that_change_nothing_are_none():
    nominal = {name: condition.nominal for name, condition in CONDITIONS.items()}
    assert read_ranges(nominal) == {}
    assert read_ranges({"mass": [1, 1], "wind": 0.0, "jitter": [0, 0.2]}) == {"jitter": (0.0, 0.2)}


@pytest.mark.long
def test_nominal_conditions_change_no_flight():
    """Every path of the code is taken, and what is simulated is what the environment as it is simulates."""
    env, plan = registry.make(ENV, N), actions(12)
    obs, _ = program("so_rpy").fly(plan)
    first = env.restart(3)
    torch.testing.assert_close(obs[0, 0, :, :43], first)
    for t, action in enumerate(plan, 1):
        torch.testing.assert_close(obs[t, 0, :, :43], env.step(action).next_obs, rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize(("name", "factor"), [("mass", 1.3), ("motor_gain", 0.8)])
def test_thrust_accelerates_by_its_factor_over_mass(name, factor):
    flown = program("so_rpy")
    obs, _ = flown.fly(repeat(flown.hover(), 10), {name: factor})
    plain, changed = ((obs[10, i, :, 9] - obs[0, i, :, 9]) / (10 * DT) + G for i in (0, 1))
    ratio = 1 / factor if name == "mass" else factor
    torch.testing.assert_close(changed, ratio * plain, rtol=1e-3, atol=0)


every_dynamics = [name if name == "so_rpy" else pytest.param(name, marks=pytest.mark.long) for name in DYNAMICS]


@pytest.mark.parametrize("dynamics", every_dynamics)
def test_a_heavier_and_weaker_drone_sinks(dynamics):
    flown = program(dynamics)
    obs, _ = flown.fly(repeat(flown.hover(), 20), {"rotors": 1}, {"rotors": 1, "mass": 1.2, "motor_gain": 0.9})
    drop = obs[-1, 1, :, 2] - obs[-1, 2, :, 2]
    expected = 0.5 * G * (1 - 0.9 / 1.2) * 0.4**2
    torch.testing.assert_close(drop, torch.full((N,), expected), rtol=0.15, atol=0)


@pytest.mark.parametrize("dynamics", every_dynamics)
def test_inertia_slows_the_turn(dynamics):
    flown = program(dynamics)
    tilt = flown.hover()
    tilt[:, 0] = 0.3
    obs, _ = flown.fly(repeat(tilt, 2), {"rotors": 1}, {"rotors": 1, "inertia": 3.0})
    turns = obs[-1, :, :, 10].abs().mean(1)
    assert turns[2] < 0.6 * turns[1]


@pytest.mark.long
def test_rotors_follow_in_their_time():
    """In the fitted model the rotors' thrust nears its command by exp(−t / τ)."""
    flown, factors = program("so_rpy_rotor"), (0.5, 2.0)
    obs, _ = flown.fly(repeat(flown.hover(), 25), *({"motor_time": factor} for factor in factors))
    speeds = obs[-1, 1:, :, 9].mean(1)
    params = flown.drones._initial[0].params
    tau, gain = 1 / float(params.thrust_dyn_coef.mean()), float(params.cmd_f_coef.mean())
    lost = [G * gain * f * tau * (1 - math.exp(-0.5 / (f * tau))) for f in factors]
    assert speeds[0] - speeds[1] == pytest.approx(lost[1] - lost[0], rel=0.05)


def test_the_thrust_curve_bends_in_the_middle_and_not_at_the_ends():
    flown = program("so_rpy")
    low, high = flown.box.low[3], flown.box.high[3]
    for share, more in ((0.5, 0.1), (0.25, 0.075), (1.0, 0.0)):
        action = torch.zeros(N, 4)
        action[:, 3] = 2 * share - 1
        obs, _ = flown.fly(repeat(action, 5), {"thrust_curve": 0.1})
        gain = obs[-1, 1, :, 9] - obs[-1, 0, :, 9]
        expected = 1.0232 * more * (high - low) / MASS * 5 * DT
        torch.testing.assert_close(gain, torch.full((N,), expected), rtol=2e-3, atol=1e-4)


def test_actions_that_come_late_act_as_in_a_simulation_by_hand():
    flown, plan = program("so_rpy"), actions(8)
    for late in ((3, 10), (17, 30)):
        obs, _ = flown.fly(plan, *({"action_delay": substeps * 0.002} for substeps in late))
        for point, substeps in enumerate(late, 1):
            by_hand = flown.by_hand(plan, substeps)
            torch.testing.assert_close(obs[:, point, :, :13], by_hand[::SUBSTEPS], rtol=1e-4, atol=2e-5)


def test_observations_that_are_late_are_the_states_of_then():
    flown, plan, late = program("so_rpy"), actions(8), (4, 23)
    obs, told = flown.fly(plan, *({"observation_delay": substeps * 0.002} for substeps in late))
    by_hand = flown.by_hand(plan, 0)
    for point, substeps in enumerate(late, 1):
        then = (torch.arange(9) * SUBSTEPS - substeps).clamp(min=0)
        torch.testing.assert_close(obs[:, point, :, :13], by_hand[then], rtol=1e-4, atol=2e-5)
    torch.testing.assert_close(told[:, :, 1], told[:, :, 0])  # rewards and errors are of the truth


@pytest.mark.parametrize("delay", [0.0191, 0.0199, 0.0201, 0.0395])
@pytest.mark.one_in(2)
def test_a_delay_between_steps_of_the_simulation_is_rounded_to_one(delay):
    env = registry.make("DroneFigureEightTrajectory-v0", 2, kwargs={"observation_delay": delay})
    env.restart(0)
    for _ in range(4):
        assert env.step(torch.zeros(2, 4)).obs.isfinite().all()
    env.close()


def test_the_delay_of_an_interface_has_the_jitter_in_it():
    with closing(registry.make("DroneFigureEightTrajectory-v0", 2, kwargs={"action_delay": 0.01, "jitter": 1})) as env:
        assert env.backend.interface.delay == pytest.approx((0.01, 0.03))


def test_noise_and_bias_have_their_sizes_and_rewards_are_of_the_truth():
    flown = program("so_rpy")
    obs, told = flown.fly(repeat(flown.hover(), 4), {"observation_noise": 2.0}, {"observation_bias": 2.0})
    for point, is_constant in ((1, False), (2, True)):
        error = obs[:, point, :, :13] - obs[:, 0, :, :13]
        for part, name in ((slice(0, 3), "pos"), (slice(7, 10), "vel"), (slice(10, 13), "ang_vel")):
            assert error[..., part].std() == pytest.approx(2 * NOISE[name], rel=0.1)
        assert (2 * error[..., 3:6]).std() == pytest.approx(2 * NOISE["attitude"], rel=0.1)
        assert ((error[4] - error[1])[:, :3].std() < 1e-5) == is_constant
        torch.testing.assert_close(told[:, :, point], told[:, :, 0])


def test_a_disturbed_attitude_is_a_small_rotation():
    state, noise = torch.zeros(1, 13), torch.zeros(1, 12)
    state[:, 3:7] = torch.tensor([0.1, 0.5, -0.7, 0.5])
    noise[:, 3] = 1.0
    quat = np.asarray(disturb(state.numpy(), noise.numpy()))[0, 3:7]
    x, y, z, w = state[0, 3:7].tolist()
    half = NOISE["attitude"] / 2
    turned = np.array([x + w * half, y + z * half, z - y * half, w - x * half])  # q ⊗ (half, 0, 0, 1)
    np.testing.assert_allclose(quat, turned / np.linalg.norm(turned), atol=1e-6)


def test_wind_is_a_constant_force_from_any_side():
    flown = program("so_rpy")
    obs, _ = flown.fly(repeat(flown.hover(), 10), {"wind": 0.05})
    gained = (obs[10, 1, :, 7:9] - obs[0, 1, :, 7:9]) - (obs[10, 0, :, 7:9] - obs[0, 0, :, 7:9])
    torch.testing.assert_close(gained.norm(dim=1), torch.full((N,), 0.05 / MASS * 0.2), rtol=0.02, atol=0)
    angle = torch.atan2(gained[:, 1], gained[:, 0])
    assert angle.cos().mean().abs() < 0.2
    assert angle.sin().mean().abs() < 0.2


def test_gusts_have_their_size_and_die_away():
    flown = program("so_rpy")
    obs, _ = flown.fly(repeat(flown.hover(), 51), {"gusts": 0.03})
    force = (obs[1:, 1, :, 7] - obs[:-1, 1, :, 7]) / DT * MASS
    assert force.std() == pytest.approx(0.03, rel=0.07)
    correlation = (force[:-25] * force[25:]).mean() / force.var()
    assert correlation == pytest.approx(math.exp(-1), abs=0.08)


def test_lost_actions_hold_the_one_before_and_jitter_delays_each_by_itself():
    flown = program("so_rpy")
    plan = torch.stack([flown.hover(), flown.hover(1.3)])
    obs, _ = flown.fly(plan, {"lost_actions": 0.3}, {"jitter": 1.0})
    lost, late = ((obs[2, i, :, 9] - obs[1, i, :, 9]) / DT for i in (1, 2))
    assert (lost < 1.0).float().mean() == pytest.approx(0.3, abs=0.09)
    assert ((lost < 1.0) | (lost > 2.5)).all()
    assert late.std() > 0.5
    assert late.min() < 0.6
    assert late.max() > 2.5


def test_starts_are_spread_by_their_factor():
    obs, _ = program("so_rpy").fly(actions(0), {"start_spread": 2.0}, {"start_spread": 0.0})
    plain, wide, narrow = obs[0]
    middle = torch.tensor([0.0, 0.0, 1.2])
    torch.testing.assert_close(wide[:, :3] - middle, 2 * (plain[:, :3] - middle))
    torch.testing.assert_close(wide[:, 7:10], 2 * plain[:, 7:10])
    assert (narrow[:, :3] == middle).all()


@pytest.mark.long
def test_rotors_may_turn_at_the_start():
    flown = program("first_principles")
    obs, _ = flown.fly(repeat(flown.hover(), 5), {"rotors": 1.0})
    speed = obs[-1, :2, :, 9].mean(1)
    assert speed[1] - speed[0] > 0.4


def test_the_history_is_the_change_since_then_and_what_was_done_the_newest_first():
    flown, plan = program("so_rpy"), actions(5, size=2.0)
    obs, _ = flown.fly(plan, {"observation_noise": 1.0})
    past = obs[..., 43:].unflatten(-1, (HISTORY, 17))
    for t in range(1, 6):
        for age in range(min(t, HISTORY)):
            torch.testing.assert_close(past[t, :, :, age, :13], obs[t - 1 - age, ..., :13] - obs[t, ..., :13])
            torch.testing.assert_close(past[t, 1, :, age, 13:], plan[t - 1 - age].clamp(-1, 1))
    assert (past[0, ..., :13] == 0).all()
    torch.testing.assert_close(past[0, 0, :, 1, 13:], flown.hover())


@pytest.fixture(scope="module")
def mixed():
    """Drones of two dynamics, each with a mass of its own and noisy observations, staggered."""
    kwargs = {"dynamics": ["so_rpy", "first_principles"], "mass": [0.5, 2.0], "observation_noise": 1.0}
    return registry.make(ENV, 64, stagger=True, kwargs={**kwargs, "max_episode_time": 0.2})


@pytest.mark.long
def test_each_drone_has_conditions_of_its_own_which_end_with_its_episode(mixed):
    mixed.restart(1)
    action, changed = torch.zeros(64, 4), 0
    for _ in range(12):
        before = [np.asarray(state[0].params.mass).ravel() / MASS for state in mixed.backend._state]
        step = mixed.step(action)
        done = (step.terminated | step.truncated).numpy()
        for i, (state, mass) in enumerate(zip(mixed.backend._state, before, strict=True)):
            now = np.asarray(state[0].params.mass).ravel() / MASS
            assert ((now == mass) == ~done[i::2]).all()
            np.testing.assert_allclose(now, np.asarray(state[2]["drawn"]["mass"]), rtol=1e-6)
            assert now.min() >= 0.5
            assert now.max() <= 2.0
            assert now.std() > 0.2
        changed += done.sum()
    assert changed >= 64


@pytest.mark.long
def test_rows_of_drones_that_go_on_are_not_measured_again(mixed):
    """The true next observation is the next one that is acted on, noise included, unless the episode ended."""
    mixed.restart(1)
    for _ in range(3):
        step = mixed.step(torch.zeros(64, 4))
        goes_on = ~(step.terminated | step.truncated)
        assert goes_on.any()
        assert torch.equal(mixed.obs[goes_on], step.next_obs[goes_on])


@pytest.mark.long
def test_drones_of_several_dynamics_take_turns(mixed):
    """Those of first principles that begin at the beginning, with rotors at rest, fall freely at first."""
    mixed.restart(2)
    begins = mixed.backend.counts.clone()
    action = torch.zeros(64, 4)
    action[:, 3] = 1.0
    step = mixed.step(action)
    gained = step.next_obs[:, 9]
    at_once, later = gained[0::2][begins[0::2]], gained[1::2][begins[1::2]]
    assert at_once.mean() - later.mean() > 0.1


@pytest.mark.long
def test_what_is_privileged_is_the_truth_about_each_drone_and_changes_no_flight():
    kwargs = {
        "dynamics": ["so_rpy", "first_principles"],
        "mass": [0.5, 2.0],
        "action_delay": 0.02,
        "rotors": [0.2, 1.0],
    }
    kwargs |= {"wind": [0.0, 0.1], "max_episode_time": 0.2}
    plain, told = (registry.make(ENV, 64, kwargs=kwargs | {"privileged": privileged}) for privileged in (False, True))
    assert (plain.spec.privileged, told.spec.privileged) == (0, 4 + 3 + 4 + len(DYNAMICS))
    assert told.spec.fits(plain.spec)
    plain.restart(1), told.restart(1)
    assert told.spec.observation_size == plain.spec.observation_size == plain.obs.shape[1]
    for _ in range(12):  # beyond the end of episodes
        size = plain.spec.observation_size
        assert torch.equal(told.obs[:, :size], plain.obs)
        for i, state in enumerate(told.backend._state):
            hidden, (data, _, air) = told.obs[i::2, size:].numpy(), state
            masses = np.asarray(data.params.mass).ravel() / MASS
            np.testing.assert_allclose(hidden[:, 0], (masses - 1.25) / 0.75, atol=1e-5)
            assert (hidden[:, 1] == 0).all()  # a condition that is a number has no place in a range
            np.testing.assert_allclose(
                np.linalg.norm(hidden[:, 4:7], axis=1), np.asarray(air["drawn"]["wind"]) / 0.1, atol=1e-5
            )
            rotors = np.asarray(data.states.rotor_vel).reshape(32, -1)
            if i == 0:
                assert (hidden[:, -8:-4] == 0).all()
            else:
                np.testing.assert_allclose(hidden[:, -8:-4], rotors / hovering(data), rtol=1e-4)
            assert (hidden[:, -4:] == np.eye(4)[3 * i]).all()
        action = torch.rand(64, 4) * 2 - 1
        plain.step(action), told.step(action)


def hovering(data):
    """The rotor speed at which four rotors carry the nominal drone, by bisection."""
    k0, k1, k2 = map(float, np.asarray(data.params.rpm2thrust).reshape(-1, 3)[0])
    low, high = 0.0, 1e5
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if 4 * (k0 + k1 * middle + k2 * middle**2) < MASS * G else (low, middle)
    return low


@pytest.mark.parametrize(
    "algorithm", ["ppo", *(pytest.param(name, marks=pytest.mark.long) for name in ("reppo", "sac"))]
)
def test_critics_are_told_what_policies_are_not(algorithm, tmp_path):
    kwargs = {"mass": [0.5, 2.0], "privileged": True, "max_episode_time": 0.4}
    fields = {"num_envs": 8, "total_steps": 64, "hidden": (16,), "compile": "off", "env_kwargs": kwargs}
    fields |= {"batch_size": 8, "learning_starts": 16} if algorithm == "sac" else {"num_steps": 4, "minibatch_size": 16}
    run = lem.train(algorithm, ENV, preset="default", run=tmp_path / "run", progress=False, **fields)
    networks, size = run.policy.networks, run.policy.spec.observation_size
    known = torch.randn(5, size + run.policy.spec.privileged)
    other = torch.cat([known[:, :size], torch.randn(5, run.policy.spec.privileged)], dim=1)
    for obs in (other, known[:, :size]):
        assert torch.equal(networks.policy(obs).mode(), networks.policy(known).mode())
    critic = (
        networks.value if algorithm == "ppo" else networks.critic if algorithm == "reppo" else networks.critics.first
    )
    values = [critic(obs) if algorithm == "ppo" else critic(obs, torch.zeros(5, 4)) for obs in (known, other)]
    assert not (values[0] == values[1]).any()
    assert lem.evaluate(run.policy, episodes=2).returns == lem.evaluate(lem.load(run.path), episodes=2).returns
    assert fly(run.policy, act_with(run.policy), rows=20)[0].obs.shape[-1] == size
    flat = run.policy.act(np.zeros(size, np.float32))
    assert flat.shape == (4,)


def test_margins_need_nothing_that_is_privileged():
    trained = {"mass": [0.5, 2.0], "privileged": True}
    assert CrazyflowBackend.probe(ENV, 4, trained, {}).spec.privileged == 0


@pytest.mark.parametrize(
    ("kwargs", "sentence"),
    [
        ({"mass": [1.2, 0.8]}, "mass has a range whose low end 1.2 is above its high end 0.8."),
        ({"mass": "heavy"}, "mass must be a number or a range [low, high], not 'heavy'."),
        ({"mass": [1, 2, 3]}, "mass must be a number or a range"),
        ({"mass": True}, "mass must be a number or a range"),
        ({"mass": 0}, "mass must be from 0.2 to 3 (factor of the mass), not 0."),
        ({"mass": float("nan")}, "mass must be from 0.2 to 3"),
        ({"action_delay": -0.01}, "action_delay must be from 0 to 0.2"),
        ({"dynamics": "second_principles"}, "second_principles"),
        ({"dynamics": ["so_rpy", "warp"]}, "warp"),
        ({"dynamics": ["so_rpy", "so_rpy_rotor", "so_rpy_rotor_drag"]}, "8 drones cannot be divided equally among 3"),
        ({"history": -1}, "history must be a whole number of steps from 0 to 50, not -1."),
        ({"history": 2.5}, "history must be a whole number of steps"),
        ({"winds": 1}, "winds"),
        ({"privileged": 1}, "privileged must be true or false, not 1."),
    ],
)
def test_what_is_no_condition_has_its_sentence(kwargs, sentence):
    with pytest.raises(UserError) as error:
        registry.make(ENV, 8, kwargs=kwargs)
    assert sentence in str(error.value)
    assert str(error.value).count("\n") == 0


def test_the_page_names_every_condition_with_its_nominal_value():
    page = (Path(__file__).parents[2] / "docs" / "vehicle.md").read_text()
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| `")]
    named = {name: row[-1].strip(" |") for row in rows for name in re.findall(r"`(\w+)`", row[0])}
    for name, condition in CONDITIONS.items():
        assert float(named[name]) == condition.nominal, name
