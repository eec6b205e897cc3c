"""Environments that say too little at each step, for policies with a memory: here, `--env hidden:cart_pole`.

And the drones without velocities: `--env DroneFigureEightTrajectory-v0 --backend hidden:DroneWithoutVelocities`.
"""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from lemniscate.drones.crazyflow import CrazyflowBackend
from lemniscate.types import Step


class Without(gym.ObservationWrapper):
    """An environment whose observations lack some numbers.

    Args:
        env: the environment.
        hidden: their places.
    """

    def __init__(self, env: gym.Env, *hidden: int) -> None:
        super().__init__(env)
        space = env.observation_space
        self.seen = [i for i in range(space.shape[0]) if i not in hidden]
        self.observation_space = gym.spaces.Box(space.low[self.seen], space.high[self.seen], dtype=space.dtype)

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Those that are seen."""
        return observation[self.seen]


def cart_pole(**kwargs) -> gym.Env:
    """CartPole-v1 without velocities."""
    return Without(gym.make("CartPole-v1", **kwargs), 1, 3)


def pendulum(**kwargs) -> gym.Env:
    """Pendulum-v1 without velocity."""
    return Without(gym.make("Pendulum-v1", **kwargs), 2)


def lunar_lander(**kwargs) -> gym.Env:
    """LunarLander-v3 without velocities."""
    return Without(gym.make("LunarLander-v3", **kwargs), 2, 3, 5)


class RepeatFirst(gym.Env):
    """One of four suits is shown first, then others; at each step the action is to name the first (PopGym).

    Each right answer pays 1 / length, each wrong one −1 / length; an episode has `length` steps. Chance: −0.5.
    """

    observation_space = gym.spaces.Box(0, 1, (5,))
    action_space = gym.spaces.Discrete(4)

    def __init__(self, length: int = 50) -> None:
        self.length = length

    def reset(self, *, seed=None, options=None):
        """Draw the first suit, and show it."""
        super().reset(seed=seed)
        self.t, self.first = 0, int(self.np_random.integers(4))
        return self._show(self.first), {}

    def step(self, action):
        """Pay for the name of the first suit, and show any."""
        self.t += 1
        reward = (1.0 if action == self.first else -1.0) / self.length
        return self._show(int(self.np_random.integers(4))), reward, self.t == self.length, False, {}

    def _show(self, suit: int) -> np.ndarray:
        return np.append(np.eye(4)[suit], self.t == 0).astype(np.float32)


class DroneWithoutVelocities(CrazyflowBackend):
    """Crazyflow's drones, whose policy sees neither velocity nor angular velocity; its critic does, as privileged."""

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        parts, places = self.spec.observation_parts, torch.arange(self.spec.observation_size)
        seen, hidden = [], []
        for part, columns in zip(parts, places.split([part.size for part in parts]), strict=True):
            (hidden if part.name in ("vel", "ang_vel") else seen).append((part, columns))
        self._order = torch.cat([columns for _, columns in (*seen, *hidden)])
        size = sum(part.size for part, _ in hidden)
        self.spec = replace(self.spec, observation_parts=tuple(part for part, _ in seen), privileged=size)
        self.baseline = self.scene = None

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """With the velocities behind the observation."""
        return super().restart(seed, first)[:, self._order]

    def step(self, action: Tensor) -> Step:
        """With the velocities behind the observation."""
        step = super().step(action)
        next_obs = step.next_obs[:, self._order]
        return replace(step, obs=next_obs if step.obs is step.next_obs else step.obs[:, self._order], next_obs=next_obs)
