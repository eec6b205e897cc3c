"""EnvPool's environments are Gymnasium's: the reason why it may serve them."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from lemniscate.envs import registry
from lemniscate.envs.envpool import GYMNASIUM_IDS, EnvpoolBackend, SingleEnv
from lemniscate.errors import UserError

CPU = torch.device("cpu")
MUJOCO = {"Ant-v5": 2, "HalfCheetah-v5": 1, "Hopper-v5": 1, "Humanoid-v5": 2, "Walker2d-v5": 1}
"""how many of the first positions the observation leaves out"""


@pytest.mark.parametrize("env_id", GYMNASIUM_IDS)
def test_spaces_and_limits_are_the_same(env_id):
    pool, own = (registry.make(env_id, 2, backend=backend) for backend in ("envpool", "gymnasium"))
    assert pool.spec.fits(own.spec)
    assert pool.spec.max_episode_steps == own.spec.max_episode_steps  # each side's own
    theirs, ours = pool.backend._pool, own.backend._envs
    assert theirs.observation_space.shape == ours.single_observation_space.shape
    assert theirs.observation_space.dtype == ours.single_observation_space.dtype
    own.close()


@pytest.mark.parametrize("env_id", MUJOCO)
def test_each_step_is_the_same(env_id):
    """From EnvPool's positions and velocities, Gymnasium's physics steps to the same place, reward and end.

    Exact but for contacts, whose solver starts from what it found before: so most steps must agree, not all. Where the
    observation clips velocities (to ±10, for two of them), the state is not known and the step does not count.
    """
    own = gym.make(env_id).unwrapped
    own.reset(seed=0)
    hidden, nq, nv = MUJOCO[env_id], own.model.nq, own.model.nv
    raw = EnvpoolBackend(env_id, 1, CPU)._build(3)
    obs, _ = raw.reset()
    rng = np.random.default_rng(0)
    differences, ends = [], 0
    for _ in range(300):
        own.set_state(np.r_[np.zeros(hidden), obs[0, : nq - hidden]], obs[0, nq - hidden : nq - hidden + nv])
        known = np.abs(obs[0]).max() < 10 or env_id not in ("Hopper-v5", "Walker2d-v5")
        action = rng.uniform(own.action_space.low, own.action_space.high)
        expected, reward, terminated, _, _ = own.step(action)
        obs, rewards, terminations, truncations, _ = raw.step(action[None])
        if known:
            differences.append((np.abs(obs[0] - expected)[: nq - hidden + nv].max(), abs(rewards[0] - reward)))
            ends += terminations[0] != terminated
        if terminations[0] or truncations[0]:
            obs, _ = raw.reset()
    of_obs, of_reward = np.median(differences, axis=0)
    assert len(differences) > 50
    assert of_obs < 1e-3
    assert of_reward < 1e-3
    assert ends <= 3


def test_cart_pole_steps_the_same():
    own = gym.make("CartPole-v1").unwrapped
    own.reset(seed=0)
    pool = EnvpoolBackend("CartPole-v1", 1, CPU)._build(3)
    obs, _ = pool.reset()
    for t in range(200):
        own.state, own.steps_beyond_terminated = tuple(obs[0].astype(np.float64)), None
        action = t // 3 % 2
        expected, reward, terminated, _, _ = own.step(action)
        obs, rewards, terminations, _, _ = pool.step(np.array([action]))
        np.testing.assert_allclose(obs[0], expected, atol=1e-5)
        assert (rewards[0], terminations[0]) == (reward, terminated)
        if terminated:
            obs, _ = pool.reset()


def test_lunar_lander_falls_the_same():
    """Its terrain and push are random, so it is the statistics of many falls that must agree."""
    lengths, returns = {}, {}
    for backend in ("envpool", "gymnasium"):
        env = registry.make("LunarLander-v3", 16, backend=backend)
        env.restart(0)
        rng = np.random.default_rng(1)
        episodes = []
        while len(episodes) < 200:
            env.step(torch.from_numpy(rng.integers(4, size=16)))
            ended = env.take_episodes()
            episodes += zip(ended.lengths, ended.returns, strict=True)
        lengths[backend], returns[backend] = np.array(episodes[:200]).T
        env.close()
    for of in (lengths, returns):
        error = np.sqrt(sum(values.var() / 200 for values in of.values()))
        assert abs(of["envpool"].mean() - of["gymnasium"].mean()) < 4 * error


def test_bits_do_not_depend_on_the_number_of_threads(monkeypatch):
    def play(threads):
        monkeypatch.setattr("lemniscate.envs.envpool.cores", lambda: threads)
        env = EnvpoolBackend("Hopper-v5", 5, CPU, stagger=True)
        obs, generator = [env.restart(4)], torch.Generator().manual_seed(0)
        for _ in range(120):
            obs.append(env.step(torch.rand(5, 3, generator=generator) * 2 - 1).obs)
        return torch.stack(obs)

    assert torch.equal(play(1), play(2))


def test_bits_do_not_depend_on_workers():
    def play(backend):
        env = registry.make("CartPole-v1", 3, backend=backend, stagger=True)
        obs = [env.restart(4)]
        for t in range(60):
            obs.append(env.step(torch.full((3,), t % 2)).obs)
        env.close()
        return torch.stack(obs)

    assert torch.equal(play("gymnasium"), play("gymnasium-async"))


@pytest.mark.parametrize("steps", [0, -1, 10**12])
def test_a_time_limit_is_a_number_of_steps(steps):
    with pytest.raises(UserError, match="max_episode_steps of EnvPool's CartPole-v1 must be from 1 to 2,147,483,647"):
        registry.make("EnvPool/CartPole-v1", 2, kwargs={"max_episode_steps": steps})


def test_one_that_is_shown_ends_at_its_limit_and_has_its_mask():
    """As the environments of training do, in whose families not every one does so by itself."""
    shown = SingleEnv("LaneKeeping-v0", "rgb_array", {"max_episode_steps": 5})
    shown.reset(seed=0)
    ends = [shown.step(shown.action_space.sample())[2:4] for _ in range(5)]
    shown.close()
    assert [truncated for _, truncated in ends] == [False] * 4 + [True]
    masked = SingleEnv("Play2048-v1", "rgb_array", {})
    assert masked.reset(seed=0)[1]["action_mask"].shape == (4,)
    assert masked.step(0)[4]["action_mask"].shape == (4,)
    masked.close()
