# ruff: noqa: D102  (the methods are those of Gymnasium's wrappers)
"""A sixth held-out set of faults for the doctor, in the style of `unseen_too.py`.

A seventh person, who knew neither the rules nor the sets before, was asked for faults of the kinds that the doctor
promises to name, and for healthy runs of the same environments. Of 31 faults that did harm 26 were named first; these
are the others, and one whose text said less than the fault.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
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
}  # fmt: skip
