# ruff: noqa: D102  (the methods are those of Gymnasium's wrappers)
"""A sixth held-out set of faults for the doctor, in the style of `unseen_too.py`.

A seventh and an eighth person, who knew neither the rules nor the sets before, were asked for faults of the kinds that
the doctor promises to name, and for healthy runs of the same environments. Of 77 faults that did harm 59 were named
first; these are others, for which there was a signal, each in two environments.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import torch
from unseen import QUICK


class Growing(gym.Wrapper):
    """Observations that grow by 3 % in each step of an episode."""

    def reset(self, **kwargs):
        self.steps = 0
        return super().reset(**kwargs)

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        self.steps += 1
        obs = np.clip(obs * 1.03 ** min(self.steps, 1500), -1e30, 1e30).astype(np.float32)
        return obs, reward, terminated, truncated, info


def _sizes_alone() -> Any:
    from lemniscate.algos import reinforce

    return patch.object(reinforce, "standardize", lambda x: x.abs())


def _weights_are_rewards() -> Any:
    from lemniscate.algos import reinforce

    return patch.object(reinforce, "reward_to_go", lambda reward, *_, gamma: reward.clone())


def _forwards() -> Any:
    """The recursion of the advantage goes from the first row to the last."""
    from lemniscate.algos import ppo

    def wrong(reward, value, next_value, terminated, done, *, gamma, lam):
        delta, found = reward + gamma * next_value * ~terminated - value, []
        trace = torch.zeros_like(delta[0])
        for row, ended in zip(delta, done, strict=True):
            found.append(row + gamma * lam * trace)
            trace = found[-1] * ~ended
        return torch.stack(found), torch.stack(found) + value

    return patch.object(ppo, "gae", wrong)


def _no_end_at_all() -> Any:
    from lemniscate.algos import a2c

    right = a2c.gae
    return patch.object(
        a2c, "gae", lambda r, v, n, ends, done, **rest: right(r, v, n, ends & False, done & False, **rest)
    )


def _ends_of_both_kinds() -> Any:
    from lemniscate.algos import ppo

    right = ppo.gae
    return patch.object(ppo, "gae", lambda r, v, n, _, done, **rest: right(r, v, n, done, done, **rest))


def _uphill() -> Any:
    from lemniscate.algos import trpo

    right = trpo.natural_step
    return patch.object(trpo, "natural_step", lambda *args, **rest: -right(*args, **rest))


@contextmanager
def _surer() -> Iterator[None]:
    from lemniscate.algos import ppo

    right, weight = ppo.loss, {"entropy_coef": 0.3}

    def wrong(config, networks, batch):
        total, metrics = right(config, networks, batch)
        return total + 2 * config.entropy_coef * networks.policy(batch.obs).entropy().mean(), metrics

    with patch.dict(ppo.Config.__init__.__kwdefaults__, weight), patch.object(ppo, "loss", wrong):
        yield


def _minus_in_the_target() -> Any:
    from lemniscate.algos import pqn

    right = pqn.q_lambda
    return patch.object(pqn, "q_lambda", lambda reward, *rest, **options: right(-reward, *rest, **options))


def _actions_of_other_rows() -> Any:
    from lemniscate.algos import ppo

    right = ppo.advantages

    def wrong(*args: Any) -> Any:
        batch = right(*args)
        return replace(batch, action=batch.action.roll(64, 0))

    return patch.object(ppo, "advantages", wrong)


LEARNERS: dict[str, Callable[[], Any]] = {
    "advantages without their sign": _sizes_alone,
    "minus the reward in Q's target": _minus_in_the_target,
    "actions of other rows": _actions_of_other_rows,
    "rewards for returns": _weights_are_rewards,
    "GAE from the first row on": _forwards,
    "GAE without ends": _no_end_at_all,
    "every end is a termination": _ends_of_both_kinds,
    "minus the natural step": _uphill,
    "minus the entropy bonus": _surer,
}

SWINGS = {"Pendulum-v1": 4_000, "Reacher-v5": 4_000}

UNSEEN_SIX: dict[str, tuple[str, Mapping[str, int], Mapping[str, Any] | str, str]] = {
    # fault: algorithm, environments, fields or the name of a change in `LEARNERS`, what is right to say
    "observations that grow": (
        "ppo", {"LunarLander-v3": 100_000, "HalfCheetah-v5": 120_000}, {"wrappers": ("unseen_six:Growing",)},
        "Observations explode within an episode.",
    ),
    "sizes of advantages": (
        "reinforce", {"CartPole-v1": 60_000, "InvertedPendulum-v5": 60_000}, "advantages without their sign",
        "The weights of log π are not centred: all that was done is made likelier.",
    ),
    "a minus in the target": (
        "pqn", {"CartPole-v1": 60_000, "Acrobot-v1": 60_000}, "minus the reward in Q's target",
        "Q has the other sign than the rewards.",
    ),
    "rows that do not belong together": (
        "ppo", {"InvertedDoublePendulum-v5": 60_000, "Reacher-v5": 60_000}, "actions of other rows",
        "Observations and actions are of different rows.",
    ),
    "a value that counts for nothing": (
        "ppo", {"Pendulum-v1": 60_000, "LunarLander-v3": 100_000}, {"value_coef": 0.0},
        "The weight of the value's loss is 0.",
    ),
    "a temperature far too high": (
        "sac", SWINGS, QUICK | {"initial_temperature": 200.0}, "The initial temperature is far too high.",
    ),
    "a reward for each action alone": (
        "reinforce", {"CartPole-v1": 60_000, "Acrobot-v1": 60_000}, "rewards for returns",
        "V has one reward in it: nothing that follows counts.",
    ),
    "forwards in time": (
        "ppo", {"CartPole-v1": 50_000, "InvertedPendulum-v5": 60_000}, "GAE from the first row on",
        "The recursion goes the wrong way: targets feed on themselves.",
    ),
    "no ends": (
        "a2c", {"CartPole-v1": 60_000, "InvertedPendulum-v5": 60_000}, "GAE without ends",
        "The value and the advantage go on behind the ends of episodes.",
    ),
    "limits are ends": (
        "ppo", {"Pendulum-v1": 60_000, "Reacher-v5": 60_000}, "every end is a termination",
        "The bootstrap is missing where a time limit cuts an episode.",
    ),
    "the wrong way": (
        "trpo", {"InvertedPendulum-v5": 60_000, "CartPole-v1": 50_000}, "minus the natural step",
        "The step goes up where it is to go down, and the line search refuses it.",
    ),
    "a bonus with a minus": (
        "ppo", {"CartPole-v1": 50_000, "LunarLander-v3": 100_000}, "minus the entropy bonus",
        "The sign of the entropy bonus is wrong.",
    ),
}  # fmt: skip
