"""Actions on their way into a simulator that is differentiated."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


def clip_inward(action: Float[Tensor, "N A"], max_ratio: float) -> Float[Tensor, "N A"]:
    """Actions clipped to [-1, 1], whose gradient g [N, A], of a loss to descend, is made fit for a chain of steps.

        g ← 0 where the action is out of range and −g leads further out; a gradient that leads back is kept
        gᵢ ← gᵢ min(1, k · median ‖gⱼ‖ / ‖gᵢ‖) for each environment i, the median over those j with a gradient

    Hausknecht & Stone 2016, arXiv:1511.04143, call the first zeroing gradients; the limit is our choice.

    Args:
        action: of N environments.
        max_ratio: k; infinite for no limit.
    """
    return _ClipInward.apply(action, max_ratio)


class _ClipInward(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, action: Tensor, max_ratio: float) -> Tensor:
        ctx.save_for_backward(action)
        ctx.max_ratio = max_ratio
        return action.clamp(-1, 1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (action,), (gradient,) = ctx.saved_tensors, gradients
        outward = ((action > 1) & (gradient < 0)) | ((action < -1) & (gradient > 0))
        gradient = gradient.masked_fill(outward, 0)
        norm = gradient.norm(dim=-1, keepdim=True)
        usual = norm.masked_fill(norm == 0, torch.nan).nanmedian()
        scale = ctx.max_ratio * usual / norm
        return gradient * torch.fmin(scale, torch.ones_like(scale)), None  # fmin: 1 where no environment has a gradient
