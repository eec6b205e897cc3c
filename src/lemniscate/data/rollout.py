"""Collecting rollouts and cutting them into minibatches."""

from collections.abc import Iterator

import torch
from torch import Generator, Tensor

from lemniscate.envs.api import VecEnv
from lemniscate.nn.policies import Policy
from lemniscate.types import Rollout


@torch.no_grad()
def collect(env: VecEnv, policy: Policy, num_steps: int, generator: Generator) -> Rollout:
    """Act `num_steps` times in every environment, from where it stands. Returns a rollout [T, N, …]."""
    rows = []
    for _ in range(num_steps):
        obs = env.obs
        action = policy(obs).sample(generator)
        step = env.step(action)
        rows.append(Rollout(obs, action, step.reward, step.next_obs, step.terminated, step.truncated, step.valid))
    return Rollout.stack(rows)


def minibatches(size: int, count: int, epochs: int, generator: Generator) -> Iterator[list[Tensor]]:
    """For each epoch, a new permutation of 0 … size-1 in `count` equal parts; a remainder sits this epoch out."""
    part = size // count
    for _ in range(epochs):
        rows = torch.randperm(size, generator=generator, device=generator.device)
        yield list(rows[: part * count].split(part))
