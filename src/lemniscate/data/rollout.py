"""Collecting rollouts and cutting them into minibatches."""

import math

import torch
from torch import Generator, Tensor

from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError
from lemniscate.nn.policies import Policy
from lemniscate.spec import Box, Spec
from lemniscate.types import Rollout


@torch.no_grad()
def collect(env: VecEnv, policy: Policy, num_steps: int, generator: Generator) -> Rollout:
    """Act `num_steps` times in every environment, from where it stands. Returns a rollout [T, N, …]."""
    rows = []
    with env.collecting:
        for noise in policy.draw_noise((num_steps, env.num_envs), generator):
            obs = env.obs
            action = policy.act(obs, noise)
            step = env.step(action)
            ends = step.terminated, step.truncated, step.valid
            rows.append(Rollout(obs, action, step.reward, step.next_obs, *ends))
        return Rollout.stack(rows)


def rollout_bytes(spec: Spec, num_steps: int, num_envs: int) -> int:
    """The memory that a rollout takes while its steps [N, …] are stacked to [T, N, …]; of each step 1 kB of its own."""
    action = spec.action.size if isinstance(spec.action, Box) else 2
    obs = (spec.observation_size + spec.privileged) * (1 if spec.image else 4)
    return num_steps * (num_envs * (3 * obs + 2 * (4 * action + 7)) + 1_000)


def rows_of(rollout: Rollout, length: int) -> Tensor:
    """The valid rows of a rollout [T, N, …], [B]; with L = `length`, pieces of L steps to learn from, [N · T / L, L].

    A piece is of one environment. The place of a row whose action was ignored has the first valid row of its piece,
    which starts from its own memory wherever it stands.
    """
    if not length:
        return rollout.valid_rows
    steps, envs = rollout.valid.shape
    rows = torch.arange(steps * envs, device=rollout.valid.device).view(-1, length, envs).movedim(-1, 1).flatten(0, 1)
    valid = rollout.valid.flatten()[rows]
    first = rows.gather(1, valid.int().argmax(1, keepdim=True))
    return torch.where(valid, rows, first)


def one_minibatch(rows: Tensor, num_rows: int) -> Tensor:
    """All rows [B] or pieces as one minibatch, in their order: indices [1, num_rows]; see `epoch_minibatches`."""
    return epoch_minibatches(rows, num_rows, num_rows, None)


def epoch_minibatches(rows: Tensor, num_rows: int, size: int, generator: Generator | None) -> Tensor:
    """The rows in a new random order, cut into the minibatches of one epoch: indices [K, M].

    K and M are the same in every epoch of a run, whatever the number of valid rows, since compiled programs are for
    one shape. Where rows are missing, the first ones of the order are repeated.

    Args:
        rows: of `rows_of`, [B] int64; or pieces of L rows, [B / L, L], which stay whole: the minibatches are then
            [K, M / L, L].
        num_rows: the number of rows of a rollout, at least B.
        size: M; a rollout with fewer rows is one minibatch.
        generator: of the order; None leaves it.

    Raises:
        UserError: there is no valid row.
    """
    if not len(rows):
        raise UserError("No valid transition in the whole rollout; increase num_steps.")
    if generator:
        rows = rows[torch.randperm(len(rows), generator=generator, device=generator.device)]
    size, length, piece = min(size, num_rows), rows[0].numel(), rows.shape[1:]
    total = math.ceil(num_rows / size) * size // length
    repeated = rows.repeat(math.ceil(total / len(rows)), *[1] * len(piece))
    return repeated[:total].view(-1, size // length, *piece)
