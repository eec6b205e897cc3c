"""The rows that REPPO learns from."""

from dataclasses import dataclass

from torch import Tensor

from lemniscate.maths import Gaussian, SquashedGaussian
from lemniscate.types import Record


@dataclass(frozen=True)
class SoftBatch(Record):
    """The rows of a rollout with Q(s, a), its target, and the policy's μ and log σ at collection, [B, …]."""

    obs: Tensor
    action: Tensor
    value: Tensor
    target: Tensor
    mean: Tensor
    log_std: Tensor

    def kl_to(self, policy: SquashedGaussian) -> Tensor:
        """KL(π_old ‖ π) of each row, [B]: that of the normals before the tanh, which maps both in the same way."""
        return Gaussian(self.mean, self.log_std).kl(Gaussian(policy.mean, policy.log_std))
