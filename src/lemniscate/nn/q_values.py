"""Values of actions, Q(s, a), behind the policy's observation normalizer; and the price of entropy."""

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

from lemniscate.nn.normalizer import NoNorm


class QValue(nn.Module):
    """Q(s, a), behind the policy's observation normalizer."""

    def __init__(self, normalizer: NoNorm, encoder: nn.Module, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.encoder = encoder
        self.net = net

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O] and […, A] to […]."""
        features = self.encoder(self.normalizer(obs))
        return self.net(torch.cat([features, action], dim=-1)).squeeze(-1)


class Critics(nn.Module):
    """C independent Q-values: one in DDPG; two in TD3 and SAC (Fujimoto et al. 2018, arXiv:1802.09477, section 4.2)."""

    def __init__(self, members: Iterable[QValue]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

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


class CategoricalQ(nn.Module):
    """Q(s, a) as the mean of a distribution over K bins of equal width, behind the policy's observation normalizer.

    Args:
        normalizer: of observations.
        encoder: from normalized observations to features.
        net: from features and action to K logits.
        bins: K.
        value_range: the bins cover [-value_range, value_range].
        action_gain: the factor of actions before `net`.
    """

    edges: Tensor

    def __init__(
        self, normalizer: NoNorm, encoder: nn.Module, net: nn.Module, bins: int, value_range: float, action_gain: float
    ) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.encoder = encoder
        self.net = net
        self.action_gain = action_gain
        self.register_buffer("edges", torch.linspace(-value_range, value_range, bins + 1), persistent=False)

    def logits(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O] and […, A] to […, K]."""
        features = self.encoder(self.normalizer(obs))
        return self.net(torch.cat([features, self.action_gain * action], dim=-1))

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O] and […, A] to […]."""
        centres = (self.edges[1:] + self.edges[:-1]) / 2
        return self.logits(obs, action).softmax(-1) @ centres


class Multipliers(nn.Module):
    """Lagrange multipliers, each above zero; their logs are the parameter."""

    def __init__(self, initial: Sequence[float]) -> None:
        super().__init__()
        self.log = nn.Parameter(torch.tensor([math.log(value) for value in initial]))

    def forward(self) -> Tensor:
        """[number of multipliers]."""
        return self.log.exp()
