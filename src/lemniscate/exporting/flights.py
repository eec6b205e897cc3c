"""Observations of episodes in which an exported policy acts."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from lemniscate.api.policy import TrainedPolicy
from lemniscate.envs import registry
from lemniscate.envs.interface import Interface
from lemniscate.errors import UserError
from lemniscate.exporting.actions import Act, act_with, for_policy
from lemniscate.exporting.deployed import input_size
from lemniscate.maths import Deterministic
from lemniscate.nn.normalizer import RunningNorm
from lemniscate.run.environments import env_arguments
from lemniscate.run.evaluate import play_episodes
from lemniscate.spec import Box, Spec

ENVIRONMENTS, ROWS, TESTS = 16, 10_000, 64
"""environments side by side; observations at least; those of them that the self-test has"""
EDGES = 8
"""observations of the self-test beside these, for the clips"""


@dataclass(frozen=True)
class Flights:
    """Observations [R, O] float32, their environment, and the meaning of its numbers."""

    obs: np.ndarray
    interface: Interface


class _Driver:
    """A function of rows, of what a policy is given, in the place of the policy."""

    def __init__(self, act: Act, spec: Spec) -> None:
        self.act, self.kind, self.size = act, spec.action, input_size(spec)

    def __call__(self, obs: Tensor) -> Deterministic:
        return Deterministic(for_policy(self.act(self.given(obs)), self.kind))

    def given(self, obs: Tensor) -> np.ndarray:
        """Rows of the environment without what is privileged."""
        return np.ascontiguousarray(obs[:, : self.size].numpy())


def fly(policy: TrainedPolicy, act: Act, rows: int = ROWS, seed: int = 0) -> Flights:
    """Let `act` act in the environment of a policy's training until it has seen `rows` observations.

    Raises `UserError` where the environment cannot be made, or is another now.
    """
    env = registry.make(num_envs=ENVIRONMENTS, device="cpu", **env_arguments(policy.config))
    driver: Any = _Driver(act, policy.spec)
    seen: list[np.ndarray] = []
    try:
        if not env.spec.fits(policy.spec):
            raise UserError(f"{policy.spec.env_id} has other spaces here than in training.")
        for obs, _, _, counts in play_episodes(driver, env, episodes=10**9, seed=seed):
            seen.append(driver.given(obs[counts]).copy())
            if sum(map(len, seen)) >= rows:
                break
        return Flights(np.concatenate(seen), getattr(env.backend, "interface", Interface()))
    finally:
        env.close()


def self_tests(policy: TrainedPolicy, obs: np.ndarray) -> np.ndarray:
    """The observations of the self-test, [S, O]: real ones, from all over the flights; then some for the clips.

    Each of these is a real one with one number far outside of what was seen, so that a clip that was forgotten shows.
    There are none where nothing is clipped. Of discrete actions only those count that are not a matter of rounding.
    """
    obs = obs if isinstance(policy.spec.action, Box) else obs[_clear(policy, obs)]
    real = obs[np.linspace(0, len(obs) - 1, TESTS).round().astype(int)]
    normalizer, action = policy.module.normalizer, policy.spec.action
    size = policy.spec.observation_size
    if isinstance(normalizer, RunningNorm):
        mean, std = normalizer.mean.numpy(), normalizer.var.numpy() ** 0.5
        far = 3 * normalizer.clip * (std + 1e-4)
    elif isinstance(action, Box) and np.isfinite([*action.low, *action.high]).all():
        mean, far = obs[:, :size].mean(0), 10 * np.abs(obs[:, :size]).max(0) + 1
    else:
        return real
    edges = real[:: TESTS // EDGES].copy()
    for row, column in enumerate(np.linspace(0, size - 1, EDGES).round().astype(int)):
        edges[row, column] = (mean + (-1) ** row * far)[column]
    return np.concatenate([real, edges]).astype(np.float32)


def _clear(policy: TrainedPolicy, obs: np.ndarray) -> np.ndarray:
    """[R], whether a slightly different observation has the same action; all where none is so."""
    act = act_with(policy)
    same = [(act(obs * np.float32(factor)) == act(obs)).all(1) for factor in (0.99999, 1.00001)]
    clear = np.logical_and(*same)
    return clear if clear.any() else ~clear


def origin(policy: TrainedPolicy, tests: int) -> str:
    """The origin of a self-test's observations, in words."""
    edges = f", and {tests - TESTS} with one number far outside of them" if tests > TESTS else ""
    return f"{TESTS} of episodes of {policy.spec.env_id}{edges}"
