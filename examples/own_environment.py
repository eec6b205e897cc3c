r"""An environment of one's own with arguments, and a wrapper around it.

cd examples
lemniscate doctor own_environment:Balance
lemniscate train sac --env own_environment:Balance --env-args '{"wind": 0.5}' \
        --wrappers 'own_environment:scaled(factor=0.1)' --total-steps 10_000
python own_environment.py
"""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

import lemniscate as lem


class Balance(gym.Env):
    """A point on a line in the wind, to be held at 0 by a force.

    Args:
        wind: standard deviation of the wind's acceleration.
        length: steps of an episode.
    """

    def __init__(self, wind: float = 0.0, length: int = 100) -> None:
        self.wind, self.length = wind, length
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,))
        self.action_space = spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin at a random position, at rest."""
        super().reset(seed=seed)
        self.steps, self.state = 0, np.array([self.np_random.uniform(-1, 1), 0.0])
        return self.state.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Push for a tenth of a second; the reward is the negative squared distance."""
        self.steps += 1
        velocity = self.state[1] + 0.1 * (float(action[0]) + self.wind * self.np_random.normal())
        self.state = np.array([self.state[0] + 0.1 * velocity, velocity])
        truncated = self.steps == self.length
        return self.state.astype(np.float32), -float(self.state[0] ** 2), False, truncated, {}


def scaled(env: gym.Env, factor: float) -> gym.Env:
    """The environment with `factor` times its reward."""
    return gym.wrappers.TransformReward(env, lambda reward: factor * reward)


if __name__ == "__main__":
    small = {"hidden": (64, 64), "critic_hidden": (64, 64), "batch_size": 128}
    trained = lem.train("sac", env=Balance, env_kwargs={"wind": 0.5}, total_steps=3_000, learning_starts=500, **small)
    print(lem.evaluate(trained.policy, episodes=20).mean_return)
    print(lem.evaluate(trained.policy, episodes=20, env_kwargs={"wind": 2.0}).mean_return)
