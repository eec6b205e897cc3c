"""Policies of bounded continuous actions, for the algorithms that learn from a replay buffer."""

import math
from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn

from lemniscate.maths import Deterministic, SquashedGaussian
from lemniscate.nn.normalizer import NoNorm
from lemniscate.nn.policies import Policy


class DeterministicPolicy(Policy):
    """One action at each observation, tanh of a network: in [-1, 1]^A, which the env floor maps onto its bounds."""

    def __init__(self, normalizer: NoNorm, net: nn.Module, size: int) -> None:
        super().__init__(normalizer, net)
        self.size = size

    def forward(self, obs: Tensor) -> Deterministic:
        """[B, O] to [B, A]."""
        return Deterministic(torch.tanh(self.net(self.normalizer(obs))))

    def draw_noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Zeros, [*shape, A]: the policy has no randomness of its own."""
        return torch.zeros(*shape, self.size, device=generator.device)


class SquashedGaussianPolicy(Policy):
    """tanh(u), u ~ N(μ(s), σ(s)²); log σ is kept in [-5, 2], softly, as tanh moves from one end to the other.

    Args:
        normalizer: of observations.
        net: from normalized observations to μ and what log σ is made of, [B, 2 A].
        size: A.
        initial_log_std: log σ, inside (-5, 2), where the network says 0, as it does at first.
    """

    def __init__(self, normalizer: NoNorm, net: nn.Module, size: int, initial_log_std: float = -1.5) -> None:
        super().__init__(normalizer, net)
        self.size = size
        self._offset = math.atanh((initial_log_std + 5) / 3.5 - 1)

    def forward(self, obs: Tensor) -> SquashedGaussian:
        """[B, O] to μ and log σ, [B, A] each."""
        mean, log_std = self.net(self.normalizer(obs)).chunk(2, dim=-1)
        return SquashedGaussian(mean, -5 + 3.5 * (torch.tanh(log_std + self._offset) + 1))

    def draw_noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Standard normal, [*shape, A]."""
        return torch.randn(*shape, self.size, generator=generator, device=generator.device)
