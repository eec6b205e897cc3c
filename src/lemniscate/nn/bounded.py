"""Networks of the algorithms that learn from a replay buffer: policies of bounded continuous actions, and Q(s, a)."""

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Generator, Tensor, nn

from lemniscate.maths import Deterministic, SquashedGaussian, value_loss
from lemniscate.nn.normalizer import NoNorm, with_privileged
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


class QValue(nn.Module):
    """Q(s, a), behind the policy's observation normalizer; it sees the P = `privileged` numbers too, as they are."""

    def __init__(self, normalizer: NoNorm, encoder: nn.Module, net: nn.Module, privileged: int = 0) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.encoder = encoder
        self.net = net
        self.privileged = privileged

    def features(self, obs: Tensor) -> Tensor:
        """[…, O + P] to […, F + P]."""
        return with_privileged(self.encoder(self.normalizer(obs)), obs, self.normalizer.size, self.privileged)

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O + P] and […, A] to […]."""
        return self.net(torch.cat([self.features(obs), action], dim=-1)).squeeze(-1)

    def loss(self, obs: Tensor, action: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """½ (Q(s, a) − y)², the mean over M rows, y = `target` [M]; and Q(s, a) [M]."""
        q = self(obs, action)
        return value_loss(q, target), q


class Critics(nn.Module):
    """C independent Q-values: one in DDPG; two in TD3 and SAC (Fujimoto et al. 2018, arXiv:1802.09477, section 4.2)."""

    def __init__(self, members: Iterable[QValue]) -> None:
        super().__init__()
        self.members: Sequence[QValue] = nn.ModuleList(members)  # pyright: ignore[reportAttributeAccessIssue]

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O] and […, A] to [C, …]."""
        return torch.stack([q(obs, action) for q in self.members])

    def first(self, obs: Tensor, action: Tensor) -> Tensor:
        """Q₁(s, a) alone: […, O] and […, A] to […]."""
        return self.members[0](obs, action)


class Temperature(nn.Module):
    """α > 0, the weight of the entropy in SAC; log α is the parameter."""

    def __init__(self, initial: float) -> None:
        super().__init__()
        self.log_alpha = nn.Parameter(torch.tensor(math.log(initial)))

    def forward(self) -> Tensor:
        """α, a scalar."""
        return self.log_alpha.exp()
