"""Episodes played without learning: returns, lengths, measures, and the bias of Q beside the return that followed.

Nothing here is shared with training: neither environments nor random numbers.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import torch
from torch import Generator, Tensor, nn

from lemniscate.envs.backend import Baseline, Summary
from lemniscate.envs.spaces import random_action
from lemniscate.envs.vec_env import VecEnv
from lemniscate.nn.actor_q import ActorQ
from lemniscate.nn.policies import Policy
from lemniscate.run.config import RunConfig
from lemniscate.run.off_policy import OffPolicyConfig
from lemniscate.run.seeding import derive, generator
from lemniscate.types import Step, wide_float

EVALUATION = 1
"""the stream of seeds that training never draws from"""


@dataclass(frozen=True)
class QBias:
    """Predicted and realised returns of each episode, in the order of an evaluation's returns.

    `predicted` is Q(s₀, a₀). `realised` is Σ γ^t r_t, plus γ^T Q(s_T, a_T) where a time limit ended the episode after T
    steps, since Q counts what follows too. Under SAC both include the entropy bonus of every state but the first. There
    Q is that of the random policy, so a difference between the random and the deterministic policy is part of the bias.
    """

    predicted: list[float]
    realised: list[float]

    @property
    def means(self) -> tuple[float, float]:
        """The means of `predicted` and of `realised`."""
        return sum(self.predicted) / len(self.predicted), sum(self.realised) / len(self.realised)

    @property
    def bias(self) -> float:
        """(mean predicted − mean realised) / |mean realised|; infinite if the mean realised return is 0."""
        predicted, realised = self.means
        return (predicted - realised) / abs(realised) if realised else math.inf

    def to_json(self) -> dict[str, object]:
        """A dictionary that survives JSON; it has `bias` only if that is finite."""
        return {**vars(self), **({"bias": self.bias} if math.isfinite(self.bias) else {})}

    def __str__(self) -> str:
        predicted, realised = self.means
        said = f"Q(s₀, a₀) says {_short(predicted)}, and {_short(realised)} followed, discounted: "
        if abs(predicted - realised) <= 0.01 * abs(realised):
            return said + "it is right to a hundredth"
        size = f"{100 * abs(self.bias):.0f} %" if abs(self.bias) < 10 else _short(abs(predicted - realised))
        return said + f"it {'over' if predicted > realised else 'under'}-estimates by {size}"


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation. `returns` and `lengths` are ordered by environment, then by time.

    `measures` has the mean of everything that the environment measures, over all steps of all episodes, and the
    summaries that it declares, such as `rmse_mm`. `terminated` is how many episodes ended by the environment's rules.
    """

    env_id: str
    episodes: int
    mean_return: float
    std_return: float
    returns: list[float]
    lengths: list[int]
    terminated: int
    measures: dict[str, float] = field(default_factory=dict)
    q_bias: QBias | None = None
    date: str = field(default="", compare=False)

    def to_json(self) -> dict[str, object]:
        """One object of JSON, with the measures among the other numbers; a measure that is not finite is None."""
        apart = ("measures", "q_bias", "date")
        scores: dict[str, object] = {name: value for name, value in vars(self).items() if name not in apart}
        measures = {name: value if math.isfinite(value) else None for name, value in self.measures.items()}
        return scores | measures | ({"q_bias": self.q_bias.to_json()} if self.q_bias else {})

    def means(self) -> dict[str, float]:
        """The numbers of one line of metrics."""
        means = {"return": self.mean_return, "length": sum(self.lengths) / self.episodes, **self.measures}
        if self.q_bias:
            means["q"], means["q_realised"] = self.q_bias.means
            means["q_bias"] = self.q_bias.bias
        return means

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
    policy: Policy | Baseline | None, env: VecEnv, episodes: int, seed: int, deterministic: bool = True
) -> Iterator[tuple[Tensor, Tensor, Step, Tensor]]:
    """Play `episodes` whole episodes; yields (obs, action, step, the mask [N] of the environments that still count).

    Every environment has its own share of the episodes, fixed beforehand: taking the first that end would favour short
    ones. Without a policy, actions are uniformly random. Raises `UserError` when an episode of an environment without a
    time limit takes more than 20,000 steps.
    """
    rng = generator(seed, env.device, EVALUATION, 1)
    numbers = torch.arange(env.num_envs, device=env.device)
    left = episodes // env.num_envs + (numbers < episodes % env.num_envs).int()
    env.carrier = policy.carrier() if isinstance(policy, Policy) else None
    env.restart(derive(seed, EVALUATION, 0))
    age = torch.zeros_like(left)
    while (left > 0).any():
        env.require_end(int(age.max()))
        obs = env.obs
        action = _act(policy, deterministic, env, rng)
        step = env.step(action)
        yield obs, action, step, (left > 0) & step.valid
        done = (step.terminated | step.truncated) & step.valid
        left, age = left - done.int(), (age + 1) * (~done & (left > 0))


def _act(policy: Policy | Baseline | None, deterministic: bool, env: VecEnv, rng: Generator) -> Tensor:
    if policy is None:
        return random_action(env.spec, env.obs, rng)
    distribution = policy(env.obs)
    if deterministic or not isinstance(policy, Policy):
        return distribution.mode()
    return distribution.sample(policy.draw_noise((env.num_envs,), rng))


def evaluate(
    policy: Policy | Baseline,
    env: VecEnv,
    episodes: int,
    seed: int,
    deterministic: bool = True,
    critic: tuple[ActorQ, float] | None = None,
) -> Evaluation:
    """Returns, lengths and measures of `episodes` whole episodes from starts drawn with `seed`.

    With a `critic`, networks and γ, also what Q predicts at each beginning, beside the return that followed.
    """
    table = EpisodeTable(env.num_envs, env.device)
    q_bias_meter = QBiasMeter(*critic, env.num_envs, generator(seed, env.device, EVALUATION, 2)) if critic else None
    for obs, action, step, counts in play_episodes(policy, env, episodes, seed, deterministic):
        if q_bias_meter:
            q_bias_meter.follow(obs, action, step, counts)
        table.add(step, counts)
    return table.evaluation(env.spec.env_id, env.summaries, q_bias_meter.q_bias() if q_bias_meter else None)


class EpisodeTable:
    """Adds up N parallel environments step by step: returns, lengths, and the rows of their measures."""

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self.terminated = 0
        self._running = torch.zeros(2, num_envs, dtype=wide_float(device), device=device)
        """[return, length] of the episode under way in each environment"""
        self._numbers = torch.arange(num_envs, device=device)
        self._ended: list[Tensor] = []
        self._measured: dict[str, list[Tensor]] = {}

    def add(self, step: Step, counts: Tensor) -> None:
        """One step of every environment, of which only those in `counts` [N] count."""
        done = (step.terminated | step.truncated) & counts
        for name, values in step.measures.items():
            row = torch.stack([values, self._running[1], done])[:, counts & values.isfinite()]
            self._measured.setdefault(name, []).append(row)
        self._running = self._running + torch.stack([step.reward, torch.ones_like(step.reward)]) * counts
        if done.any():
            self._ended.append(torch.stack([*self._running, self._numbers])[:, done])
            self.terminated += int((step.terminated & counts).sum())
            self._running = self._running * ~done

    def evaluation(self, env_id: str, summaries: Sequence[Summary], q_bias: QBias | None = None) -> Evaluation:
        """The result, from all episodes that ended."""
        returns, lengths = self.returns_and_lengths()
        return Evaluation(
            env_id=env_id,
            episodes=len(returns),
            mean_return=returns.mean().item(),
            std_return=returns.std(correction=0).item(),
            returns=returns.tolist(),
            lengths=lengths.int().tolist(),
            terminated=self.terminated,
            measures=self.measures(summaries),
            q_bias=q_bias,
            date=datetime.now(UTC).isoformat(timespec="seconds"),
        )

    def returns_and_lengths(self) -> Tensor:
        """[2, episodes]: ordered by environment, then by time."""
        table = torch.cat(self._ended, dim=1)
        return table[:2, table[2].argsort(stable=True)]  # the columns are in the order of time; a stable sort keeps it

    def measures(self, summaries: Sequence[Summary]) -> dict[str, float]:
        """The mean of every measure over all rows; then the summaries of those that there are."""
        tables = {name: torch.cat(rows, dim=1) for name, rows in self._measured.items()}
        means = {name: table[0].mean().item() for name, table in tables.items()}
        return means | {s.name: _summarize(s, *tables[s.measure]) for s in summaries if s.measure in tables}


def _summarize(summary: Summary, values: Tensor, age: Tensor, last: Tensor) -> float:
    """One number from the rows of a measure [B]: its values, the steps before each, whether it ends an episode."""
    rows = (age >= summary.skip) & (last.bool() if summary.kind == "last" else True)
    chosen = values[rows]
    mean = chosen.square().mean().sqrt() if summary.kind == "rms" else chosen.mean()
    return summary.scale * mean.item()


class QBiasMeter:
    """The measurement of a `QBias`, step by step of an evaluation; `gamma` is the discount γ that Q was trained with.

    The `generator` is of the noise that the entropy of a random policy is sampled with.
    """

    def __init__(self, networks: ActorQ, gamma: float, num_envs: int, generator: Generator) -> None:
        self._networks, self._gamma, self._generator = networks, gamma, generator
        self._running = torch.zeros(3, num_envs, device=generator.device)
        """[predicted, realised, steps] of the present episode of each environment"""
        self._env_indices = torch.arange(num_envs, device=generator.device)
        self._ended: list[Tensor] = []

    @torch.no_grad()
    def follow(self, obs: Tensor, action: Tensor, step: Step, counts: Tensor) -> None:
        """Take one step of every environment; only those in the mask `counts` [N] count."""
        networks = self._networks
        predicted, realised, age = self._running
        begins = age == 0
        if begins.any():
            predicted = torch.where(begins, networks.q(obs, action), predicted)
        paid = step.reward + torch.where(begins, 0, networks.entropy_bonus(obs, self._generator))
        realised, age = realised + self._gamma**age * paid * counts, age + counts
        done = (step.terminated | step.truncated) & counts
        if done.any():
            last = step.next_obs
            value = networks.q(last, networks.policy(last).mode()) + networks.entropy_bonus(last, self._generator)
            followed = realised + self._gamma**age * value * ~step.terminated
            self._ended.append(torch.stack([predicted, followed, self._env_indices])[:, done])
        self._running = torch.stack([predicted, realised, age]) * ~done

    def q_bias(self) -> QBias:
        """The bias over all episodes that ended."""
        table = torch.cat(self._ended, dim=1)
        predicted, realised = table[:2, table[2].argsort(stable=True)].tolist()
        return QBias(predicted, realised)


def critic_of(networks: nn.Module, config: RunConfig) -> tuple[ActorQ, float] | None:
    """The networks and γ of an algorithm that learns Q from a replay buffer; None for the others."""
    return (networks, config.gamma) if isinstance(networks, ActorQ) and isinstance(config, OffPolicyConfig) else None
