"""Values of actions, Q(s, a), behind the policy's observation normalizer; and the price of entropy."""

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

from lemniscate.maths import value_loss
from lemniscate.nn.normalizer import NoNorm, with_privileged


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
