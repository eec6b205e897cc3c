"""Mirror images of robots: derived from their models, proved by stepping, and learned from."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco.ant_v5 import AntEnv
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv

import lemniscate as lem
from conftest import tiny_off_policy
from lemniscate.algos import find, reppo
from lemniscate.envs.symmetry import find_mirror
from lemniscate.errors import UserError
from lemniscate.run import checkpoint
from lemniscate.run.environments import make_envs
from lemniscate.types import Transition


def mirror_of(env, **kwargs):
    return find_mirror(env, kwargs, ())


class LimpingAnt(AntEnv):
    """An ant with one leg whose joint is damped more than that of the others; its shape is symmetric."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.model.dof_damping[8] *= 1.5


class SignsAnt(AntEnv):
    """An ant whose hips are commanded with either sign, in a plane observation of its own order."""

    def __init__(self, **kwargs):
        super().__init__(include_cfrc_ext_in_observation=False, **kwargs)
        self.model.actuator_gear[2, 0] *= -1
        self._order = np.random.default_rng(3).permutation(27)

    def _get_obs(self):
        return super()._get_obs()[getattr(self, "_order", slice(None))]


class OneEyedWalker(Walker2dEnv):
    """A walker that does not see its left hip, but the right one times two in its place."""

    def _get_obs(self):
        obs = super()._get_obs()
        obs[5] = 2 * obs[2]
        return obs


class Pole(gym.Env):
    """x' = x + a, with its mirror given."""

    observation_space = gym.spaces.Box(-10, 10, (3,), dtype=np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), dtype=np.float32)
    mirror = [-1, 3, 2], [2, 1]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._at = self.np_random.uniform(-1, 1, 3).astype(np.float32)
        return self._at, {}

    def step(self, action):
        self._at = np.clip(0.9 * self._at + 0.1 * action[0], -10, 10).astype(np.float32)
        return self._at, float(-abs(self._at[0])), False, False, {}


class WronglyMirrored(Pole):
    mirror = [-2, 3, 1], [2, 1]


class OneList(Pole):
    mirror = ([1, 2, 3],)


class Uneven(Pole):
    action_space = gym.spaces.Box(np.array([-1, -2], np.float32), np.array([1, 2], np.float32))


def wrapped_pole():
    return gym.wrappers.TransformObservation(Pole(), lambda obs: obs[::-1], Pole.observation_space)


def swimmer(low, high, rescaled):
    """A swimmer with other bounds: its actions are those of the swimmer itself, or are brought to these bounds."""
    env, low, high = gym.make("Swimmer-v5"), np.float32(low), np.float32(high)
    if rescaled:
        return gym.wrappers.RescaleAction(env, low, high)
    return gym.wrappers.TransformAction(env, lambda action: action, gym.spaces.Box(low, high, (2,), np.float32))


# of each robot by hand, from its model: what a mirrored position takes, and with which sign; velocities alike
ANT = [0, 1, 2, 3, 4, 5, 6, 13, 14, 11, 12, 9, 10, 7, 8], [1, -1, 1, 1, -1, 1, -1, *[-1, 1] * 4]
ANT_SPEED = [0, 1, 2, 3, 4, 5, 12, 13, 10, 11, 8, 9, 6, 7], [1, -1, 1, -1, 1, -1, *[-1, 1] * 4]
WALKER = [0, 1, 2, 6, 7, 8, 3, 4, 5], [1] * 9
SWIMMER = [0, 1, 2, 3, 4], [1, -1, -1, -1, -1]
ROBOTS = {
    "Ant-v5": (ANT, ANT_SPEED),
    "test_symmetry:SignsAnt": (ANT, ANT_SPEED),
    "Walker2d-v5": (WALKER, WALKER),
    "Swimmer-v5": (SWIMMER, SWIMMER),
}


@pytest.mark.parametrize("env", ROBOTS)
def test_a_mirrored_start_and_mirrored_actions_give_mirrored_observations_and_the_same_rewards(env):
    """Over whole steps of Gymnasium's, from a start that is mirrored by hand."""
    mirror, rng = mirror_of(env), np.random.default_rng(7)
    here, there = (SignsAnt() if ":" in env else gym.make(env).unwrapped for _ in range(2))
    here.reset(seed=5)
    there.reset(seed=5)
    here.set_state(here.data.qpos + rng.uniform(-0.2, 0.2, here.model.nq), rng.normal(size=here.model.nv))
    state = zip((here.data.qpos, here.data.qvel), ROBOTS[env], strict=True)
    there.set_state(*(values[source] * np.array(sign) for values, (source, sign) in state))
    for _ in range(20):
        action = rng.uniform(here.action_space.low, here.action_space.high)
        seen, reward, terminated, *_ = here.step(action)
        image, its_reward, its_end, *_ = there.step(mirror.action(action))
        np.testing.assert_allclose(mirror.observation(seen), image, atol=1e-6)
        assert (its_reward, its_end) == (pytest.approx(reward, abs=1e-6), terminated)


def test_an_ant_is_mirrored_as_its_model_says():
    """Its controls are hip and ankle of the legs 4, 1, 2, 3; leg 1 is the image of 4, and 2 of 3; hips turn round."""
    action = mirror_of("Ant-v5").action
    assert action.source.tolist() == [2, 3, 0, 1, 6, 7, 4, 5]
    assert action.sign.tolist() == [-1, 1] * 4
    order = mirror_of("Ant-v5").observation
    legs = [0, 10, 11, 12, 7, 8, 9, 4, 5, 6, 1, 2, 3]  # the torso, and three bodies of each leg
    touching = [0, 2, 3, 5, 6, 8, 9, 11, 12]  # the first body of each leg has no surface
    contact = order.source[27:].reshape(13, 6), order.sign[27:].reshape(13, 6)  # of each: a torque and a force
    assert (contact[0][touching] == 27 + 6 * np.array(legs)[touching][:, None] + np.arange(6)).all()
    assert (contact[1][touching] == [-1, 1, -1, 1, -1, 1]).all()


@pytest.mark.parametrize(
    ("env", "said"),
    [
        (
            "Humanoid-v5",
            "its body looks symmetric, but moves otherwise on each side: a mirrored position differs by 0.0",
        ),
        ("test_symmetry:LimpingAnt", "its body looks symmetric, but moves otherwise on each side"),
        ("HalfCheetah-v5", "its body has no left and right."),
        ("Hopper-v5", "its body has no left and right."),
        ("test_symmetry:OneEyedWalker", "number 3 of its observation is none of those in the mirror."),
        (
            "test_symmetry:WronglyMirrored",
            r"mirror of its observation is \[-2, 3, 1\]; it must have each of 1 to 3 once, in pairs.",
        ),
        ("test_symmetry:OneList", r"its attribute mirror is \(\[1, 2, 3\],\); it must be two lists of whole numbers"),
        ("test_symmetry:Uneven", "the bounds of its action, .*, are not the mirror image of themselves."),
        ("test_symmetry:wrapped_pole", "the wrapper TransformObservation changes what its attribute mirror is about"),
        ("CartPole-v1", "its action is not one row of numbers."),
        ("Pendulum-v1", "it is no MuJoCo environment of Gymnasium's kind, and has no attribute mirror."),
        ("DroneFigureEightTrajectory-v0", "has no symmetry that could be used"),
        ("Nothing-v7", "has no symmetry that could be used"),
    ],
)
def test_where_there_is_no_mirror_the_reason_is_said(env, said):
    with pytest.raises(UserError, match=said):
        mirror_of(env)


def test_a_mirror_is_that_of_actions_as_a_policy_gives_them():
    """In [-1, 1], whose image is itself: an action of 0 is another one between −1 and ½, which is no mirror image."""
    with pytest.raises(UserError, match="moves otherwise on each side"):
        mirror_of("test_symmetry:swimmer", low=-1.0, high=0.5, rescaled=False)
    mirror = mirror_of("test_symmetry:swimmer", low=-2.0, high=2.0, rescaled=True)
    assert mirror.action.sign.tolist() == [-1, -1]


def test_a_mirror_that_is_given_is_taken():
    mirror = mirror_of("test_symmetry:Pole")
    assert mirror.observation(np.array([1.0, 2.0, 3.0])).tolist() == [-1, 3, 2]
    assert mirror.action(torch.tensor([[0.25, -0.5]])).tolist() == [[-0.5, 0.25]]


def test_transitions_are_doubled_in_order(rng):
    obs, next_obs = torch.randn(2, 4, 3, generator=rng)
    rows = Transition(obs, torch.randn(4, 2, generator=rng), torch.arange(4.0), next_obs, torch.arange(4) > 2)
    both = mirror_of("test_symmetry:Pole").both(rows, 0)
    assert both.obs.shape == (8, 3)
    assert both.next_obs[4:].equal(torch.stack([-next_obs[:, 0], next_obs[:, 2], next_obs[:, 1]], 1))
    assert both.action[4:].equal(rows.action.flip(1))
    assert both.reward.equal(rows.reward.repeat(2))
    assert both.terminated.equal(rows.terminated.repeat(2))


ALGORITHMS = {
    "reppo": {"minibatch_size": 16, "epochs": 2},
    "sac": {},
    "td3": {},
    "ddpg": {},
}


def fields_of(algorithm, **fields):
    own = tiny_off_policy() if algorithm in ("sac", "td3", "ddpg") else tiny_on_policy()
    return {**own, **ALGORITHMS[algorithm], "symmetry": "on", "progress": False, **fields}


def tiny_on_policy():
    return {"num_envs": 4, "num_steps": 8, "total_steps": 256, "hidden": (16,), "evaluate_episodes": 2}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_with_a_q_learns_from_both_sides_and_goes_on_to_the_same_bits(tmp_path, algorithm):
    env = "test_symmetry:Pole"
    limit = {"wrappers": ("gymnasium.wrappers:TimeLimit(max_episode_steps=20)",)}
    fields = fields_of(algorithm, **limit, checkpoint_every=64, keep_checkpoints=10)
    whole = lem.train(algorithm, env, run=tmp_path / "whole", **fields)
    plain = lem.train(algorithm, env, run=tmp_path / "plain", **{**fields, "symmetry": "off"})
    parameters = [torch.cat([p.flatten() for p in run.policy.networks.parameters()]) for run in (whole, plain)]
    assert not parameters[0].equal(parameters[1])
    last = checkpoint.list_steps(tmp_path / "whole" / "checkpoints")[-1]
    again = checkpoint.read(tmp_path / "whole" / "checkpoints" / f"step-{last}").tensors
    for step in checkpoint.list_steps(tmp_path / "whole" / "checkpoints")[-2:]:
        (tmp_path / "whole" / "checkpoints" / f"step-{step}" / "manifest.json").unlink()
    lem.resume(tmp_path / "whole", progress=False)
    resumed = checkpoint.read(tmp_path / "whole" / "checkpoints" / f"step-{last}").tensors
    assert all(again[name].equal(resumed[name]) for name in again)


def test_on_says_where_there_is_none_and_auto_does_without(tmp_path):
    with pytest.raises(UserError, match=r"Pendulum-v1 has no symmetry that could be used"):
        lem.train("sac", "Pendulum-v1", run=tmp_path / "on", progress=False, **tiny_off_policy(symmetry="on"))
    own = tiny_off_policy(symmetry="on") | {"backend": "own_simulator:Glide"}
    with pytest.raises(
        UserError, match="symmetry is of environments of Gymnasium, and not of the backend own_simulator"
    ):
        lem.train("sac", "Glide-v0", run=tmp_path / "on", progress=False, **own)
    assert not (tmp_path / "on").exists()
    lem.train("sac", "Pendulum-v1", run=tmp_path / "auto", progress=False, **tiny_off_policy(symmetry="auto"))


@pytest.mark.parametrize("algorithm", ["reinforce", "a2c", "trpo", "ppo", "pqn"])
def test_what_asks_how_likely_an_action_was_has_no_symmetry(algorithm):
    """The mirror image of an action is none that the policy drew."""
    assert "symmetry" not in {field.name for field in dataclasses.fields(find(algorithm).Config)}
    with pytest.raises(UserError, match=r"where a Q\(s, a\) is learned: sac, td3, ddpg and reppo"):
        lem.train(algorithm, "Walker2d-v5", symmetry="on")


@pytest.mark.parametrize(
    ("algorithm", "fields", "said"),
    [
        ("reppo", {"network": "gru"}, "symmetry is not for network gru: a memory has no mirror image."),
        ("sac", {"replay": "hindsight"}, "symmetry is not for replay hindsight: its goals have no mirror image."),
    ],
)
def test_what_has_no_mirror_image_is_refused(algorithm, fields, said):
    with pytest.raises(UserError, match=said):
        make_envs(find(algorithm).Config(env="Walker2d-v5", symmetry="on", **fields))


def test_one_robot_has_its_mirror_too():
    env, eval_env = make_envs(reppo.Config(env="test_symmetry:Pole", num_envs=1, minibatch_size=64, symmetry="on"))
    assert env is eval_env
    assert env.mirror is not None
    env.close()


def test_environments_of_a_run_have_the_mirror_and_those_of_evaluation_do_not():
    env, eval_env = make_envs(reppo.Config(env="Walker2d-v5", num_envs=4, symmetry="on"))
    try:
        assert env.mirror is not None
        assert eval_env.mirror is None
    finally:
        env.close()
        eval_env.close()
