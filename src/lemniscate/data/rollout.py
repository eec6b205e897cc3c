"""Collecting rollouts and cutting them into minibatches."""

import math
from functools import partial

import torch
from torch import Generator, Tensor

from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError
from lemniscate.nn.policies import Policy
from lemniscate.types import Rollout


@torch.no_grad()
def collect(env: VecEnv, policy: Policy, num_steps: int, generator: Generator) -> Rollout:
    """Act `num_steps` times in every environment, from where it stands. Returns a rollout [T, N, …]."""
    rows = []
    with env.collecting:
        for noise in policy.noise((num_steps, env.num_envs), generator):
            obs = env.obs
            action = policy.act(obs, noise)
            step = env.step(action)
            rows.append(Rollout(obs, action, step.reward, step.next_obs, step.terminated, step.truncated, step.valid))
        return Rollout.stack(rows)


@torch.no_grad()
def collect_episodes(env: VecEnv, policy: Policy, episodes: int, generator: Generator) -> Rollout:
    """Act until every environment has played `episodes` whole episodes, from wherever it stands.

    Returns:
        A rollout [T, N, …]; T is what it takes. The rows before an environment's first end and after its last are not
        `valid`: the same number of episodes from each, since taking those that end first would favour short ones.

    Raises:
        UserError: an episode of an environment without a time limit takes more than 20,000 steps.
    """
    rows, noise = [], partial(policy.noise, (env.num_envs,), generator)
    ended = torch.zeros(env.num_envs, dtype=torch.int64, device=env.device)
    age = torch.zeros_like(ended)
    while (ended <= episodes).any():
        env.require_end(int(age.max()))
        obs = env.obs
        action = policy.act(obs, noise())
        step = env.step(action)
        whole = step.valid & (ended >= 1) & (ended <= episodes)
        rows.append(Rollout(obs, action, step.reward, step.next_obs, step.terminated, step.truncated, whole))
        done = (step.terminated | step.truncated) & step.valid
        ended, age = ended + done.int(), (age + 1) * ~done
    return Rollout.stack(rows)


def whole_batch(played: Tensor, collected: int) -> Tensor:
    """All rows that were played, [B], as one minibatch [1, `collected`], in their order, filled up as below."""
    return minibatches(played, collected, collected, None)


def minibatches(played: Tensor, collected: int, size: int, generator: Generator | None) -> Tensor:
    """The rows of an epoch in a new random order, cut into minibatches: indices [K, b].

    Every epoch of a run has the same K and b, whatever was played, so that one compiled program serves all. Where rows
    are missing, the first ones of the order are taken again.

    Args:
        played: the rows to learn from, [B] int64, at most `collected`.
        collected: how many rows a rollout has.
        size: b; a rollout with fewer rows is one minibatch.
        generator: draws the order; without one it stays as it is.
    """
    if not len(played):
        raise UserError(
            "In a whole rollout every action was ignored by an environment that reset itself; take more num_steps."
        )
    size = min(size, collected)
    wanted = math.ceil(collected / size) * size
    order = played
    if generator:
        order = played[torch.randperm(len(played), generator=generator, device=generator.device)]
    return order.repeat(math.ceil(wanted / len(order)))[:wanted].view(-1, size)
