"""Collecting whole episodes."""

from functools import partial

import torch
from torch import Generator

from lemniscate.envs.vec_env import VecEnv
from lemniscate.nn.policies import Policy
from lemniscate.types import Rollout


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
