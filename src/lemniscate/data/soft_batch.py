"""The rows that REPPO learns from."""

from dataclasses import dataclass

from torch import Tensor

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
