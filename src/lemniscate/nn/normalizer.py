"""The running observation normalizer: a module of the policy, so it is saved, moved and evaluated with it."""

import torch
from torch import Tensor, nn

from lemniscate.maths import merge_moments


class RunningNorm(nn.Module):
    """(x − mean) / std of everything seen in training, clipped to ±`clip`.

    The statistics are buffers and change in `update` only; calling the module never changes them. Before the first
    update it passes observations through.
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, size: int, clip: float = 10.0) -> None:
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O] to […, O]."""
        mean, std = self.mean.to(obs.dtype), (self.var + 1e-8).sqrt().to(obs.dtype)
        return ((obs - mean) / std).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, obs: Tensor) -> None:
        """Take [B, O] more observations into the statistics; all of them finite."""
        obs = obs.double()
        count = torch.full_like(self.count, len(obs))
        moments = merge_moments(self.mean, self.var, self.count, obs.mean(0), obs.var(0, correction=0), count)
        for buffer, new in zip((self.mean, self.var, self.count), moments, strict=True):
            buffer.copy_(new)
