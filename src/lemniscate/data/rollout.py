"""Collecting rollouts and cutting them into minibatches."""

from collections.abc import Iterator

import torch
from torch import Generator, Tensor

from lemniscate.envs.api import VecEnv
from lemniscate.errors import NonFiniteError
from lemniscate.nn.policies import Policy
from lemniscate.types import Rollout


@torch.no_grad()
def collect(env: VecEnv, policy: Policy, num_steps: int, generator: Generator) -> Rollout:
    """Act `num_steps` times in every environment, from where it stands. Returns a rollout [T, N, …].

    Raises:
        NonFiniteError: an observation or a reward is NaN or infinite; nothing has learned from it yet.
    """
    rows = []
    for _ in range(num_steps):
        obs = env.obs
        action = policy(obs).sample(generator)
        step = env.step(action)
        rows.append(Rollout(obs, action, step.reward, step.next_obs, step.terminated, step.truncated, step.valid))
    rollout = Rollout.stack(rows)
    for name, values in (("observation", rollout.obs), ("reward", rollout.reward), ("observation", rollout.next_obs)):
        _require_finite(name, values, env.steps)
    return rollout


def _require_finite(name: str, values: Tensor, steps: int) -> None:
    if torch.isfinite(values.sum()):  # a single NaN or infinity shows in the sum, and the sum is cheap
        return
    bad = torch.nonzero(~torch.isfinite(values))
    if len(bad):
        t, n = int(bad[0, 0]), int(bad[0, 1])
        step = steps - (len(values) - t) * values.shape[1]
        raise NonFiniteError(f"The {name} of environment {n} is {values[tuple(bad[0])].item()} at step {step:,}.")


def minibatches(size: int, count: int, epochs: int, generator: Generator) -> Iterator[list[Tensor]]:
    """For each epoch, a new permutation of 0 … size-1 in `count` equal parts; a remainder sits this epoch out."""
    part = size // count
    for _ in range(epochs):
        rows = torch.randperm(size, generator=generator, device=generator.device)
        yield list(rows[: part * count].split(part))
