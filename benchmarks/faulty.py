# ruff: noqa: D102  (the methods are those of Gymnasium's wrappers)
"""Environments with faults, as wrappers, and learners with faults, as changes of the library: for `doctor.py`."""

from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import torch

from lemniscate.algos import find


class NoReward(gym.RewardWrapper):
    """Every reward is 0."""

    def reward(self, reward):
        return 0.0


class ScaledReward(gym.RewardWrapper):
    """Rewards in other units."""

    def __init__(self, env, scale):
        super().__init__(env)
        self.scale = scale

    def reward(self, reward):
        return self.scale * float(reward)


class NoisyReward(gym.RewardWrapper):
    """Rewards that have nothing to do with what was done."""

    def reward(self, reward):
        return float(self.unwrapped.np_random.normal())


class WrongStep(gym.Wrapper):
    """A copy of observations without bounds, for those that follow."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, env.observation_space.shape, np.float32)
        self.steps = self.age = 0

    def reset(self, **kwargs):
        self.age = 0
        obs, info = self.env.reset(**kwargs)
        return self.seen(obs), info

    def step(self, action):
        self.steps, self.age = self.steps + 1, self.age + 1
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self.seen(obs), *self.ends(float(reward), terminated, truncated), info

    def seen(self, obs):
        return np.asarray(obs, np.float32)

    def ends(self, reward, terminated, truncated):
        return reward, terminated, truncated


class TimedReward(WrongStep):
    """The reward is the age of the episode."""

    def ends(self, reward, terminated, truncated):
        return self.age / 100, terminated, truncated


class SameReturn(WrongStep):
    """The same reward for each step, and an end after 50 steps, whatever was done."""

    failed = False

    def step(self, action):
        if self.age and self.failed:
            self.age += 1
            return self.last, 1.0, False, self.age >= 50, {}
        obs, _, terminated, truncated, info = self.env.step(action)
        self.age, self.failed, self.last = self.age + 1, terminated or truncated, self.seen(obs)
        return self.last, 1.0, False, self.age >= 50, info


class Frozen(WrongStep):
    """The observation is never written."""

    def seen(self, obs):
        return np.zeros(self.observation_space.shape, np.float32)


class Drifting(WrongStep):
    """The unit of the observation shrinks without an end."""

    def seen(self, obs):
        return np.asarray(obs * np.exp(self.steps / 200), np.float32)


class Degrees(WrongStep):
    """Observations in a unit a thousand times too small."""

    def seen(self, obs):
        return np.asarray(obs * 1000, np.float32)


class Deaf(gym.Wrapper):
    """Another action than the one that was given."""

    def reset(self, **kwargs):
        if kwargs.get("seed") is not None:
            self.action_space.seed(kwargs["seed"])
        return self.env.reset(**kwargs)

    def step(self, action):
        return self.env.step(self.action_space.sample())


class LimitAsEnd(WrongStep):
    """A time limit that is reported as a termination."""

    def ends(self, reward, terminated, truncated):
        return reward, terminated or self.age >= 40, False


class Endless(WrongStep):
    """Episodes whose ends are not reported."""

    def step(self, action):
        obs, reward, terminated, truncated, _ = super().step(action)
        if terminated or truncated:
            obs = self.seen(self.env.reset()[0])
        return obs, reward, False, False, {}


class OneStep(WrongStep):
    """Episodes of one step."""

    def ends(self, reward, terminated, truncated):
        return reward, True, False


class Seedless(gym.Wrapper):
    """An environment that does not use the seed."""

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=int(np.random.SeedSequence().entropy % 2**31), options=options)


def _other_log_prob() -> Any:
    from lemniscate.nn.actor_critic import ActorCritic

    right = ActorCritic.estimates

    def wrong(self: Any, *args: Any) -> Any:
        value, next_value, log_prob = right(self, *args)
        return value, next_value, log_prob + 0.3 * torch.randn_like(log_prob)

    return patch.object(ActorCritic, "estimates", wrong)


def _frozen_normalizer() -> Any:
    from lemniscate.nn.normalizer import RunningNorm

    right = RunningNorm.update

    def wrong(self: Any, *args: Any) -> None:
        if self.count == 0:
            right(self, *args)

    return patch.object(RunningNorm, "update", wrong)


def _other_sign(algorithm: str) -> Any:
    return patch.object(find(algorithm), "standardize", lambda x: -torch.nn.functional.layer_norm(x, x.shape[-1:]))


def _shuffled_targets(algorithm: str) -> Any:
    right = find(algorithm).value_loss

    def wrong(value: Any, target: Any, *args: Any) -> Any:
        return right(value, target.flip(0), *args)

    return patch.object(find(algorithm), "value_loss", wrong)


def _large_weights() -> Any:
    from lemniscate.nn import networks

    right = networks.orthogonal

    def wrong(layer: Any, gain: float = 1.0) -> Any:
        return right(layer, gain if gain < 0.1 or layer.out_features == 1 else 100 * gain)

    return patch.object(networks, "orthogonal", wrong)


def _no_bootstrap(algorithm: str) -> Any:
    right = find(algorithm).gae

    def wrong(reward: Any, value: Any, next_value: Any, terminated: Any, done: Any, **options: Any) -> Any:
        return right(reward, value, next_value, done, done, **options)

    return patch.object(find(algorithm), "gae", wrong)


LEARNERS: dict[str, Callable[[str], Any]] = {
    "another log-probability": lambda _: _other_log_prob(),
    "no bootstrap at time limits": _no_bootstrap,
    "a normalizer that stops": lambda _: _frozen_normalizer(),
    "the sign of the advantage": _other_sign,
    "targets of other rows": _shuffled_targets,
    "weights that are too large": lambda _: _large_weights(),
}
"""the library with a fault in it, as a context, for the name of an algorithm"""
