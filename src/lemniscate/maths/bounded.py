"""Distributions over bounded continuous actions. The noise to sample with is drawn outside and passed in."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from lemniscate.maths.distributions import LOG_2PI, Gaussian


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


def mean_and_std(distribution: Deterministic | Gaussian | SquashedGaussian) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the actions of a distribution, [B, A] each, by quadrature over its normal noise.

    The trapezoidal rule on 129 points within 6 σ: the error is below 1e-5, whatever σ a policy here can have.
    """
    z = torch.linspace(-6, 6, 129).view(-1, 1, 1)
    weights = (-0.5 * z.square()).softmax(0)
    actions = distribution.sample(0 * z if isinstance(distribution, Deterministic) else z)  # [129, B, A]
    mean = (weights * actions).sum(0)
    return mean, (weights * (actions - mean).square()).sum(0).sqrt()


def _log_slope(u: Tensor) -> Tensor:
    """Log of the derivative of tanh."""
    return 2 * (math.log(2) - u - softplus(-2 * u))
