"""The bias of Q: its value for the first action of each episode, beside the discounted return that followed."""

import math
from dataclasses import dataclass

import torch
from torch import Generator, Tensor, nn

from lemniscate.nn.actor_q import ActorQ
from lemniscate.run.config import RunConfig
from lemniscate.run.off_policy import OffPolicyConfig
from lemniscate.types import Step


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


class QBiasMeter:
    """The measurement of a `QBias`, step by step of an evaluation.

    Args:
        networks: the policy and the Q that is measured.
        gamma: the discount γ that Q was trained with.
        num_envs: parallel environments of the evaluation.
        generator: of the noise that the entropy of a random policy is sampled with.
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
    """The networks and γ of an algorithm that has a Q; None for the others."""
    return (networks, config.gamma) if isinstance(networks, ActorQ) and isinstance(config, OffPolicyConfig) else None
