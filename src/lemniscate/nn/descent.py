"""One step down a gradient."""

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.nn.utils import clip_grad_norm_


def descend(
    optimizer: torch.optim.Optimizer, parameters: Iterable[Parameter], loss: Tensor, max_grad_norm: float
) -> Tensor:
    """Back-propagate, clip the global gradient norm to `max_grad_norm`, step; returns the norm before the clip."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    norm = clip_grad_norm_(parameters, max_grad_norm, foreach=True)
    optimizer.step()
    return norm
