"""What states and actions are worth. Critics look through the policy's normalizer, and do not own it."""

import torch
from torch import Tensor, nn

from lemniscate.nn.normalizer import NoNorm


class Value(nn.Module):
    """V(s). It looks through the policy's normalizer, and does not own it."""

    def __init__(self, normalizer: NoNorm, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O] to […]."""
        return self.net(self.normalizer(obs)).squeeze(-1)


class QValue(nn.Module):
    """Q(s, a). It looks through the policy's normalizer, and does not own it."""

    def __init__(self, normalizer: NoNorm, encoder: nn.Module, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.encoder = encoder
        self.net = net

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O] and […, A] to […]."""
        seen = self.encoder(self.normalizer(obs))
        return self.net(torch.cat([seen, action], dim=-1)).squeeze(-1)


class TwinQ(nn.Module):
    """Two Q-values that never see each other: Fujimoto et al. 2018, arXiv:1802.09477, section 4.2."""

    def __init__(self, one: QValue, two: QValue) -> None:
        super().__init__()
        self.one, self.two = one, two

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O] and […, A] to [2, …]."""
        return torch.stack([self.one(obs, action), self.two(obs, action)])
