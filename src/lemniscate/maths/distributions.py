"""What a policy returns: distributions over actions, with sampling from a named generator."""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Generator, Tensor

LOG_2PI = math.log(2 * math.pi)


class Distribution(Protocol):
    """A distribution over actions for each of B observations."""

    def sample(self, generator: Generator) -> Tensor:
        """One action each, drawn with `generator`."""
        ...

    def mode(self) -> Tensor:
        """The most probable action each."""
        ...

    def log_prob(self, action: Tensor) -> Tensor:
        """Log π(a|s), [B]."""
        ...

    def entropy(self) -> Tensor:
        """H[π(·|s)] in nats, [B] or broadcastable to it."""
        ...


@dataclass(frozen=True)
class Gaussian:
    """Independent normals, N(mean, exp(log_std)²): mean [B, A], log_std [A]."""

    mean: Tensor
    log_std: Tensor

    def sample(self, generator: Generator) -> Tensor:
        """[B, A]."""
        noise = torch.randn(self.mean.shape, generator=generator, device=self.mean.device, dtype=self.mean.dtype)
        return self.mean + self.log_std.exp() * noise

    def mode(self) -> Tensor:
        """[B, A]."""
        return self.mean

    def log_prob(self, action: Tensor) -> Tensor:
        """[B]: log N(a; μ, σ) = −½ Σ_i [ ((a_i − μ_i) / σ_i)² + 2 log σ_i + log 2π ]."""
        z = (action - self.mean) * (-self.log_std).exp()
        return -0.5 * z.square().sum(-1) - (self.log_std.sum(-1) + 0.5 * LOG_2PI * action.shape[-1])

    def entropy(self) -> Tensor:
        """[]: Σ_i [ log σ_i + ½ log 2πe ], the same for every observation."""
        return (self.log_std + 0.5 * (1 + LOG_2PI)).sum(-1)


@dataclass(frozen=True)
class Categorical:
    """One of n actions, π(a|s) ∝ exp(logits): logits [B, n]."""

    logits: Tensor

    def sample(self, generator: Generator) -> Tensor:
        """[B] int64."""
        return torch.multinomial(self.logits.softmax(-1), 1, generator=generator).squeeze(-1)

    def mode(self) -> Tensor:
        """[B] int64."""
        return self.logits.argmax(-1)

    def log_prob(self, action: Tensor) -> Tensor:
        """[B]: logit_a − log Σ_b exp(logit_b)."""
        return self.logits.log_softmax(-1).gather(-1, action.unsqueeze(-1)).squeeze(-1)

    def entropy(self) -> Tensor:
        """[B]: −Σ_a π_a log π_a."""
        log_p = self.logits.log_softmax(-1)
        return -(log_p.exp() * log_p).sum(-1)
