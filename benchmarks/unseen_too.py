# ruff: noqa: D102  (the methods are those of Gymnasium's wrappers)
"""A second held-out set of faults for the doctor, in the style of `unseen.py`.

They too are mistakes that people make, and were chosen without a look at the doctor's rules or at its results.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from types import ModuleType
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import torch
from faulty import WrongStep
from unseen import BOX, CHANCE, OFF, ON, QUICK, QUICK_HANDS


class Saturated(WrongStep):
    """Observations that were divided by limits far too small, and then clipped to [-1, 1]."""

    def __init__(self, env, limit):
        super().__init__(env)
        self.limit = limit

    def seen(self, obs):
        return np.clip(np.asarray(obs, np.float32) / self.limit, -1, 1)


class HeldFrames(WrongStep):
    """A sensor that is slower than the steps: each observation is shown again until the next is there."""

    def __init__(self, env, steps):
        super().__init__(env)
        self.every = steps

    def seen(self, obs):
        if self.age % self.every == 0:
            self.held = np.array(obs, np.float32)
        return self.held.copy()


class WideBounds(gym.ActionWrapper):
    """Bounds of actions in another unit, many times as wide as those to which the actions are clipped."""

    def __init__(self, env, times):
        super().__init__(env)
        right = env.action_space
        self.action_space = gym.spaces.Box(times * right.low, times * right.high, right.shape, right.dtype)

    def action(self, action):
        right = self.env.action_space
        return np.clip(action, right.low, right.high)


class SameStart(gym.Wrapper):
    """A call of `reset` with the same seed in every episode."""

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=42, options=options)


def quick(algorithm: ModuleType) -> Any:
    """`QUICK` as the defaults of an algorithm's fields, since a change of a learner comes without fields."""
    return patch.dict(algorithm.Config.__init__.__kwdefaults__, QUICK)


@contextmanager
def _targets_stay() -> Iterator[None]:
    from lemniscate.algos import td3

    with quick(td3), patch.object(td3, "polyak", lambda *_: None):
        yield


@contextmanager
def _same_array() -> Iterator[None]:
    from lemniscate.algos import sac
    from lemniscate.data.replay import ReplayBuffer

    right = ReplayBuffer.add

    def wrong(self: Any, obs: Any, action: Any, step: Any) -> None:
        right(self, obs, action, replace(step, next_obs=obs))  # two names of one array

    with quick(sac), patch.object(ReplayBuffer, "add", wrong):
        yield


def _column_and_row() -> Any:
    from lemniscate.algos import ppo

    def wrong(log_ratio: Any, advantage: Any, clip: Any) -> Any:
        ratio = log_ratio.exp()[:, None]  # [M, 1] and [M] make [M, M], which the library's own function refuses
        return -torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()

    return patch.object(ppo, "clipped_surrogate", wrong)


LEARNERS: dict[str, Callable[[], Any]] = {
    "each ratio with all advantages": _column_and_row,
    "next observations that are the present ones": _same_array,
    "targets that are never updated": _targets_stay,
}

FINE = {"Pendulum-v1": 60_000, "LunarLander-v3": 120_000, "HalfCheetah-v5": 120_000}
"""environments in which the sign of an observation is not enough"""

UNSEEN_TOO: dict[str, tuple[str, Mapping[str, int], Mapping[str, Any] | str, str]] = {
    # fault: algorithm, environments, fields or the name of a change in `LEARNERS`, what is right to say
    "observations at their limits": (
        "ppo", FINE, {"wrappers": ("unseen_too:Saturated(limit=0.01)",)},
        "The observations are clipped (they were scaled by wrong limits): nearly all of their parts stand at"
        " -1 or 1, so that little more than their signs is left.",
    ),
    "frames that are shown again": (
        "ppo", QUICK_HANDS, {"wrappers": ("unseen_too:HeldFrames(steps=8)",)},
        "The observation is stale: it stays exactly the same for several steps, and then jumps, while the"
        " environment goes on (frames are repeated).",
    ),
    "bounds in another unit": (
        "sac", OFF, QUICK | {"wrappers": ("unseen_too:WideBounds(times=100)",)},
        "The declared bounds of the actions are far wider than those that the environment uses: nearly every"
        " action is clipped or saturates, and only its sign counts.",
    ),
    "the same start each time": (
        "ppo", CHANCE, {"wrappers": ("unseen_too:SameStart",)},
        "All episodes begin in the very same state (reset is called with a fixed seed), so that the policy"
        " and its evaluations know one start only, and the returns say nothing of others.",
    ),
    "an entropy out of reach": (
        "sac", OFF, QUICK | {"target_entropy": 2.0},
        "target_entropy is too high (its sign is wrong): no policy on [-1, 1]^A has so much entropy, so that"
        " the temperature does not fall but rises, and the policy stays random.",
    ),
    "bins that are too narrow": (
        "reppo", BOX, {"value_range": 0.05},
        "value_range is far too small: the returns lie outside of Q's bins and are clipped to the outermost"
        " ones, so that Q cannot tell good actions from bad ones.",
    ),
    "noise that drowns the policy": (
        "td3", OFF, QUICK | {"noise_std": 3.0},
        "The exploration noise noise_std is far too large: the actions of training are mostly noise or at"
        " their bounds, and its returns are those of the noise, not of the policy.",
    ),
    "targets that stay": (
        "td3", OFF, "targets that are never updated",
        "The target networks do not follow the online ones (their update is missing): Q bootstraps from"
        " untrained networks and learns next to nothing beyond the reward of one step.",
    ),
    "an array with two names": (
        "sac", OFF, "next observations that are the present ones",
        "The next observations in the replay buffer are the same as the observations (an array that was"
        " overwritten or not copied): Q bootstraps from the state it is in, not from what follows.",
    ),
    "a column times a row": (
        "ppo", ON, "each ratio with all advantages",
        "The policy's loss does not pair each action with its own advantage (shapes that broadcast to a"
        " matrix), and standardized advantages cancel out: it gets no gradient, and"
        " does not move; the KL stays at 0.",
    ),
}  # fmt: skip
