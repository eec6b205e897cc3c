# ruff: noqa: D102  (the methods are those of Gymnasium's wrappers)
"""A fourth held-out set of faults for the doctor, in the style of `unseen_too.py`.

Two people who knew neither the rules nor the sets before invented 53 faults; these are of the kinds that were new, with
what was right at once and what was not: twelve of the environment and five of the learner.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
from faulty import WrongStep
from unseen import QUICK
from unseen_three import SWING
from unseen_too import quick


class Offset(gym.RewardWrapper):
    """Rewards with a constant beside which nothing else counts."""

    def __init__(self, env, by):
        super().__init__(env)
        self.by = by

    def reward(self, reward):
        return float(reward) + self.by


class Unconnected(WrongStep):
    """All numbers of the observation but the first are those of an empty register."""

    def seen(self, obs):
        return np.concatenate([obs[:1], np.full(len(obs) - 1, 0.37)]).astype(np.float32)


class MixedUnits(WrongStep):
    """The first number is in millionths, the last in millions."""

    def seen(self, obs):
        scale = np.ones(len(obs))
        scale[[0, -1]] = 1e6, 1e-6
        return (obs * scale).astype(np.float32)


class NoEnd(WrongStep):
    """What has failed goes on to the time limit."""

    def ends(self, reward, terminated, truncated):
        return reward, False, truncated


class PaidByStart(WrongStep):
    """Each step is paid what the beginning of its episode was worth."""

    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        self.price = -float(np.abs(obs).sum())
        return obs, info

    def ends(self, reward, terminated, truncated):
        return self.price, terminated, truncated


class PaidLate(WrongStep):
    """Each step is paid what the one before it has earned; what the last one earns is lost."""

    def reset(self, **kwargs):
        self.earned = 0.0
        return super().reset(**kwargs)

    def ends(self, reward, terminated, truncated):
        paid, self.earned = self.earned, reward
        return paid, terminated, truncated


class NoCable(gym.ActionWrapper):
    """The second motor stands still."""

    def action(self, action):
        return np.where(np.arange(len(action)) == 1, 0, action).astype(self.action_space.dtype)


class OldObservation(WrongStep):
    """Observations of four steps before."""

    def reset(self, **kwargs):
        self.queue = None
        return super().reset(**kwargs)

    def seen(self, obs):
        self.queue = self.queue or deque([obs] * 5, maxlen=5)
        self.queue.append(np.array(obs, np.float32))
        return np.array(self.queue[0], np.float32)


class Watchdog(WrongStep):
    """Ends each episode after forty steps, as if it had failed."""

    def ends(self, reward, terminated, truncated):
        return reward, terminated or self.age >= 40, truncated


class Coin(gym.RewardWrapper):
    """A reward that somebody meant to replace."""

    def reward(self, reward):
        return float(self.unwrapped.np_random.random() < 0.5)


class AtLeastZero(gym.RewardWrapper):
    """Rewards that are all negative, cut off at 0."""

    def reward(self, reward):
        return max(0.0, float(reward))


class OneBuffer(WrongStep):
    """All copies write into one array, and return what the one before has left there."""

    last = None

    def seen(self, obs):
        before, OneBuffer.last = OneBuffer.last, np.array(obs, np.float32)
        return OneBuffer.last if before is None or not self.age else before


@contextmanager
def _pulled_back() -> Iterator[None]:
    from lemniscate.algos import sac

    right = sac.polyak
    with quick(sac), patch.object(sac, "polyak", lambda targets, online, tau: right(online, targets, tau)):
        yield


@contextmanager
def _hotter() -> Iterator[None]:
    from lemniscate.algos import sac

    right = sac.temperature_loss

    def wrong(*args: Any) -> Any:
        loss, metrics = right(*args)
        return -loss, metrics

    with quick(sac), patch.object(sac, "temperature_loss", wrong):
        yield


def _without_ends() -> Any:
    from lemniscate.algos import pqn

    right = pqn.q_lambda

    def wrong(reward: Any, value: Any, terminated: Any, done: Any, **settings: Any) -> Any:
        return right(reward, value, terminated & ~terminated, done, **settings)

    return patch.object(pqn, "q_lambda", wrong)


def _value_of_advantages() -> Any:
    from lemniscate.algos import a2c

    right = a2c.loss
    return patch.object(
        a2c, "loss", lambda config, networks, batch: right(config, networks, replace(batch, target=batch.advantage))
    )


def _upside_down() -> Any:
    from lemniscate.algos import trpo

    right = trpo.surrogate
    return patch.object(trpo, "surrogate", lambda log_ratio, advantage: right(-log_ratio, advantage))


LEARNERS: dict[str, Callable[[], Any]] = {
    "polyak with its arguments exchanged": _pulled_back,
    "the sign of the temperature's loss": _hotter,
    "a target of Q without ends": _without_ends,
    "advantages as targets of V": _value_of_advantages,
    "old probabilities over new ones": _upside_down,
}

SHORT = {"Pendulum-v1": 60_000, "Reacher-v5": 60_000}
POLES = {"InvertedPendulum-v5": 60_000, "CartPole-v1": 60_000}

UNSEEN_FOUR: dict[str, tuple[str, Mapping[str, int], Mapping[str, Any] | str, str]] = {
    # fault: algorithm, environments, fields or the name of a change in `LEARNERS`, what is right to say
    "a constant in the reward": (
        "trpo", SHORT, {"wrappers": ("unseen_four:Offset(by=-500)",)},
        "A constant is nearly all of the reward; subtract it.",
    ),
    "sensors that are not connected": (
        "ppo", POLES, {"wrappers": ("unseen_four:Unconnected",)}, "Most numbers of the observation never change.",
    ),
    "units from millionths to millions": (
        "sac", SWING, QUICK | {"wrappers": ("unseen_four:MixedUnits",)},
        "The numbers of the observation are of very different sizes, and are not normalized.",
    ),
    "failures that end nothing": (
        "a2c", {"InvertedPendulum-v5": 60_000, "Hopper-v5": 60_000}, {"wrappers": ("unseen_four:NoEnd",)},
        "Episodes go on after they have failed.",
    ),
    "a reward for the beginning": (
        "ppo", SHORT, {"wrappers": ("unseen_four:PaidByStart",)},
        "The reward is the same throughout an episode, whatever is done.",
    ),
    "a reward that comes a step late": (
        "ppo", {"LunarLander-v3": 100_000, "Reacher-v5": 60_000}, {"wrappers": ("unseen_four:PaidLate",)},
        "The reward is that of the step before.",
    ),
    "a motor without a cable": (
        "trpo", {"HalfCheetah-v5": 60_000, "Reacher-v5": 60_000}, {"wrappers": ("unseen_four:NoCable",)},
        "One number of the action has no effect.",
    ),
    "observations of a while ago": (
        "trpo", {"Pendulum-v1": 60_000, "CartPole-v1": 60_000}, {"wrappers": ("unseen_four:OldObservation",)},
        "Observations are old, so that an action shows some steps later.",
    ),
    "a watchdog that nobody knows of": (
        "ppo", {"CartPole-v1": 60_000, "Acrobot-v1": 60_000}, {"wrappers": ("unseen_four:Watchdog",)},
        "Every episode ends after the same number of steps, as a termination.",
    ),
    "a coin for a reward": (
        "td3", SWING, QUICK | {"wrappers": ("unseen_four:Coin",)}, "The reward has nothing to do with what was done.",
    ),
    "rewards cut off at zero": (
        "ddpg", {"Pendulum-v1": 3_000, "Reacher-v5": 3_000}, QUICK | {"wrappers": ("unseen_four:AtLeastZero",)},
        "Every reward is zero.",
    ),
    "one array for all copies": (
        "pqn", {"CartPole-v1": 60_000, "Acrobot-v1": 80_000}, {"wrappers": ("unseen_four:OneBuffer",)},
        "An observation is that of another copy of the environment.",
    ),
    "targets that pull Q back": (
        "sac", SWING, "polyak with its arguments exchanged", "The target networks never move.",
    ),
    "a temperature that runs away": (
        "sac", {"Reacher-v5": 3_000, "Pendulum-v1": 3_000}, "the sign of the temperature's loss",
        "The temperature rises although the entropy is above its target.",
    ),
    "ends that Q does not know of": (
        "pqn", {"CartPole-v1": 60_000, "LunarLander-v3": 100_000}, "a target of Q without ends",
        "Q goes on beyond terminations.",
    ),
    "a value of the advantages": (
        "a2c", {"Acrobot-v1": 60_000, "CartPole-v1": 60_000}, "advantages as targets of V",
        "V does not learn the returns.",
    ),
    "a ratio upside down": (
        "trpo", POLES, "old probabilities over new ones", "The policy is led away from what is better.",
    ),
}  # fmt: skip
