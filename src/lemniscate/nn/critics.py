"""Q(s, a), as a number or as a distribution over bins, and the temperature of the entropy that it counts."""

import math
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

from lemniscate.maths import cross_entropy, hl_gauss, value_loss
from lemniscate.nn.normalizer import NoNorm, RewardScale, WideBuffers, with_privileged


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


BINS = 101
"""K, the number of bins of a Q that is a distribution"""


class Bins(WideBuffers):
    """K = `BINS` bins of equal width on [-c x, c x], x = `value_range` and c a scale of the values.

    Args:
        value_range: x.
        scaled: c is the standard deviation of a return that `observe` follows, saved with the networks; else it is 1.
    """

    unit: Tensor
    """edges at c = 1, [K + 1]"""
    moments: Tensor
    """mean, variance and number of the returns so far, [3]"""

    def __init__(self, value_range: float, *, scaled: bool = False) -> None:
        super().__init__()
        self.register_buffer("unit", torch.linspace(-value_range, value_range, BINS + 1), persistent=False)
        self.register_buffer("moments", torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), persistent=scaled)

    @property
    def edges(self) -> Tensor:
        """The ends of the bins, [K + 1]."""
        return self.unit * self.moments[1].clamp(min=1e-8).sqrt().to(self.unit.dtype)

    def observe(self, scale: RewardScale) -> None:
        """Follow the returns of which `scale` has the statistics: what a distribution says moves with them."""
        self.moments.copy_(torch.stack([scale.mean, scale.var, scale.count]))

    def mean(self, logits: Tensor) -> Tensor:
        """The mean of the distributions with these logits: […, K] to […]."""
        edges = self.edges
        return logits.softmax(-1) @ ((edges[1:] + edges[:-1]) / 2)


class CategoricalQ(QValue):
    """Q(s, a) as the mean of a distribution over the K `bins`, which several Q may share.

    `net` takes features, and actions times `action_gain`, to K logits.
    """

    def __init__(
        self,
        normalizer: NoNorm,
        encoder: nn.Module,
        net: nn.Module,
        bins: Bins,
        action_gain: float = 1.0,
        privileged: int = 0,
    ) -> None:
        super().__init__(normalizer, encoder, net, privileged)
        self.bins = bins
        self.action_gain = action_gain

    def logits(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O + P] and […, A] to […, K]."""
        return self.net(torch.cat([self.features(obs), self.action_gain * action], dim=-1))

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O + P] and […, A] to […]."""
        return self.bins.mean(self.logits(obs, action))

    def loss(self, obs: Tensor, action: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """The cross-entropy with the probabilities of y = `target` [M] over the bins, a scalar; and Q(s, a) [M]."""
        logits = self.logits(obs, action)
        return cross_entropy(logits, hl_gauss(target, self.bins.edges)), self.bins.mean(logits)


@torch.no_grad()
def normalize_units(networks: nn.Module) -> None:
    """Divide the weights of each unit of the linear layers by their length, in place.

    A constraint on networks with normalized layers: weights that cannot grow are turned as far by each step of Adam.
    """
    for layer in networks.modules():
        if isinstance(layer, nn.Linear) and layer.weight.requires_grad:
            layer.weight.div_(torch.linalg.vector_norm(layer.weight, dim=1, keepdim=True) + 1e-8)
