"""Flying a policy without learning. Nothing here is shared with training: not environments, nor random numbers."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial

import torch
from torch import Tensor

from lemniscate.envs.vec_env import VecEnv
from lemniscate.nn.actor_critic import ActorQ
from lemniscate.nn.policies import Policy
from lemniscate.run.q_bias import QBias, QBiasMeter
from lemniscate.run.seeding import derive, generator
from lemniscate.types import Step

EVALUATION = 1
"""the stream of seeds that training never draws from"""


@dataclass(frozen=True)
class Evaluation:
    """What a policy achieved; the tracking errors only where there is a reference to track."""

    env_id: str
    episodes: int
    mean_return: float
    std_return: float
    returns: list[float]
    lengths: list[int]
    terminated: int
    rmse_mm: float | None = None
    rmse_after_1s_mm: float | None = None
    q_bias: QBias | None = None
    date: str = field(default="", compare=False)

    def to_json(self) -> dict[str, object]:
        """Without what the environment does not have."""
        scores: dict[str, object] = {
            name: value for name, value in vars(self).items() if value is not None and name != "date"
        }
        return scores | ({"q_bias": self.q_bias.to_json()} if self.q_bias else {})

    def to_course(self) -> dict[str, object]:
        """The dictionary that a course on DDPG hands in with a policy; the time is ISO 8601."""
        return {
            "env_id": self.env_id,
            "mean_reward": self.mean_return,
            "std_reward": self.std_return,
            "n_evaluation_episodes": self.episodes,
            "eval_datetime": self.date,
        }


@torch.no_grad()
def play_episodes(
    policy: Policy, env: VecEnv, episodes: int, seed: int, deterministic: bool = True
) -> Iterator[tuple[Tensor, Tensor, Step, Tensor]]:
    """Play `episodes` whole episodes; yields (obs, action, step, the mask [N] of the copies that still count).

    Every copy has its own share of the episodes, fixed beforehand: taking the first that end would favour short ones.
    Raises `UserError` when an episode of an environment without a time limit takes more than 20,000 steps.
    """
    noise = partial(policy.draw_noise, (env.num_envs,), generator(seed, env.device, EVALUATION, 1))
    copies = torch.arange(env.num_envs, device=env.device)
    left = episodes // env.num_envs + (copies < episodes % env.num_envs).int()
    env.restart(derive(seed, EVALUATION, 0))
    age = torch.zeros_like(left)
    while (left > 0).any():
        env.require_end(int(age.max()))
        obs, distribution = env.obs, policy(env.obs)
        action = distribution.mode() if deterministic else distribution.sample(noise())
        step = env.step(action)
        yield obs, action, step, (left > 0) & step.valid
        done = (step.terminated | step.truncated) & step.valid
        left, age = left - done.int(), (age + 1) * (~done & (left > 0))


def evaluate(
    policy: Policy,
    env: VecEnv,
    episodes: int,
    seed: int,
    deterministic: bool = True,
    critic: tuple[ActorQ, float] | None = None,
) -> Evaluation:
    """Mean return over `episodes` whole episodes from starts drawn with `seed`; for drones the tracking error too.

    With a `critic`, networks and γ, also what Q says of each beginning, beside what followed.
    """
    running = torch.zeros(2, env.num_envs, device=env.device)
    ended: list[Tensor] = []
    errors: list[Tensor] = []
    terminated = 0
    q_bias_meter = QBiasMeter(*critic, env.num_envs, generator(seed, env.device, EVALUATION, 2)) if critic else None
    for obs, action, step, counts in play_episodes(policy, env, episodes, seed, deterministic):
        if q_bias_meter:
            q_bias_meter.follow(obs, action, step, counts)
        if env.spec.tracking:
            error = step.next_obs[:, slice(*env.spec.tracking)].square().sum(-1)
            errors.append(torch.stack([error, running[1]], dim=-1)[counts])
        running = running + torch.stack([step.reward, torch.ones_like(step.reward)]) * counts
        done = (step.terminated | step.truncated) & counts
        if done.any():
            ended.append(torch.stack([*running[:, done], torch.nonzero(done)[:, 0]]))
            terminated += int((step.terminated & counts).sum())
            running = running * ~done
    table = torch.cat(ended, dim=1)
    returns, lengths = table[:2, table[2].argsort(stable=True)]  # by copy, then by time
    mean, std = returns.mean().item(), returns.std(correction=0).item()
    scores = Evaluation(
        env.spec.env_id,
        episodes,
        mean,
        std,
        returns.tolist(),
        lengths.int().tolist(),
        terminated,
        q_bias=q_bias_meter.q_bias() if q_bias_meter else None,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
    )
    if not errors or env.spec.time_step is None:
        return scores
    squared, step_index = torch.cat(errors).unbind(-1)
    late = squared[step_index >= 1 / env.spec.time_step]
    after_1s = _root_mean_mm(late) if len(late) else math.nan
    return replace(scores, rmse_mm=_root_mean_mm(squared), rmse_after_1s_mm=after_1s)


def _root_mean_mm(squared_m: Tensor) -> float:
    return 1000 * squared_m.mean().sqrt().item()
