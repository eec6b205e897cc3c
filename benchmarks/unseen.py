# ruff: noqa: D102  (the methods are those of Gymnasium's wrappers)
"""Faults that the doctor was not written for: a held-out test of it, in the style of `faulty.py`.

They are mistakes that people make, chosen without a look at the doctor's rules or at its results: in the
environment (wrappers), in the settings, in the learner (changes of the library), and in how a run is judged.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import torch
from faulty import WrongStep


class LateReward(WrongStep):
    """All rewards of an episode are paid at its end, in one sum."""

    owed = 0.0

    def reset(self, **kwargs):
        self.owed = 0.0
        return super().reset(**kwargs)

    def ends(self, reward, terminated, truncated):
        self.owed += reward
        return (self.owed if terminated or truncated else 0.0), terminated, truncated


class CostlyLife(gym.RewardWrapper):
    """Each step costs more than it earns, so that the best is to end the episode at once."""

    def __init__(self, env, cost):
        super().__init__(env)
        self.cost = cost

    def reward(self, reward):
        return float(reward) - self.cost


class WholeNumbers(WrongStep):
    """Observations that went through an array of whole numbers, and lost all behind the point."""

    def seen(self, obs):
        return np.asarray(obs).astype(np.int64).astype(np.float32)


class NoisySensor(WrongStep):
    """Observations under fresh noise, about as large as they are."""

    def __init__(self, env, std):
        super().__init__(env)
        self.std = std

    def seen(self, obs):
        return np.asarray(obs + self.unwrapped.np_random.normal(0, self.std, np.shape(obs)), np.float32)


class WeakActions(gym.ActionWrapper):
    """Actions in another unit: of each only a small share arrives."""

    def __init__(self, env, share):
        super().__init__(env)
        self.share = share

    def action(self, action):
        return (self.share * np.asarray(action)).astype(self.action_space.dtype)


class LateActions(gym.Wrapper):
    """Each action is carried out some steps after it was chosen; before the first there is action 0."""

    def __init__(self, env, steps):
        super().__init__(env)
        self.steps, self.queue = steps, deque()

    def reset(self, **kwargs):
        nothing = np.zeros(self.action_space.shape, self.action_space.dtype)
        self.queue = deque([nothing if nothing.shape else int(nothing)] * self.steps)
        return self.env.reset(**kwargs)

    def step(self, action):
        self.queue.append(np.copy(action) if np.shape(action) else int(action))
        return self.env.step(self.queue.popleft())


def _ratio_is_one() -> Any:
    from lemniscate.algos import ppo

    right = ppo.loss

    def wrong(config: Any, networks: Any, batch: Any) -> Any:
        log_prob = networks.policy(batch.obs).log_prob(batch.action).detach()  # not that of the old policy
        return right(config, networks, replace(batch, log_prob=log_prob))

    return patch.object(ppo, "loss", wrong)


def _ends_ignored() -> Any:
    from lemniscate.algos import ppo

    right = ppo.gae

    def wrong(reward: Any, value: Any, next_value: Any, terminated: Any, done: Any, **options: Any) -> Any:
        never = torch.zeros_like(done)
        return right(reward, value, next_value, never, never, **options)

    return patch.object(ppo, "gae", wrong)


def _transposed_advantages() -> Any:
    from lemniscate.algos import ppo

    right = ppo.gae

    def wrong(*args: Any, **options: Any) -> Any:
        advantage, target = right(*args, **options)
        return advantage.T.reshape(advantage.shape), target  # [N, T] read as [T, N]

    return patch.object(ppo, "gae", wrong)


def _gradients_add_up() -> Any:
    from lemniscate.optim.adam import Adam

    right = Adam.descend

    def wrong(self: Any, gradient: Any) -> Any:
        if not hasattr(self, "never_zeroed"):
            self.never_zeroed = torch.zeros_like(gradient)
        self.never_zeroed.add_(gradient)
        return right(self, self.never_zeroed)

    return patch.object(Adam, "descend", wrong)


LEARNERS: dict[str, Callable[[], Any]] = {
    "a ratio that is always 1": _ratio_is_one,
    "advantages in another order": _transposed_advantages,
    "ends that the advantage ignores": _ends_ignored,
    "gradients that are never zeroed": _gradients_add_up,
}

ON = {"CartPole-v1": 50_000, "LunarLander-v3": 120_000, "HalfCheetah-v5": 120_000}
"""environments of faults under PPO, with the steps of a run"""
BOX = {"HalfCheetah-v5": 120_000, "Pendulum-v1": 60_000, "InvertedPendulum-v5": 60_000}
"""environments of faults that continuous actions have"""
FALL = {"CartPole-v1": 50_000, "LunarLander-v3": 120_000, "InvertedPendulum-v5": 60_000}
"""environments whose episodes end by a failure; those of HalfCheetah do not"""
QUICK_HANDS = {"CartPole-v1": 50_000, "HalfCheetah-v5": 120_000, "InvertedPendulum-v5": 60_000}
"""environments in which a few steps are a long time; in LunarLander they are not"""
CHANCE = {"CartPole-v1": 50_000, "LunarLander-v3": 120_000, "Pendulum-v1": 60_000}
"""environments whose episodes differ much under one policy"""
OFF = {"Pendulum-v1": 3_000, "Reacher-v5": 3_000, "InvertedPendulum-v5": 3_000}
"""environments of faults under SAC"""
QUICK = {"learning_starts": 1_000, "log_every": 100}
"""fields of SAC in a short run"""

UNSEEN: dict[str, tuple[str, Mapping[str, int], Mapping[str, Any] | str, str]] = {
    # fault: algorithm, environments, fields or the name of a change in `LEARNERS`, what is right to say
    "reward only at the end": (
        "ppo", ON, {"wrappers": ("unseen:LateReward",)},
        "The reward is sparse or delayed: it is 0 in nearly every step, and all of it comes at the end of"
        " an episode.",
    ),
    "a life that costs": (
        "ppo", FALL, {"wrappers": ("unseen:CostlyLife(cost=5)",)},
        "The reward per step is negative, so that to end the episode early pays: the return rises while"
        " episodes get shorter.",
    ),
    "observations as whole numbers": (
        "ppo", ON, {"wrappers": ("unseen:WholeNumbers",)},
        "The observation carries too little: it is rounded or cast to whole numbers, and many or all of"
        " its parts hardly ever change.",
    ),
    "observations under noise": (
        "sac", OFF, QUICK | {"wrappers": ("unseen:NoisySensor(std=1)",)},
        "The observation is mostly noise: it does not tell the state, so that neither it nor the action"
        " predicts what follows.",
    ),
    "actions that are too weak": (
        "ppo", BOX, {"wrappers": ("unseen:WeakActions(share=0.01)",)},
        "The actions have next to no effect on the environment: their unit, scale or bounds are wrong.",
    ),
    "actions that come late": (
        "ppo", QUICK_HANDS, {"wrappers": ("unseen:LateActions(steps=5)",)},
        "The action does not act on the step in which it is given (a delay of actions): what follows at"
        " once does not depend on it.",
    ),
    "few updates in all": (
        "ppo", ON, {"num_envs": 16, "num_steps": 1_024, "minibatch_size": 16_384, "epochs": 4},
        "The whole run has too few updates or gradient steps: the rollout (num_envs, num_steps) or the"
        " minibatch is too large for its steps.",
    ),
    "a learning rate that rises": (
        "ppo", ON, {"learning_rate": "1e-5>0.3", "desired_kl": None},
        "The learning rate becomes far too high as the run goes on (its schedule is the wrong way round),"
        " and the policy breaks.",
    ),
    "Adam's ε too large": (
        "ppo", ON, {"adam_eps": 1.0},
        "adam_eps is far too large, so that Adam's steps are tiny and the policy hardly moves.",
    ),
    "many environments, one gradient step": (
        "sac", OFF, QUICK | {"num_envs": 8, "num_updates": 1, "log_every": 12},
        "There are too few gradient steps for the steps taken: num_updates does not go with the number of"
        " parallel environments (the replay ratio is too low).",
    ),
    "a policy that waits": (
        "sac", OFF, QUICK | {"policy_delay": 100},
        "policy_delay is far too large: the policy and the target networks are updated so seldom that"
        " they hardly move.",
    ),
    "old probabilities of the new policy": (
        "ppo", ON, "a ratio that is always 1",
        "The probability ratio is always 1, the KL and the clip fraction exactly 0 (the old"
        " log-probability is computed anew), so that nothing holds the policy back.",
    ),
    "episodes that run into each other": (
        "ppo", FALL, "ends that the advantage ignores",
        "The ends of episodes are ignored in the advantages and value targets: they bootstrap over a"
        " termination, and the policy gets worse.",
    ),
    "advantages of other steps": (
        "ppo", ON, "advantages in another order",
        "The policy's advantages do not belong to its actions (rows in another order): it moves, but what"
        " it learns from is noise and the return does not rise.",
    ),
    "no zero_grad": (
        "ppo", ON, "gradients that are never zeroed",
        "The gradients add up from step to step (they are not zeroed): their norm grows without an end"
        " and steps go a stale way.",
    ),
    "the best of single episodes": (
        "ppo", CHANCE, {"evaluate_every": 2_000, "evaluate_episodes": 1, "keep_best": True},
        "Evaluations have a single episode, so that their returns, and the best checkpoint, are a matter"
        " of luck: more episodes are needed.",
    ),
}  # fmt: skip
