"""Is Q honest? What it says of the first action of an episode, beside the discounted return that followed."""

import math
from dataclasses import dataclass

import torch
from torch import Generator, Tensor, nn

from lemniscate.nn.actor_critic import ActorQ
from lemniscate.run.config import OffPolicyConfig, RunConfig
from lemniscate.types import Step


@dataclass(frozen=True)
class QBias:
    """Episode by episode, in the order of an evaluation's returns: copy by copy, then as they ended.

    `realised` is Σ γ^t r_t; where the clock ended the episode, what Q expects from there on is added, since Q speaks of
    what follows too. Under SAC both hold the price of the policy's entropy in every state but the first; yet Q speaks
    of the random policy, so that what the deterministic one does better (or worse) is part of the difference.
    """

    predicted: list[float]
    realised: list[float]

    @property
    def means(self) -> tuple[float, float]:
        """Of what was predicted, and of what came."""
        return sum(self.predicted) / len(self.predicted), sum(self.realised) / len(self.realised)

    @property
    def bias(self) -> float:
        """How much more was predicted than came, as a share of what came; not finite if nothing did."""
        predicted, realised = self.means
        return (predicted - realised) / abs(realised) if realised else math.inf

    def to_json(self) -> dict[str, object]:
        """With the bias, where it is a number."""
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
    """Follows an evaluation step by step.

    Args:
        networks: whose Q is asked.
        gamma: γ of its training.
        num_envs: copies that are followed.
        generator: samples the entropy of a random policy.
    """

    def __init__(self, networks: ActorQ, gamma: float, num_envs: int, generator: Generator) -> None:
        self._networks, self._gamma, self._generator = networks, gamma, generator
        self._running = torch.zeros(3, num_envs, device=generator.device)
        """[predicted, realised, steps] of the episode under way in each copy"""
        self._copies = torch.arange(num_envs, device=generator.device)
        self._ended: list[Tensor] = []

    @torch.no_grad()
    def follow(self, obs: Tensor, action: Tensor, step: Step, counts: Tensor) -> None:
        """One step of every copy; only the copies in `counts` [N] count."""
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
            self._ended.append(torch.stack([predicted, followed, self._copies])[:, done])
        self._running = torch.stack([predicted, realised, age]) * ~done

    def q_bias(self) -> QBias:
        """Of all episodes that ended."""
        table = torch.cat(self._ended, dim=1)
        predicted, realised = table[:2, table[2].argsort(stable=True)].tolist()
        return QBias(predicted, realised)


def critic_of(networks: nn.Module, config: RunConfig) -> tuple[ActorQ, float] | None:
    """The networks and γ, where there is a Q to ask."""
    return (networks, config.gamma) if isinstance(networks, ActorQ) and isinstance(config, OffPolicyConfig) else None
