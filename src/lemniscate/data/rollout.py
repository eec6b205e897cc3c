"""Collecting rollouts and cutting them into minibatches."""

import torch
from torch import Generator, Tensor

from lemniscate.envs.api import VecEnv
from lemniscate.nn.policies import Policy
from lemniscate.types import Rollout


@torch.no_grad()
def collect(env: VecEnv, policy: Policy, num_steps: int, generator: Generator) -> Rollout:
    """Act `num_steps` times in every environment, from where it stands. Returns a rollout [T, N, …]."""
    rows = []
    for noise in policy.noise((num_steps, env.num_envs), generator):
        obs = env.obs
        action = policy.act(obs, noise)
        step = env.step(action)
        rows.append(Rollout(obs, action, step.reward, step.next_obs, step.terminated, step.truncated, step.valid))
    return Rollout.stack(rows)


def minibatches(rows: Tensor, count: int, size: int, generator: Generator) -> Tensor:
    """`rows` in a new random order, cut into `count` parts of `size`: [count, size].

    Every part has the same size, whatever was played, so that one compiled program serves all: rows beyond
    `count · size` sit this epoch out, and where rows are missing the first ones are taken again.
    """
    order = rows[torch.randperm(len(rows), generator=generator, device=generator.device)]
    again = -(-count * size // len(rows))
    return order.repeat(again)[: count * size].view(count, size)
