"""Distributions over discrete actions. The noise to sample with is drawn outside and passed in."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, logsigmoid, one_hot


@dataclass(frozen=True)
class Categorical:
    """One of n actions, π(a|s) ∝ exp(logits): logits [B, n]."""

    logits: Tensor

    @property
    def probabilities(self) -> Tensor:
        """π(·|s), [B, n]."""
        return self.logits.softmax(-1)

    def sample(self, noise: Tensor) -> Tensor:
        """[B] int64, from noise [B] uniform in [0, 1): the first action at which Σ π exceeds it."""
        return _first_beyond(self.probabilities, noise)

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
        return torch.stack([part.sample(column) for part, column in self._parts_with(noise)], dim=-1)

    def mode(self) -> Tensor:
        """[B, K] int64."""
        return torch.stack([part.mode() for part in self.parts], dim=-1)

    def log_prob(self, action: Tensor) -> Tensor:
        """[B]: Σ_k log π_k(a_k)."""
        return torch.stack([part.log_prob(column) for part, column in self._parts_with(action)]).sum(0)

    def entropy(self) -> Tensor:
        """[B]: Σ_k H[π_k]."""
        return torch.stack([part.entropy() for part in self.parts]).sum(0)

    def kl(self, other: "MultiCategorical") -> Tensor:
        """[B]: Σ_k KL(π_k ‖ π'_k)."""
        return torch.stack([mine.kl(its) for mine, its in zip(self.parts, other.parts, strict=True)]).sum(0)

    def _parts_with(self, columns: Tensor) -> list[tuple[Categorical, Tensor]]:
        return list(zip(self.parts, columns.unbind(-1), strict=True))


@dataclass(frozen=True)
class Bernoulli:
    """n independent binary components, 1 with probability σ(logit): logits [B, n]."""

    logits: Tensor

    @property
    def probabilities(self) -> Tensor:
        """Those of 1, [B, n]."""
        return self.logits.sigmoid()

    def sample(self, noise: Tensor) -> Tensor:
        """[B, n] of 0 and 1, int64, from noise [B, n] uniform in [0, 1)."""
        return (noise < self.probabilities).long()

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
class EpsilonGreedy:
    """The action of the largest Q with probability 1 − ε, else any permitted one: Sutton & Barto 2018, section 2.2.

        π(a|s) = (1 − ε) 1[a = argmax Q(s, ·)] + ε / |A(s)|

    `values` are Q(s, ·), [B, n], at most −5·10⁸ where an action is not permitted; `epsilon` is a scalar.
    """

    values: Tensor
    epsilon: Tensor

    @property
    def probabilities(self) -> Tensor:
        """π(·|s), [B, n]."""
        permitted = (self.values > -5e8).to(self.values.dtype)
        best = one_hot(self.mode(), self.values.shape[-1]).to(self.values.dtype)
        return torch.lerp(best, permitted / permitted.sum(-1, keepdim=True), self.epsilon)

    def sample(self, noise: Tensor) -> Tensor:
        """[B] int64, from noise [B] uniform in [0, 1): the first action at which Σ π exceeds it."""
        return _first_beyond(self.probabilities, noise)

    def mode(self) -> Tensor:
        """[B] int64."""
        return self.values.argmax(-1)


def _first_beyond(probabilities: Tensor, noise: Tensor) -> Tensor:
    cumulative = probabilities.cumsum(-1)
    return (cumulative <= noise.unsqueeze(-1) * cumulative[..., -1:]).sum(-1)


for kind in (Categorical, MultiCategorical, Bernoulli):
    torch.export.register_dataclass(kind)  # so that derivatives can be taken in what a distribution is made of
