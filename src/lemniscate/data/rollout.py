"""Collecting rollouts, cutting them into minibatches, and the rows that a Q learns from."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Generator, Tensor

from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError
from lemniscate.maths import Gaussian, SquashedGaussian
from lemniscate.nn.policies import Policy
from lemniscate.spec import Box, Spec
from lemniscate.types import Record, Rollout


def collect(
    env: VecEnv,
    policy: Policy,
    num_steps: int,
    generator: Generator,
    *,
    through: Callable[[Tensor], Tensor] | None = None,
) -> Rollout:
    """Act `num_steps` times in every environment, from where it stands.

    Where actions go `through` a function into the environments, observations, actions and rewards are differentiable
    functions of the policy's parameters.

    Returns:
        A rollout [T, N, …]; [T, 2 N, …] where there is a symmetry: behind them are their mirror images.

    Raises:
        UserError: rewards that are to be differentiable, and are not.
    """
    rows, began = [], time.perf_counter()
    if through:
        env.detach()
    with torch.set_grad_enabled(through is not None):
        for noise in policy.draw_noise((num_steps, env.num_envs), generator):
            obs = env.obs
            action = policy.act(obs, noise)
            step = env.step(through(action) if through else action)
            ends = step.terminated, step.truncated, step.valid
            rows.append(Rollout(obs, action, step.reward, step.next_obs, *ends))
        rollout = Rollout.stack(rows)
        if through and not rollout.reward.requires_grad:
            name = type(env.backend).__name__
            raise UserError(f"The rewards of {name} have no history of the actions, though it says differentiable.")
        rollout = env.mirror.both(rollout, 1) if env.mirror else rollout
    env.collecting += time.perf_counter() - began
    return rollout


@torch.no_grad()
def collect_episodes(env: VecEnv, policy: Policy, episodes: int, generator: Generator) -> Rollout:
    """Act until every environment has completed `episodes` whole episodes, from where it stands.

    Returns:
        A rollout [T, N, …], T as large as it takes. The rows before an environment's first end and after its last are
        not `valid`: each gives the same number of episodes, since those that end first are short ones.

    Raises:
        UserError: an episode of an environment without a time limit takes more than 20,000 steps.
    """
    rows, began = [], time.perf_counter()
    noise = partial(policy.draw_noise, (env.num_envs,), generator)
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
    env.collecting += time.perf_counter() - began
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


@dataclass(frozen=True)
class QBatch(Record):
    """The rows of a rollout with Q(s, a) and its target, [B, …]."""

    obs: Tensor
    action: Tensor
    value: Tensor
    target: Tensor


@dataclass(frozen=True)
class SoftBatch(QBatch):
    """The rows of a rollout with Q(s, a), its target, and the policy's μ and log σ at collection, [B, …]."""

    mean: Tensor
    log_std: Tensor

    def kl_to(self, policy: SquashedGaussian) -> Tensor:
        """KL(π_old ‖ π) of each row, [B]: that of the normals before the tanh, which maps both in the same way."""
        return Gaussian(self.mean, self.log_std).kl(Gaussian(policy.mean, policy.log_std))
