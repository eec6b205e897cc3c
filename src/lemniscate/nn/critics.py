"""The value V(s), which shares the policy's observation normalizer."""

from torch import Tensor, nn

from lemniscate.nn.normalizer import NoNorm


class Value(nn.Module):
    """V(s), behind the policy's observation normalizer."""

    def __init__(self, normalizer: NoNorm, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O] to […]."""
        return self.net(self.normalizer(obs)).squeeze(-1)
