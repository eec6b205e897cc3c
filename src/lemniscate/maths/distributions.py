"""What a policy returns: distributions over actions. The noise to sample with is drawn outside and passed in."""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, logsigmoid, softplus

LOG_2PI = math.log(2 * math.pi)


class Distribution(Protocol):
    """A distribution over actions for each of B observations."""

    def sample(self, noise: Tensor) -> Tensor:
        """One action each, a function of `noise`."""
        ...

    def mode(self) -> Tensor:
        """The most probable action each."""
        ...


@dataclass(frozen=True)
class Gaussian:
    """Independent normals, N(mean, exp(log_std)²): mean [B, A], log_std [A]."""

    mean: Tensor
    log_std: Tensor

    def sample(self, noise: Tensor) -> Tensor:
        """[B, A], from standard normal noise [B, A]."""
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

    def kl(self, other: "Gaussian") -> Tensor:
        """[B]: KL(self ‖ other) = Σ_i [ log σ'_i − log σ_i + (σ_i² + (μ_i − μ'_i)²) / 2σ'_i² − ½ ]."""
        widened = other.log_std - self.log_std
        apart = (self.mean - other.mean) * (-other.log_std).exp()
        return (widened + 0.5 * ((-2 * widened).exp() + apart.square() - 1)).sum(-1)


@dataclass(frozen=True)
class Categorical:
    """One of n actions, π(a|s) ∝ exp(logits): logits [B, n]."""

    logits: Tensor

    def sample(self, noise: Tensor) -> Tensor:
        """[B] int64, from noise [B] uniform in [0, 1): the first action at which Σ π exceeds it."""
        cumulative = self.logits.softmax(-1).cumsum(-1)
        return (cumulative <= noise.unsqueeze(-1) * cumulative[..., -1:]).sum(-1)

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

    def kl(self, other: "Categorical") -> Tensor:
        """[B]: KL(self ‖ other) = Σ_a π_a (log π_a − log π'_a)."""
        log_p = self.logits.log_softmax(-1)
        return (log_p.exp() * (log_p - other.logits.log_softmax(-1))).sum(-1)


@dataclass(frozen=True)
class MultiCategorical:
    """K independent choices: `parts`, K categoricals."""

    parts: tuple[Categorical, ...]

    def sample(self, noise: Tensor) -> Tensor:
        """[B, K] int64, from noise [B, K] uniform in [0, 1)."""
        return torch.stack([part.sample(column) for part, column in self._with(noise)], dim=-1)

    def mode(self) -> Tensor:
        """[B, K] int64."""
        return torch.stack([part.mode() for part in self.parts], dim=-1)

    def log_prob(self, action: Tensor) -> Tensor:
        """[B]: Σ_k log π_k(a_k)."""
        return torch.stack([part.log_prob(column) for part, column in self._with(action)]).sum(0)

    def entropy(self) -> Tensor:
        """[B]: Σ_k H[π_k]."""
        return torch.stack([part.entropy() for part in self.parts]).sum(0)

    def kl(self, other: "MultiCategorical") -> Tensor:
        """[B]: Σ_k KL(π_k ‖ π'_k)."""
        return torch.stack([mine.kl(its) for mine, its in zip(self.parts, other.parts, strict=True)]).sum(0)

    def _with(self, columns: Tensor) -> list[tuple[Categorical, Tensor]]:
        return list(zip(self.parts, columns.unbind(-1), strict=True))


@dataclass(frozen=True)
class Bernoulli:
    """n independent switches, on with probability σ(logit): logits [B, n]."""

    logits: Tensor

    def sample(self, noise: Tensor) -> Tensor:
        """[B, n] of 0 and 1, int64, from noise [B, n] uniform in [0, 1)."""
        return (noise < self.logits.sigmoid()).long()

    def mode(self) -> Tensor:
        """[B, n] of 0 and 1, int64."""
        return (self.logits > 0).long()

    def log_prob(self, action: Tensor) -> Tensor:
        """[B]: Σ_i [ a_i log σ_i + (1 − a_i) log (1 − σ_i) ]."""
        return -binary_cross_entropy_with_logits(self.logits, action.to(self.logits.dtype), reduction="none").sum(-1)

    def entropy(self) -> Tensor:
        """[B]: −Σ_i [ σ_i log σ_i + (1 − σ_i) log (1 − σ_i) ]."""
        on, off = logsigmoid(self.logits), logsigmoid(-self.logits)
        return -(on.exp() * on + off.exp() * off).sum(-1)

    def kl(self, other: "Bernoulli") -> Tensor:
        """[B]: Σ_i [ σ_i (log σ_i − log σ'_i) + (1 − σ_i) (log (1 − σ_i) − log (1 − σ'_i)) ]."""
        on, off = logsigmoid(self.logits), logsigmoid(-self.logits)
        its_on, its_off = logsigmoid(other.logits), logsigmoid(-other.logits)
        return (on.exp() * (on - its_on) + off.exp() * (off - its_off)).sum(-1)


@dataclass(frozen=True)
class Deterministic:
    """All probability on one action in [-1, 1]^A, `action` [B, A]; what noise there is comes from outside."""

    action: Tensor

    def sample(self, noise: Tensor) -> Tensor:
        """[B, A] in [-1, 1]: action + noise, noise [B, A] of any kind."""
        return (self.action + noise).clamp(-1, 1)

    def mode(self) -> Tensor:
        """[B, A]."""
        return self.action


@dataclass(frozen=True)
class SquashedGaussian:
    """tanh(u) with u ~ N(mean, exp(log_std)²): mean and log_std [B, A]. Haarnoja et al. 2018, arXiv:1801.01290."""

    mean: Tensor
    log_std: Tensor

    def sample(self, noise: Tensor) -> Tensor:
        """[B, A] in [-1, 1], from standard normal noise [B, A]."""
        return torch.tanh(self.mean + self.log_std.exp() * noise)

    def mode(self) -> Tensor:
        """[B, A]: tanh(mean), the median of each coordinate."""
        return torch.tanh(self.mean)

    def sample_with_log_prob(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        """([B, A], [B]): an action and its log π, appendix C, eq. 21.

            log π(a) = Σ_i [ log N(u_i; μ_i, σ_i) − log(1 − tanh² u_i) ]
            log(1 − tanh² u) = 2 (log 2 − u − softplus(−2u))

        From u itself, so that it is exact where tanh has long been 1.
        """
        u = self.mean + self.log_std.exp() * noise
        normal = -0.5 * (noise.square() + LOG_2PI) - self.log_std
        return torch.tanh(u), (normal - _log_slope(u)).sum(-1)


def _log_slope(u: Tensor) -> Tensor:
    """Log of the derivative of tanh."""
    return 2 * (math.log(2) - u - softplus(-2 * u))


for kind in (Gaussian, Categorical, MultiCategorical, Bernoulli):
    torch.export.register_dataclass(kind)  # so that derivatives can be taken in what a distribution is made of
