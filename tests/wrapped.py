"""An environment and its wrappers. Each worker imports this, so it imports nothing that takes seconds."""

import gymnasium as gym
import numpy as np


class Reach(gym.Env):
    """Episodes of `length` steps; success is reached in the last one, or never in every other environment."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    metadata = {"render_modes": [], "measures": ["height"]}  # noqa: RUF012

    def __init__(self, length=4, reward=1.0, render_mode=None):
        self.length, self.reward = length, reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        info = {"is_success": self.t == self.length, "unnamed": 7.0}
        if self.t != 2:
            info["height"] = float(self.t)
        return np.zeros(1, np.float32), self.reward, self.t == self.length, False, info


class PlusOne(gym.RewardWrapper):
    def __init__(self, env, by=1.0):
        super().__init__(env)
        self.by = by

    def reward(self, reward):
        return reward + self.by


def times_ten(env):
    return gym.wrappers.TransformReward(env, lambda reward: 10 * reward)
