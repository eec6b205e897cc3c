"""Whole episodes, which REINFORCE learns from, and the rows that a Q learns from."""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Generator, Tensor

from lemniscate.envs.vec_env import VecEnv
from lemniscate.maths import Gaussian, SquashedGaussian
from lemniscate.nn.policies import Policy
from lemniscate.types import Record, Rollout


@torch.no_grad()
def collect_episodes(env: VecEnv, policy: Policy, episodes: int, generator: Generator) -> Rollout:
    """Act until every environment has completed `episodes` whole episodes, from where it stands.

    Returns:
        A rollout [T, N, …], T as large as it takes. The rows before an environment's first end and after its last are
        not `valid`: each gives the same number of episodes, since those that end first are short ones.

    Raises:
        UserError: an episode of an environment without a time limit takes more than 20,000 steps.
    """
    rows, noise = [], partial(policy.draw_noise, (env.num_envs,), generator)
    ended = torch.zeros(env.num_envs, dtype=torch.int64, device=env.device)
    age = torch.zeros_like(ended)
    with env.collecting:
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
