# ruff: noqa: D102  (the methods are those of Gymnasium's wrappers)
"""A third held-out set of faults for the doctor, in the style of `unseen_too.py`.

They too are mistakes that people make, and were chosen without a look at the doctor's rules or at its results: four
of the environment, four of the settings, and four of the learner.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import torch
from faulty import WrongStep
from unseen import QUICK
from unseen_too import quick


class RunningTotal(WrongStep):
    """Each step is paid the sum of all rewards of the episode so far."""

    total = 0.0

    def reset(self, **kwargs):
        self.total = 0.0
        return super().reset(**kwargs)

    def ends(self, reward, terminated, truncated):
        self.total += reward
        return self.total, terminated, truncated


class NoSpeeds(gym.ObservationWrapper):
    """Observations without their speeds, which are those whose bounds are wide."""

    def __init__(self, env):
        super().__init__(env)
        whole = env.observation_space
        self.kept = whole.high < 5
        self.observation_space = gym.spaces.Box(whole.low[self.kept], whole.high[self.kept], dtype=np.float32)

    def observation(self, observation):
        return np.asarray(observation, np.float32)[self.kept]


class Battery(gym.ActionWrapper):
    """Actions from a battery that runs down as it is used, and that `reset` does not charge."""

    def __init__(self, env, steps):
        super().__init__(env)
        self.lasts, self.used = steps, 0

    def action(self, action):
        self.used += 1
        return (np.exp(-self.used / self.lasts) * np.asarray(action)).astype(self.action_space.dtype)


class OwnOrder(WrongStep):
    """Observations put together in the order of a set, which is another one in each process."""

    def __init__(self, env):
        super().__init__(env)
        self.order = np.arange(self.observation_space.shape[0])

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.order = np.random.default_rng(seed).permutation(self.order.size)
        return super().reset(seed=seed, options=options)

    def seen(self, obs):
        return np.asarray(obs, np.float32)[self.order]


@contextmanager
def _down_the_critic() -> Iterator[None]:
    from lemniscate.algos import td3

    right = td3.actor_loss

    def wrong(state: Any, policy: Any, batch: Any) -> Any:
        loss = -right(state, policy, batch)[0]  # Q itself, which a step then makes smaller
        return loss, {"losses/actor": loss.detach()}

    with quick(td3), patch.object(td3, "actor_loss", wrong):
        yield


@contextmanager
def _copied_critics() -> Iterator[None]:
    from lemniscate.algos import sac

    right = sac.Adam

    def wrong(networks: Any, **options: Any) -> Any:
        return right(deepcopy(networks) if options["name"] == "critic" else networks, **options)

    with quick(sac), patch.object(sac, "Adam", wrong):
        yield


def _drawn_again() -> Any:
    from lemniscate.algos import a2c

    right = a2c.loss

    def wrong(config: Any, networks: Any, batch: Any) -> Any:
        taken = batch.action
        noise = torch.randn_like(taken) if taken.is_floating_point() else torch.rand(taken.shape)
        drawn = networks.policy.act(batch.obs, noise).detach()
        return right(config, networks, replace(batch, action=drawn))

    return patch.object(a2c, "loss", wrong)


def _no_gather() -> Any:
    from lemniscate.algos import pqn

    def wrong(networks: Any, batch: Any) -> Any:
        q = networks.policy(batch.obs).values  # [M, n], and the target is for one of the n
        loss = pqn.value_loss(q, batch.target[:, None].expand_as(q))
        return loss, {"losses/critic": loss.detach(), "q": q.detach().mean()}

    return patch.object(pqn, "loss", wrong)


LEARNERS: dict[str, Callable[[], Any]] = {
    "a policy's loss with the other sign": _down_the_critic,
    "a target for each action's Q": _no_gather,
    "an optimizer over a copy of the critics": _copied_critics,
    "log-probabilities of actions drawn again": _drawn_again,
}

SWING = {"Pendulum-v1": 3_000, "InvertedPendulum-v5": 3_000}
"""environments that SAC, TD3 and DDPG begin to learn in a short run"""

UNSEEN_THREE: dict[str, tuple[str, Mapping[str, int], Mapping[str, Any] | str, str]] = {
    # fault: algorithm, environments, fields or the name of a change in `LEARNERS`, what is right to say
    "a running total": (
        "ppo", {"Pendulum-v1": 60_000, "LunarLander-v3": 100_000}, {"wrappers": ("unseen_three:RunningTotal",)},
        "The reward adds up over the episode: each step is paid the total so far, not what it earned itself, so"
        " that the reward depends on the past, which the observation does not tell.",
    ),
    "positions without speeds": (
        "trpo", {"CartPole-v1": 60_000, "Pendulum-v1": 60_000}, {"wrappers": ("unseen_three:NoSpeeds",)},
        "The observation lacks something that decides what follows (the velocities): it is not a state, and the"
        " policy needs these parts, a stack of frames or a memory.",
    ),
    "a battery that is never charged": (
        "ppo", {"Pendulum-v1": 60_000, "HalfCheetah-v5": 100_000}, {"wrappers": ("unseen_three:Battery(steps=1000)",)},
        "The environment changes as the run goes on (reset does not restore a part of its state): the same"
        " actions have less and less effect, and what was learned no longer holds.",
    ),
    "parts in the order of a set": (
        "a2c", {"CartPole-v1": 60_000, "HalfCheetah-v5": 100_000}, {"wrappers": ("unseen_three:OwnOrder",)},
        "The observations of the parallel environments do not mean the same: their parts stand in another order"
        " in each, so that no policy fits all of them.",
    ),
    "a trust region of next to nothing": (
        "trpo", {"CartPole-v1": 60_000, "InvertedPendulum-v5": 60_000}, {"max_kl": 1e-6},
        "max_kl is far too small: each update may move the policy by next to nothing, so that it stays as it was.",
    ),
    "a decay factor for ε": (
        "pqn", {"CartPole-v1": 60_000, "Acrobot-v1": 80_000}, {"final_epsilon": 0.95},
        "final_epsilon is far too high (it looks like a decay factor): nearly all actions are random to the end, so"
        " that the returns of training are those of chance, and Q hardly sees what a good policy does.",
    ),
    "a temperature that cannot fall": (
        "reppo", {"Pendulum-v1": 60_000, "HalfCheetah-v5": 100_000}, {"min_temperature": 1.0},
        "min_temperature is far too high: the entropy is worth more than the rewards, and the policy stays random.",
    ),
    "a critic without hidden layers": (
        "ddpg", SWING, QUICK | {"critic_hidden": ()},
        "The critic is too small (critic_hidden is empty, Q is linear): it cannot fit its targets, and since its slope"
        " in the action is the same in every state, the policy goes to one bound of the actions.",
    ),
    "a policy that descends Q": (
        "td3", SWING, "a policy's loss with the other sign",
        "The policy's loss has the wrong sign: the policy moves to the actions of the smallest Q, and gets worse than"
        " random actions.",
    ),
    "critics that nobody asks": (
        "sac", SWING, "an optimizer over a copy of the critics",
        "The critic's optimizer moves other parameters than those that the policy and the targets use (a copy, or"
        " networks made anew): these stay as they were initialized, and the policy climbs a Q that knows nothing.",
    ),
    "actions that were not taken": (
        "a2c", {"CartPole-v1": 60_000, "InvertedPendulum-v5": 60_000}, "log-probabilities of actions drawn again",
        "The log-probabilities in the policy's loss are not those of the actions that were taken (they are drawn anew"
        " in the update): the advantages are of other actions, and the policy's gradient is noise.",
    ),
    "one target for all actions": (
        "pqn", {"CartPole-v1": 60_000, "Acrobot-v1": 80_000}, "a target for each action's Q",
        "Q learns the target for all actions and not only for the one taken (a missing gather, or shapes that"
        " broadcast): it tells states apart but not actions, and the greedy action means nothing.",
    ),
}  # fmt: skip
