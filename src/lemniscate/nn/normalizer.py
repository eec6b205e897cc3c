"""Normalizers of observations and rewards: modules, so that they are saved and moved with the networks.

The observation normalizer is part of the policy, and evaluated with it; the reward scale is for training only.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Self

import torch
from torch import Tensor, nn

from lemniscate.maths import merge_moments, moments
from lemniscate.types import Rollout, wide_float


class NoNorm(nn.Module):
    """Observations as they are: the first `size` numbers, without an action mask that may follow them."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.size = size

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O or more] to […, O]."""
        return obs[..., : self.size]

    def update(self, obs: Tensor, valid: Tensor | None = None) -> None:
        """Nothing: there are no statistics."""


class ScaleBytes(NoNorm):
    """Bytes to numbers from -½ to ½."""

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O or more], uint8 or the same in float32, to […, O]."""
        return super().forward(obs).float() / 255 - 0.5


class NormByPart(NoNorm):
    """A normalizer of its own for each of several parts of the observation, which follow each other."""

    def __init__(self, parts: Iterable[NoNorm]) -> None:
        own = list(parts)
        super().__init__(sum(part.size for part in own))
        self.parts: Sequence[NoNorm] = nn.ModuleList(own)  # pyright: ignore[reportAttributeAccessIssue]

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O or more] to […, O]."""
        return torch.cat([part(piece) for part, piece in zip(self.parts, self._pieces(obs), strict=True)], dim=-1)

    def update(self, obs: Tensor, valid: Tensor | None = None) -> None:
        """Each its part of the observations."""
        for part, piece in zip(self.parts, self._pieces(obs), strict=True):
            part.update(piece, valid)

    def _pieces(self, obs: Tensor) -> Sequence[Tensor]:
        return super().forward(obs).split([part.size for part in self.parts], dim=-1)


def with_privileged(features: Tensor, obs: Tensor, size: int, privileged: int) -> Tensor:
    """Features […, F] and, behind them, the P = `privileged` numbers after the first O = `size` of […, O + P]."""
    return torch.cat([features, obs[..., size : size + privileged]], dim=-1) if privileged else features


class WideBuffers(nn.Module):
    """A module whose buffers are of `wide_float`, also after a move to another device."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        if wide_float(fn(torch.zeros(0)).device) != torch.float64:  # else `fn` could not move them there
            self._buffers.update({name: buffer.float() for name, buffer in self.named_buffers(recurse=False)})
        return super()._apply(fn, recurse)


class RunningNorm(WideBuffers, NoNorm):
    """(x − mean) / std, with the moments of all training observations, clipped to ±`clip`.

    The statistics are buffers and change in `update` only; calling the module never changes them. Before the first
    update it only clips.
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, size: int, clip: float = 10.0) -> None:
        super().__init__(size)
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O or more] to […, O]."""
        mean, std = self.mean.to(obs.dtype), (self.var + 1e-8).sqrt().to(obs.dtype)
        return ((super().forward(obs) - mean) / std).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, obs: Tensor, valid: Tensor | None = None) -> None:
        """Merge finite observations [..., N, O or more], those of `valid` [..., N], into the statistics."""
        wide = super().forward(obs).to(self.mean.dtype)
        rows = wide.flatten(0, -2) if valid is None else wide[valid]
        merged = merge_moments(self.mean, self.var, self.count, *moments(rows.T))
        for buffer, new in zip((self.mean, self.var, self.count), merged, strict=True):
            buffer.copy_(new)


class RewardScale(WideBuffers):
    """r / std of the discounted return so far, clipped to ±`clip`; the returns are those of N running episodes.

    The mean is not subtracted, which would reward surviving or dying. Before the first update rewards are unscaled.
    """

    running: Tensor
    var: Tensor

    def __init__(self, num_envs: int, gamma: float, clip: float = 10.0) -> None:
        super().__init__()
        self.gamma, self.clip = gamma, clip
        self.register_buffer("running", torch.zeros(num_envs, dtype=torch.float64))
        for name, value in (("mean", 0.0), ("var", 1.0), ("count", 0.0)):
            self.register_buffer(name, torch.tensor(value, dtype=torch.float64))

    def forward(self, reward: Tensor) -> Tensor:
        """Any shape to the same shape."""
        return (reward / (self.var + 1e-8).sqrt().to(reward.dtype)).clamp(-self.clip, self.clip)

    def on_restart(self) -> None:
        """Forget the running episodes: the environments have been restarted."""
        self.running = torch.zeros_like(self.running)

    @torch.no_grad()
    def update(self, reward: Tensor, done: Tensor, valid: Tensor) -> None:
        """Merge the returns Σ γ^k r_{t−k} of the `valid` rows [T, N] into the statistics."""
        returns = []
        for counted, ended in zip(reward.to(self.var.dtype) * valid, done, strict=True):
            self.running = self.gamma * self.running + counted
            returns.append(self.running)
            self.running = self.running * ~ended
        new = moments(torch.stack(returns)[valid])
        self.mean, self.var, self.count = merge_moments(self.mean, self.var, self.count, *new)

    def scale(self, rollout: Rollout) -> Rollout:
        """The rollout [T, N] with scaled rewards, after its returns have joined the statistics.

        Mirror images behind the N have the same rewards.
        """
        count = len(self.running)
        self.update(rollout.reward[:, :count], rollout.done[:, :count], rollout.valid[:, :count])
        return replace(rollout, reward=self(rollout.reward))
