"""Collecting rollouts and cutting them into minibatches."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError
from lemniscate.nn.policies import Policy
from lemniscate.spec import Box, Spec
from lemniscate.types import Rollout, Streams


@torch.no_grad()
def collect(env: VecEnv, policy: Policy, num_steps: int, streams: Streams) -> Rollout:
    """Act `num_steps` times in every environment, from where it stands. Returns a rollout [T, N, …]."""
    rows = []
    with env.collecting:
        for noise in policy.draw_noise((num_steps, env.num_envs), streams):
            obs = env.obs
            action = env.act(policy.act, noise)
            step = env.step(action)
            ends = step.terminated, step.truncated, step.valid
            rows.append(Rollout(obs, action, step.reward, step.next_obs, *ends, len(streams)))
        return Rollout.stack(rows)


def rollout_bytes(spec: Spec, num_steps: int, num_envs: int) -> int:
    """The memory that a rollout takes while its steps [N, …] are stacked to [T, N, …]; of each step 1 kB of its own."""
    action = spec.action.size if isinstance(spec.action, Box) else 2
    obs = (spec.observation_size + spec.privileged) * (1 if spec.image else 4)
    return num_steps * (num_envs * (3 * obs + 2 * (4 * action + 7)) + 1_000)


@torch.no_grad()
def estimates(networks: Any, rollout: Rollout, *by_row: Tensor) -> tuple[Tensor, ...]:
    """The values of `networks.estimates` at every row, [T, N, …] each; it is called with each shard alone."""
    rows = (rollout.obs, rollout.next_obs, rollout.action, *by_row)
    parts = ((x.contiguous() for x in r.chunk(rollout.shards, 1)) for r in rows)
    columns = [networks.estimates(*part) for part in zip(*parts, strict=True)]
    return tuple(torch.cat(column, dim=1) for column in zip(*columns, strict=True))


def one_minibatch(valid_rows: Sequence[Tensor], num_rows: int) -> Tensor:
    """All valid rows as one minibatch, in their order: indices [1, num_rows]; see `epoch_minibatches`."""
    size = num_rows // len(valid_rows)
    return torch.cat([_cut(rows, size, size) for rows in valid_rows], dim=1)


def epoch_minibatches(valid_rows: Sequence[Tensor], num_rows: int, size: int, streams: Streams) -> Tensor:
    """The valid rows in a new random order, cut into the minibatches of one epoch: indices [K, M].

    K and M are the same in every epoch of a run, whatever the number of valid rows. Where rows are missing, the first
    ones of the order are repeated. Of several shards, each gives an equal part of every minibatch.

    Args:
        valid_rows: of each shard held, the indices of the rows to learn from, [B] int64.
        num_rows: the number of rows of a rollout, at least the sum of B.
        size: M / S, of each shard; a rollout with fewer rows is one minibatch.
        streams: of the order.

    Raises:
        UserError: there is no valid row.
    """
    most, parts = num_rows // len(streams), []
    for rows, stream in zip(valid_rows, streams, strict=True):
        order = torch.randperm(len(rows), generator=stream, device=stream.device)
        parts.append(_cut(rows[order], most, min(size, most)))
    return torch.cat(parts, dim=1)


def _cut(rows: Tensor, num_rows: int, size: int) -> Tensor:
    if not len(rows):
        raise UserError("No valid transition in the whole rollout; increase num_steps.")
    total = math.ceil(num_rows / size) * size
    return rows.repeat(math.ceil(total / len(rows)))[:total].view(-1, size)
