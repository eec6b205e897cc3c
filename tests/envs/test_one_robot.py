"""An environment of one's own that exists once: a robot, a port, a licence."""

import gymnasium as gym
import numpy as np
import pytest

import lemniscate as lem
from lemniscate.api.callbacks import StopAt
from lemniscate.run.metrics import read_metrics


class Robot(gym.Env):
    """Counts how many of it were made, and how many there are at a time."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012
    alive = most = built = 0

    def __init__(self, render_mode=None):
        self.render_mode, self.there = render_mode, True
        Robot.alive, Robot.built = Robot.alive + 1, Robot.built + 1
        Robot.most = max(Robot.most, Robot.alive)

    def close(self):
        Robot.alive, self.there = Robot.alive - self.there, False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        assert self.there
        self.t, self.place = 0, self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.place, {}

    def step(self, action):
        self.t, self.place = self.t + 1, self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.place, float(action[0]), False, self.t == 10, {}

    def render(self):
        return np.zeros((4, 4, 3), np.uint8)


PPO = {"num_steps": 20, "minibatch_size": 20, "total_steps": 200}
SAC = {
    "total_steps": 200,
    "learning_starts": 40,
    "log_every": 20,
    "batch_size": 8,
    "hidden": (8,),
    "critic_hidden": (8,),
}


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
@pytest.mark.parametrize("backend", ["gymnasium", pytest.param("gymnasium-async", marks=pytest.mark.long)])
def test_there_is_one_at_a_time(algorithm, backend, tmp_path):
    Robot.alive = Robot.most = Robot.built = 0
    fields = {**(PPO if algorithm == "ppo" else SAC), "num_envs": 1, "checkpoint_every": 40, "backend": backend}
    run = lem.train(algorithm, Robot, run=tmp_path / "run", progress=False, **fields)
    if backend == "gymnasium":
        assert (Robot.most, Robot.alive, Robot.built) == (1, 0, 1)
    watched = {**fields, "evaluate_every": 60, "evaluate_episodes": 2, "video_every": 100}
    run = lem.train(algorithm, Robot, run=tmp_path / "watched", report=True, progress=False, **watched)
    assert list((run.path / "videos").iterdir())
    assert "evaluation/return" in {name for line in read_metrics(run.path) for name in line}
    lem.evaluate(run.policy, episodes=3)
    lem.evaluate(run.policy, episodes=2, video=tmp_path / "video.gif")
    lem.evaluate(lambda obs: np.zeros(1, np.float32), env=Robot, episodes=2)
    lem.watch(None, Robot, random=True, video=tmp_path / "random.gif")
    if backend == "gymnasium":
        assert (Robot.most, Robot.alive) == (1, 0)


def test_a_run_that_goes_on_ends_in_the_same_bits(tmp_path):
    fields = {**PPO, "num_envs": 1, "checkpoint_every": 40, "evaluate_every": 60, "evaluate_episodes": 2}
    whole = lem.train("ppo", Robot, run=tmp_path / "whole", progress=False, **fields)
    stopped = lem.train("ppo", Robot, run=tmp_path / "run", progress=False, callbacks=StopAt(120), **fields)
    assert stopped.policy.step < 200
    again = lem.resume(stopped.path, progress=False)
    for mine, its in zip(whole.policy.networks.parameters(), again.policy.networks.parameters(), strict=True):
        np.testing.assert_array_equal(mine.detach().numpy(), its.detach().numpy())
