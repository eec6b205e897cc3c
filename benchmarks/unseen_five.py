# ruff: noqa: D102  (the methods are those of Gymnasium's wrappers)
"""A fifth held-out set of faults for the doctor, in the style of `unseen_too.py`.

A sixth person, who knew neither the rules nor the sets before, invented 25 faults that did harm, of which one was named
first. These are those of new kinds for which there is a signal: five of the environment, two of the settings, five of
the learner. The others are told in `docs/doctor.md`.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
from torch import Tensor, nn
from unseen import QUICK
from unseen_too import quick

from lemniscate.nn.policies import Policy


class Servo(gym.Wrapper):
    """Actions are steps of a servo, whose position nobody observes."""

    def reset(self, **kwargs):
        self.position = np.zeros(self.action_space.shape)
        return super().reset(**kwargs)

    def step(self, action):
        self.position = np.clip(self.position + 0.05 * action, self.action_space.low, self.action_space.high)
        return super().step(self.position.astype(self.action_space.dtype))


class Short(gym.Wrapper):
    """Steps of a twenty-fifth of their time, as many as before."""

    def __init__(self, env):
        super().__init__(env)
        env.unwrapped.dt = env.unwrapped.dt / 25


class Throttle(gym.ActionWrapper):
    """A motor that does not run backwards."""

    def action(self, action):
        return np.maximum(action, 0)


class OneLess(gym.ActionWrapper):
    """The last choice is taken for the one before it."""

    def action(self, action):
        return min(int(action), int(self.action_space.n) - 2)


class Early(gym.wrappers.TimeLimit):
    """A time limit before a goal can be reached."""

    def __init__(self, env):
        super().__init__(env, max_episode_steps=40)


class Alike(nn.Module):
    """All weights begin with one number."""

    def __init__(self, inputs, outputs):
        super().__init__()
        layers = [nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)]
        self.layers = nn.Sequential(*layers)
        for layer in layers[::2]:
            nn.init.constant_(layer.weight, 0.05)  # pyright: ignore[reportArgumentType]
            nn.init.zeros_(layer.bias)  # pyright: ignore[reportArgumentType]

    def forward(self, x):
        return self.layers(x)


class CutOff(nn.Module):
    """A ReLU stands behind the last layer too."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(inputs, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, outputs), nn.ReLU()
        )

    def forward(self, x):
        return self.layers(x)


def _one_less_gamma() -> Any:
    from lemniscate.algos import ppo

    right = ppo.gae
    return patch.object(ppo, "gae", lambda *args, gamma, lam: right(*args, gamma=1 - gamma, lam=lam))


def _whole_epsilon() -> Any:
    from lemniscate.algos import pqn

    return patch.object(pqn, "epsilon", lambda config, step: 1.0 - step // config.total_steps)


@contextmanager
def _no_gradient_of_q() -> Iterator[None]:
    from lemniscate.algos import sac

    right = sac.actor_loss

    class Detached:
        """A policy whose samples are detached."""

        def __init__(self, policy: Policy) -> None:
            self.policy = policy

        def __call__(self, obs: Tensor) -> Any:
            distribution = self.policy(obs)

            def detached(noise: Tensor) -> tuple[Tensor, Tensor]:
                action, log_prob = distribution.sample_with_log_prob(noise)
                return action.detach(), log_prob

            return SimpleNamespace(sample_with_log_prob=detached)

    def wrong(state: Any, policy: Any, *batch: Any) -> Any:
        return right(state, Detached(policy), *batch)  # pyright: ignore[reportArgumentType]

    with quick(sac), patch.object(sac, "actor_loss", wrong):
        yield


LEARNERS: dict[str, Callable[[], Any]] = {
    "1 − γ in the place of γ": _one_less_gamma,
    "ε of whole numbers": _whole_epsilon,
    "samples that are detached": _no_gradient_of_q,
}

SWINGS = {"Pendulum-v1": 4_000, "Reacher-v5": 4_000}

UNSEEN_FIVE: dict[str, tuple[str, Mapping[str, int], Mapping[str, Any] | str, str]] = {
    # fault: algorithm, environments, fields or the name of a change in `LEARNERS`, what is right to say
    "a servo that nobody observes": (
        "sac", SWINGS, QUICK | {"wrappers": ("unseen_five:Servo",)},
        "What actions move is not observed: all actions of the episode so far explain the changes.",
    ),
    "steps that are too short": (
        "ppo", {"Pendulum-v1": 60_000, "Acrobot-v1": 60_000}, {"wrappers": ("unseen_five:Short",)},
        "A step is so short that nothing comes of it.",
    ),
    "a motor that does not run backwards": (
        "ppo", {"InvertedPendulum-v5": 60_000, "Pendulum-v1": 60_000}, {"wrappers": ("unseen_five:Throttle",)},
        "Actions of one sign have no effect.",
    ),
    "two choices that are one": (
        "ppo", {"LunarLander-v3": 100_000, "Acrobot-v1": 60_000}, {"wrappers": ("unseen_five:OneLess",)},
        "Two of the choices do the same.",
    ),
    "a limit before the goal": (
        "pqn", {"Acrobot-v1": 60_000, "MountainCar-v0": 60_000}, {"wrappers": ("unseen_five:Early",)},
        "All episodes are cut after the same steps, with the same return: the goal cannot be reached.",
    ),
    "an entropy bonus that grows": (
        "ppo", {"LunarLander-v3": 100_000, "CartPole-v1": 50_000}, {"entropy_coef": "0>0.5"},
        "The entropy bonus ends far above its usual range.",
    ),
    "two steps to a rollout": (
        "ppo", {"LunarLander-v3": 100_000, "CartPole-v1": 50_000}, {"num_envs": 512, "num_steps": 2},
        "Rollouts have too few steps.",
    ),
    "weights that are all alike": (
        "a2c", {"CartPole-v1": 50_000, "Acrobot-v1": 60_000}, {"network": "unseen_five:Alike"},
        "All hidden units say the same.",
    ),
    "a Q that cannot be negative": (
        "sac", SWINGS, QUICK | {"network": "unseen_five:CutOff"}, "Q has no gradient: its output is cut off.",
    ),
    "one less γ": (
        "ppo", {"CartPole-v1": 50_000, "InvertedPendulum-v5": 60_000}, "1 − γ in the place of γ",
        "The value has hardly more than one reward in it.",
    ),
    "ε of a whole number": (
        "pqn", {"Acrobot-v1": 60_000, "CartPole-v1": 60_000}, "ε of whole numbers", "ε stays at 1.",
    ),
    "no gradient of Q": (
        "sac", SWINGS, "samples that are detached", "The policy's actions are no better for Q than others.",
    ),
}  # fmt: skip
