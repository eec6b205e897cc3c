"""The race through gates: its rules against numbers worked out by hand, its levels, its contacts against MuJoCo's."""

import json
import math
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

import lemniscate as lem
from lemniscate.envs import registry
from lemniscate.errors import UserError

jax = pytest.importorskip("jax")
pytest.importorskip("crazyflow")

from lemniscate.drones.crazyflow import _import, make_drones

_import()

from scipy.spatial.transform import Rotation

from lemniscate.drones import gates


@pytest.fixture(scope="module")
def racing():
    """64 races of a level, made once."""
    made = {}

    def get(level, **kwargs):
        key = level, json.dumps(kwargs)
        if key not in made:
            made[key] = make_drones("DroneGates-v0", 64, "cpu", {"level": level, **kwargs}, None, {})
            made[key].restarted, made[key].seen = begun(made[key])
        return made[key]

    return get


def begun(drones, seed=0):
    """The state in which races begin, and what is observed there."""
    import jax.numpy as jnp

    every = jnp.ones(drones.num_envs, bool)
    return drones.reset(drones.init(jax.random.key(seed)), every, jnp.array(False))[:2]


@pytest.mark.parametrize(
    ("before", "now", "passed"),
    [
        ((-0.1, 0, 0), (0.1, 0, 0), True),
        ((0.1, 0, 0), (-0.1, 0, 0), False),  # the wrong way
        ((-0.2, 0, 0), (-0.1, 0, 0), False),
        ((-0.1, 0.224, 0), (0.1, 0.224, 0), True),
        ((-0.1, 0.226, 0), (0.1, 0.226, 0), False),
        ((-0.1, 0, -0.226), (0.1, 0, -0.226), False),
        ((-0.1, 0.1, 0), (0.3, 0.5, 0), True),  # the plane is cut at y = 0.2
        ((-0.3, 0.1, 0), (0.1, 0.3, 0), False),  # at 0.25
        ((-0.1, 0, 0), (0.0, 0, 0), True),  # a step that ends on the plane
        ((0.0, 0, 0), (0.1, 0, 0), False),  # counted before
    ],
)
def test_a_gate_is_passed_from_behind_and_near_its_centre(before, now, passed):
    assert bool(gates.passes(*(np.array(at, np.float32) for at in (before, now)))) is passed


def test_the_way_to_a_gate_leads_around_it():
    places = ((-2, 0, 0), (-0.3, 0.4, 0), (0.3, 0, 0), (0.3, 0.51, 0))
    way = [float(gates.way_left(np.array(at, np.float32))) for at in places]
    corner = math.hypot(2 * 0.51, 0.3) + 0.3  # from beside the frame to in front of it, and to the centre
    aside = math.hypot(0.3, 2 * 0.4)  # which counts double
    assert way == pytest.approx([2, aside, math.hypot(0.3, 0.51) + corner, 0.3 + corner], abs=1e-6)


def test_a_gate_is_flown_along_its_x_axis_turned_by_roll_pitch_and_yaw(racing):
    import jax.numpy as jnp

    angles = np.random.default_rng(0).uniform(-3, 3, (64, 3)).astype(np.float32)
    drones = racing(0)
    with drones._at(drones.restarted) as env:
        poses = jnp.asarray(np.concatenate([np.ones((64, 3)), angles], axis=1))[:, None].repeat(4, axis=1)
        centre, turned = env._frame(jnp.zeros(64, jnp.int32), poses)
    assert np.asarray(centre) == pytest.approx(np.ones((64, 3)))
    for (roll, pitch, yaw), found in zip(angles, np.asarray(turned), strict=True):
        x, y, z = (np.array(rows) for rows in (
            ((1, 0, 0), (0, math.cos(roll), -math.sin(roll)), (0, math.sin(roll), math.cos(roll))),
            ((math.cos(pitch), 0, math.sin(pitch)), (0, 1, 0), (-math.sin(pitch), 0, math.cos(pitch))),
            ((math.cos(yaw), -math.sin(yaw), 0), (math.sin(yaw), math.cos(yaw), 0), (0, 0, 1)),
        ))  # fmt: skip
        assert found == pytest.approx(z @ y @ x, abs=1e-5)


def distance_in_mujoco(centre, quat, low, high):
    """The distance between the drone's box and another, which MuJoCo finds."""
    half, middle = (high - low) / 2, (high + low) / 2
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody>"
        f"<geom type='box' size='{' '.join(map(str, half))}' pos='{' '.join(map(str, middle))}'/>"
        f"<body mocap='true' pos='{' '.join(map(str, centre))}' quat='{' '.join(map(str, np.roll(quat, 1)))}'>"
        f"<geom type='box' size='{' '.join(map(str, gates.BODY))}'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None)


def test_contacts_are_those_that_mujoco_finds():
    rng, low, high = np.random.default_rng(1), *gates._boxes(1.0)
    which = rng.integers(5, size=1_500)
    at = rng.uniform(low[which] - 0.12, high[which] + 0.12).astype(np.float32)
    quat = rng.normal(size=(1_500, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    turned = Rotation.from_quat(quat).as_matrix().astype(np.float32)
    touching = np.asarray(gates.touches(at, turned, low[which], high[which]))
    found = near = 0
    for i, box in enumerate(which):
        distance = distance_in_mujoco(at[i], quat[i], low[box], high[box])
        found += distance < 0
        if abs(distance) < 1e-4:  # MuJoCo's own precision
            near += 1
        else:
            assert touching[i] == (distance < 0), (box, at[i], quat[i], distance)
    said = touching.sum()
    assert 300 < said < 1_200
    assert 300 < found < 1_200
    assert near < 30


def test_a_gate_is_a_frame_with_an_opening_and_a_stand():
    low, high = gates._boxes(2.0)

    def inside(*at):
        return bool(((np.array(at) >= low - 1e-6) & (np.array(at) <= high + 1e-6)).all(1).any())

    assert not inside(0, 0, 0)
    assert not inside(0, 0.199, 0.199)
    assert inside(0, 0.201, 0)
    assert inside(0.009, 0.359, -0.359)
    assert not inside(0.011, 0.3, 0)
    assert not inside(0, 0, 0.361)
    assert inside(0.049, 0.049, -1)
    assert not inside(0, 0.051, -1)


def test_the_course_is_the_laboratorys():
    track = gates.read_track()
    assert track.gates[:, [0, 1, 2, 5]].tolist() == pytest.approx(np.float32([
        [0.5, 0.25, 0.7, -0.78], [1.05, 0.75, 1.2, 2.35], [-1.0, -0.25, 0.7, 3.14], [0.0, -0.75, 1.2, 0.0]
    ]))  # fmt: skip
    assert track.obstacles[:, :2].tolist() == [[0, 0.75], [1, 0.25], [-1.5, -0.25], [-0.5, -0.75]]
    assert track.start.tolist() == pytest.approx([-1.5, 0.75, 0.01])
    assert track.order.tolist() == [0, 1, 2, 3]
    assert not track.reverse.any()


def test_a_level_draws_what_it_says_and_no_more(racing):
    drawn = {}
    for level in range(4):
        drones = racing(level)
        states = [begun(drones, seed)[0] for seed in range(12)]
        parts = {
            "pos": [data.states.pos[:, 0] for data, _, _ in states],
            "mass": [data.params.mass.reshape(64, -1) for data, _, _ in states],
            "inertia": [np.diagonal(data.params.J.reshape(64, 3, 3), axis1=1, axis2=2) for data, _, _ in states],
            "gates": [arrays["_gates"] - arrays["_expected_gates"] for _, arrays, _ in states],
            "obstacles": [arrays["_obstacles"] - arrays["_expected_obstacles"] for _, arrays, _ in states],
            "track": [arrays["_expected_gates"] for _, arrays, _ in states],
        }
        drawn[level] = {name: np.concatenate([np.asarray(a) for a in each]) for name, each in parts.items()}
    start = gates.read_track().start
    for level, parts in drawn.items():
        spread = {name: np.ptp(values, axis=0) for name, values in parts.items()}
        if level == 0:
            assert all(not each.any() for each in spread.values())
            continue
        assert np.abs(parts["mass"] - 0.0434).max() == pytest.approx(0.005, rel=0.02)
        assert spread["inertia"] == pytest.approx(2e-6, rel=0.02)
        if level < 3:
            assert np.abs(parts["pos"] - start)[:, :2].max(0) == pytest.approx(0.1, rel=0.02)
            assert (parts["pos"] - start)[:, 2].min() >= 0
            assert (parts["pos"] - start)[:, 2].max() == pytest.approx(0.02, rel=0.02)
            assert not spread["track"].any()
        if level == 1:
            assert not spread["gates"].any()
            assert not spread["obstacles"].any()
        else:
            most = np.abs(parts["gates"]).max(0)
            assert most == pytest.approx(np.tile(gates.SPREAD["gate"], (4, 1)), rel=0.03)
            assert np.abs(parts["obstacles"]).max(0) == pytest.approx(
                np.tile(gates.SPREAD["obstacle"], (4, 1)), rel=0.03
            )
    assert (spread["track"][:, :2] > 1.5).all()
    assert not spread["track"][:, 2].any()  # heights stay


def test_a_drawn_track_has_room(racing):
    drones = racing(3)
    apart = []
    for seed in range(8):
        (data, arrays, _), _ = begun(drones, seed)
        track, obstacles = np.asarray(arrays["_expected_gates"]), np.asarray(arrays["_expected_obstacles"])
        assert (np.abs(track[..., 0]) <= 2.0).all()
        assert (np.abs(track[..., 1]) <= 1.0).all()
        centres = track[..., :2]
        between = np.linalg.norm(centres[:, :, None] - centres[:, None], axis=-1)[:, *np.triu_indices(4, 1)]
        to_obstacles = np.linalg.norm(centres[:, :, None] - obstacles[:, None, :, :2], axis=-1)
        apart.append(((between.min(1) >= 1.0) & (to_obstacles.min((1, 2)) >= 0.8)).mean())
        start = np.asarray(data.states.pos[:, 0])
        way = centres[:, 0] - (start[:, :2])
        off = (track[:, 0, 5] - np.arctan2(*way.T[::-1]) + np.pi) % (2 * np.pi) - np.pi
        assert (np.abs(off) < 0.75 + 0.25).all()  # a drone begins up to 0.14 m from where its track does
    assert np.mean(apart) > 0.6  # the room is too small for all wishes of some


def test_the_true_place_is_known_from_near_and_stays_known(racing):
    import jax.numpy as jnp

    drones = racing(2)
    state = drones.restarted
    seen = np.asarray(state[1]["_gates_seen"])
    assert not seen.any()
    gate = np.asarray(state[1]["_gates"])[:, 0]
    for away, known in ((0.71, False), (0.69, True), (3.0, True)):
        data, arrays, air = state
        pos = jnp.asarray(gate[:, :3] + np.float32((away, 0, 0.5)))
        with drones._at((data.replace(states=data.states.replace(pos=pos[:, None])), arrays, air)) as env:
            env._look()
            state = (*drones._take(), air)
        assert (np.asarray(state[1]["_gates_seen"])[:, 0] == known).all()
        with drones._at(state) as env:
            believed = np.asarray(env.obs()["gates"])[:, :3] + np.asarray(pos)
        expected = gate[:, :3] if known else np.asarray(state[1]["_expected_gates"])[:, 0, :3]
        assert believed == pytest.approx(expected, abs=1e-5)


def test_what_was_seen_stays_known_from_afar():
    race = SimpleNamespace(_gates=np.zeros((1, 2, 6)), _obstacles=np.zeros((1, 3, 3)))
    race._gates_seen, race._obstacles_seen = np.zeros((1, 2), bool), np.zeros((1, 3), bool)
    for x, known in ((1.0, False), (0.4, True), (1.0, True)):
        race.sim = SimpleNamespace(data=SimpleNamespace(states=SimpleNamespace(pos=np.full((1, 1, 3), x))))
        gates.DroneGates._look(race)
        assert (np.asarray(race._gates_seen) == known).all()
        assert (np.asarray(race._obstacles_seen) == known).all()


def test_the_force_is_drawn_for_each_step_of_the_simulator(racing):
    data = racing(0).restarted[0]
    seen = []

    def integrate(data):
        seen.append(np.asarray(data.states.force))
        return data

    for _ in range(40):
        data = gates.integrate_pushed(data, integrate)
    forces = np.stack(seen)
    assert np.abs(forces).max() == pytest.approx(0.1, rel=0.02)
    assert forces.std() == pytest.approx(0.1 / math.sqrt(3), rel=0.03)
    assert np.corrcoef(forces[:-1].ravel(), forces[1:].ravel())[0, 1] == pytest.approx(0, abs=0.05)
    assert not np.asarray(data.states.force).any()  # a wind is not added up


def where(env, pos):
    """Whether drones at these positions, level, have crashed."""
    import jax.numpy as jnp

    turned = jnp.broadcast_to(jnp.eye(3), (len(pos), 3, 3))
    return np.asarray(env._leaves(jnp.asarray(pos, jnp.float32))), np.asarray(
        env._touches(jnp.asarray(pos, jnp.float32), turned)
    )


def test_a_race_ends_outside_on_the_ground_and_at_what_stands(racing):
    drones = racing(0)
    cases = [
        ((-1.5, 0.75, -0.001), False, False),  # on the ground, at the start
        ((-1.47, 0.75, -0.001), True, False),  # away from it
        ((2.49, 0, 1), False, False),
        ((2.51, 0, 1), True, False),
        ((0, -1.51, 1), True, False),
        ((0, 1.0, 2.01), True, False),
        ((0.5, 0.25, 0.68), False, False),  # the middle of gate 1
        ((0.5, 0.25, 0.68 - 0.19), False, True),  # its lower beam
        ((0, 0.75 + 0.08, 1), False, True),  # an obstacle, 1.5 cm thick and 7 cm away
        ((0, 0.75 + 0.095, 1), False, False),
        ((0, 0.75, 1.60), False, False),  # above it
    ]
    pos = np.array([at for at, _, _ in cases] + [(0, 0, 1)] * (64 - len(cases)), np.float32)
    with drones._at(drones.restarted) as env:
        left, touched = where(env, pos)
    assert left[: len(cases)].tolist() == [case[1] for case in cases]
    assert touched[: len(cases)].tolist() == [case[2] for case in cases]


def test_a_flight_through_all_gates_is_counted(racing):
    """Drones are put through the gates by hand, one step before and one behind each."""
    import jax.numpy as jnp

    drones = racing(0)
    state, passed, rewards = drones.restarted, [], []
    for number in range(4):
        for side in (-0.1, 0.1):
            data, arrays, air = state
            with drones._at(state) as env:
                centre, turned = env._frame(jnp.full(64, number), arrays["_gates"])
                pos = centre + side * turned[:, :, 0] - jnp.array((0, 0, 0.02))
                env.sim.data = data.replace(states=data.states.replace(pos=pos[:, None]))
                env.advance(jnp.zeros((64, 4)))
                rewards.append(float(env.reward()[0]))
                assert bool(env.terminated()[0]) == (number == 3 and side > 0)
                passed.append(int(env._target[0]))
                measures = {name: float(value[0]) for name, value in env.measures().items()}
                assert math.isnan(measures["success"]) == (len(passed) < 8)
                state = (*drones._take(), air)
    assert passed == [0, 1, 1, 2, 2, 3, 3, 4]
    assert measures["gates_passed"] == 4
    assert measures["lap_seconds"] == 0  # the simulator was not asked to step
    assert measures["success"] == 1
    assert measures["crashed"] == 0
    assert all(reward > 3 for reward in rewards[1::2])


def test_a_crash_costs_what_is_said(racing):
    import jax.numpy as jnp

    rewards = []
    for drones in (racing(0), racing(0, crash=20)):
        data = drones.restarted[0]
        with drones._at(drones.restarted) as env:
            env.sim.data = data.replace(states=data.states.replace(pos=jnp.full((64, 1, 3), 9.0)))
            env.advance(jnp.zeros((64, 4)))
            rewards.append(np.asarray(env.reward()))
    assert rewards[0] - rewards[1] == pytest.approx(np.full(64, 14.0), abs=1e-3)


def raced(path, **kwargs):
    """A short training of 4 drones at level 2, in episodes of 2 s."""
    fields = {"num_envs": 4, "num_steps": 64, "total_steps": 1_024, "minibatch_size": 64, "epochs": 2, "seed": 1}
    kwargs = {"level": 2, "max_episode_time": 2.0, **kwargs}
    return lem.train("ppo", "DroneGates-v0", env_kwargs=kwargs, run=path, progress=False, **fields)


@pytest.fixture(scope="module")
def race(tmp_path_factory):
    """A short training with attitudes as actions."""
    return raced(tmp_path_factory.mktemp("race") / "run")


def require_measures(run):
    found = lem.evaluate(run.policy, episodes=4)
    assert {"gates_passed", "success", "crashed"} <= found.measures.keys()
    assert math.isnan(found.measures["lap_seconds"]) == (found.measures["success"] == 0)


def test_a_race_trains_and_is_evaluated(race):
    require_measures(race)


def test_body_rates_are_followed(tmp_path):
    require_measures(run := raced(tmp_path / "run", control="body_rate"))
    # Of the same size, since the training has compiled its program.
    env = registry.make("DroneGates-v0", 4, kwargs=run.policy.config.env_kwargs)
    env.restart(0)
    action = torch.tensor([[0.2, 0.0, 0.0, 0.6], [0.0, -0.2, 0.0, 0.6]]).repeat(2, 1)
    rates = [env.step(action).next_obs[:, 10:13] for _ in range(6)][-1]
    assert rates[0, 0] == pytest.approx(2.0, abs=0.7)
    assert rates[1, 1] == pytest.approx(-2.0, abs=0.7)


TRACK = """
order = [1, -1]
start = [-1.0, 0.0, 0.5]
room = { low = [-2, -2, 0], high = [2, 2, 2] }
[[gates]]
position = [0.0, 0.0, 1.0]
"""


def test_a_track_of_ones_own_is_read(racing, tmp_path):
    (tmp_path / "track.toml").write_text(TRACK)
    track = gates.read_track(tmp_path / "track.toml")
    assert (track.order.tolist(), track.reverse.tolist()) == ([0, 0], [False, True])
    obs = np.asarray(racing(0, track=str(tmp_path / "track.toml")).seen)
    assert obs[:, 16:19] == pytest.approx(np.array([[1.0, 0, 0]] * 64), abs=1e-6)  # the direction of the first
    assert obs[:, 22:25] == pytest.approx(np.array([[-1.0, 0, 0]] * 64), abs=1e-6)  # and of the same, in reverse


@pytest.mark.parametrize(
    ("kwargs", "said"),
    [
        ({"level": 4}, "level of DroneGates-v0 must be 0, 1, 2 or 3, not 4"),
        ({"level": True}, "level of DroneGates-v0 must be 0, 1, 2 or 3, not True"),
        ({"control": "thrust"}, "control of DroneGates-v0 must be attitude or body_rate, not 'thrust'"),
        ({"control": "body_rate", "dynamics": "so_rpy"}, "body_rate needs the dynamics first_principles"),
        ({"crash": -1}, "crash of DroneGates-v0 must be a number from 0 on, what a crash costs, not -1"),
        ({"crash": True}, "crash of DroneGates-v0 must be a number from 0 on, what a crash costs, not True"),
        ({"track": "none.toml"}, "none.toml is no track"),
        ({"dynamics": 3}, "There is no dynamics '3'"),
        ({"dynamics": "so_rpy", "mass": 10**400}, "mass must be from"),
        ({"track": ""}, "is no track"),
        ({"track": 3}, "track of DroneGates-v0 must be the path of a file, not 3"),
        ({"freq": 0}, "freq of DroneGates-v0 must be a whole number that divides 500, not 0"),
        ({"freq": "50"}, "freq of DroneGates-v0 must be a whole number that divides 500, not '50'"),
        ({"freq": 60}, "freq of DroneGates-v0 must be a whole number that divides 500, not 60"),
        ({"max_episode_time": -1}, "must be seconds, more than the 0.02 of a step, not -1"),
        ({"max_episode_time": math.nan}, "must be seconds, more than the 0.02 of a step, not nan"),
        ({"drone": "cf2x"}, "did you mean cf2x_"),
        ({"levle": 1}, "did you mean level"),
    ],
)
def test_what_is_wrong_is_said(kwargs, said):
    with pytest.raises(UserError, match=said.replace("?", r"\?")):
        registry.make("DroneGates-v0", 2, kwargs=kwargs)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("order = [1, -1]", "order = [2]"), "order names gates from 1 to 1"),
        (("order = [1, -1]", "order = []"), "order names gates from 1 to 1"),
        (("position = [0.0, 0.0, 1.0]", "position = [0.0, 1.0]"), "is no track"),
        (("start = [-1.0, 0.0, 0.5]", ""), "lacks 'start'"),
        (("[[gates]]", "[gates"), "is no track"),
        (("[[gates]]", "[gates]"), r"gates are tables, each below \[\[gates\]\], not {'position"),
        (("order = [1, -1]", "order = 1"), "order names gates from 1 to 1, with a minus if in reverse, not 1"),
        (("order = [1, -1]", "order = [1.0]"), r"not \[1.0\]"),
        (("order = [1, -1]", "order = [true]"), r"not \[True\]"),
        (("order = [1, -1]", "order = [[1], [1]]"), r"not \[\[1\], \[1\]\]"),
        (("position = [0.0, 0.0, 1.0]", "position = [0.0, 0.0, nan]"), "position of gates 1 must be three numbers"),
        (("position = [0.0, 0.0, 1.0]", "position = [0.0, 0.0, 900.0]"), "room must reach from low to high, in metres"),
        (
            ("position = [0.0, 0.0, 1.0]", "position = [0.0, 0.0, 1.0]\nyawn = 1"),
            "gates 1 has 'yawn', and may have name, pos",
        ),
        (("position = [0.0, 0.0, 1.0]", "position = [0.0, 0.0, 1.0]\nyaw = 90"), "are radians, at most 2 π"),
        (
            ("position = [0.0, 0.0, 1.0]", "position = [0, 0, 1]\n[[obstacles]]\nposition = [0, 1]"),
            "obstacles 1 must be",
        ),
        (("position = [0.0, 0.0, 1.0]", "position = [0, 0, 1]\n[speed]"), "it has 'speed', and may have name, order"),
        (("start = [-1.0, 0.0, 0.5]", "start = [-9.0, 0.0, 0.5]"), "with the start and all gates between"),
    ],
)
def test_what_is_wrong_with_a_track_is_said(change, said, tmp_path):
    (tmp_path / "track.toml").write_text(TRACK.replace(*change))
    with pytest.raises(UserError, match=said):
        gates.read_track(tmp_path / "track.toml")


def test_what_begins_on_its_way_begins_behind_a_gate(racing):
    import jax.numpy as jnp

    drones = racing(2)
    every, shares = jnp.ones(64, bool), []
    (data, arrays, _), _, ahead = drones.reset(drones.init(jax.random.key(3)), every, jnp.array(True))
    ahead, target = np.asarray(ahead), np.asarray(arrays["_target"])
    assert 0.5 < ahead.mean() < 0.95
    assert (np.asarray(arrays["_whole"]) == ~ahead).all()  # of the others nothing is measured
    assert (target[~ahead] == 0).all()
    assert set(target[ahead]) == {1, 2, 3}
    passed = np.asarray(arrays["_gates"])[np.arange(64), np.maximum(target - 1, 0)]
    direction = np.stack([np.cos(passed[:, 5]), np.sin(passed[:, 5])], axis=1)
    behind = ((np.asarray(data.states.pos)[:, 0, :2] - passed[:, :2]) * direction).sum(1)
    assert (behind[ahead] > 0.05).all()
    for begun_, here in (
        (arrays["_gates"], arrays["_expected_gates"]),
        (arrays["_obstacles"], arrays["_expected_obstacles"]),
    ):
        shares.append(np.abs(np.asarray(begun_) - np.asarray(here))[ahead].mean())
    assert 0.03 < shares[0] < 0.07  # two thirds of what the level says
    assert np.asarray(arrays["_before"]) == pytest.approx(np.asarray(data.states.pos)[:, 0])


def test_the_critic_is_told_where_the_gates_are(racing):
    moved = racing(2, privileged=True)
    assert moved.privileged == 14
    away = np.abs(moved.seen[:, -6:])
    assert (away > 1e-3).any(1).all()
    assert (away <= np.array([0.15, 0.15, 0.1] * 2) + 1e-5).all()
    assert not racing(0, privileged=True).seen[:, -6:].any()


@pytest.mark.long
def test_the_air_of_a_vehicle_is_that_of_a_race():
    """Late actions, wind, wider starts and several dynamics at once; a wider start is about the track's."""
    kwargs = {
        "level": 1,
        "dynamics": ["first_principles", "so_rpy"],
        "action_delay": 0.02,
        "wind": 0.05,
        "start_spread": 2.0,
    }
    env = registry.make("DroneGates-v0", 64, kwargs=kwargs)
    obs = env.restart(0)
    aside = (obs[:, :2] - torch.tensor([-1.5, 0.75])).abs()
    assert 0.15 < aside.max() < 0.201
    step = env.step(torch.zeros(64, 4))
    assert torch.isfinite(step.next_obs).all()
    assert not step.terminated.any()
    assert env.scene.boxes().shape == (64, 4 * 5 + 4, 15)


def test_what_stands_there_is_drawn(racing):
    boxes = racing(2).env.boxes(racing(2).restarted[1])
    assert boxes.shape == (64, 4 * 5 + 4, 15)
    assert not np.allclose(boxes[0], boxes[1])


@pytest.mark.long
def test_a_race_is_drawn_and_filmed(race, tmp_path):
    files = lem.plot(race)
    assert "flight.png" in {file.name for file in files}
    assert "error.png" not in {file.name for file in files}
    env = registry.make("DroneGates-v0", 4, kwargs=race.policy.config.env_kwargs)
    env.restart(0)
    assert env.scene.boxes().shape == (4, 4 * 5 + 4, 15)
    video = tmp_path / "race.gif"
    lem.watch(race.policy, episodes=1, video=video)
    assert video.stat().st_size > 10_000


NEAR = """
order = [1]
start = [-0.15, 0.0, 1.05]
room = { low = [-2, -2, 0], high = [2, 2, 2] }
[[gates]]
position = [0.0, 0.0, 1.0]
"""


@pytest.mark.long
def test_a_preflight_knows_a_finish_from_a_crash(tmp_path):
    from lemniscate.drones.probe import DroneProbe

    def flown(near):
        (tmp_path / "track.toml").write_text(NEAR if near else NEAR.replace("[0.0, 0.0, 1.0]", "[0.0, 1.5, 1.0]"))
        kwargs = {"track": str(tmp_path / "track.toml"), "max_episode_time": 2.0}
        probe = DroneProbe("DroneGates-v0", 4, kwargs, ("first_principles",))
        ahead = torch.tensor([0.0, 0.35, 0.0, 0.3]).expand(1024, 4)  # pitched by 0.55 rad
        nominal, _ = probe.fly(lambda: lambda obs: ahead[: len(obs)], 0)
        return nominal

    finished, crashed = flown(near=True), flown(near=False)
    assert not finished.terminated.any()
    assert (finished.returns > crashed.returns + 3).all()  # what a gate is worth
    assert crashed.terminated.all()  # it flies on, out of the room


def test_a_track_is_what_its_file_holds_now(tmp_path, monkeypatch):
    """Programs are kept by their arguments; to compile others would take half a minute."""
    file, kept = tmp_path / "track.toml", []

    def programs(*given):
        kept.append(given)
        raise UserError("that is all")

    monkeypatch.setattr("lemniscate.drones.crazyflow.programs", programs)
    for text in (TRACK, TRACK, TRACK.replace("start = [-1.0", "start = [-1.1")):
        file.write_text(text)
        with pytest.raises(UserError, match="that is all"):
            registry.make("DroneGates-v0", 2, kwargs={"track": str(file)})
    assert kept[0] == kept[1] != kept[2]
    monkeypatch.setenv("HOME", str(file.parent))
    file.write_bytes(b"\xef\xbb\xbf" + TRACK.encode())  # as Notepad writes it
    assert gates.text_of_track(f"~/{file.name}") == TRACK + "\n"
    file.write_text(TRACK.replace("start = [-1.0", "start = [nan"))
    with pytest.raises(UserError, match=r"track\.toml is no track: start must be three numbers"):
        registry.make("DroneGates-v0", 2, kwargs={"track": str(file)})
