"""Losses: scalars to descend; targets over bins. They raise `ValueError` for tensors whose shapes differ."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lemniscate.maths.stats import require_alike


def policy_gradient(log_prob: Float[Tensor, " *B"], weight: Float[Tensor, " *B"]) -> Float[Tensor, ""]:
    """A scalar whose gradient is the policy gradient, negated: Williams 1992, theorem 1; arXiv:1602.01783, section 4.

        −E[ log π(a|s) Ψ ]      ∇J = E[ ∇log π(a|s) Ψ ]

    Its value means nothing; only its gradient does, and that only where the actions are of π itself.

    Args:
        log_prob: log π(a|s).
        weight: Ψ, no gradient: a return, a reward-to-go, an advantage (arXiv:1506.02438, eq. 1).
    """
    require_alike(log_prob=log_prob, weight=weight)
    return -(log_prob * weight).mean()


def surrogate(log_ratio: Float[Tensor, " *B"], advantage: Float[Tensor, " *B"]) -> Float[Tensor, ""]:
    """TRPO's surrogate, negated: Schulman et al. 2015, arXiv:1502.05477, eq. 14 with advantages for Q.

        L = E[ r A ],   r = exp(log_ratio) = π(a|s) / π_old(a|s)

    At r = 1 its gradient is the policy gradient.

    Args:
        log_ratio: log π(a|s) − log π_old(a|s).
        advantage: A, no gradient.
    """
    require_alike(log_ratio=log_ratio, advantage=advantage)
    return -(log_ratio.exp() * advantage).mean()


def clipped_surrogate(
    log_ratio: Float[Tensor, " *B"], advantage: Float[Tensor, " *B"], clip: Any = 0.2
) -> Float[Tensor, ""]:
    """PPO's clipped surrogate, negated: Schulman et al. 2017, arXiv:1707.06347, eq. 7.

        L^CLIP = E[ min( r A, clip(r, 1−ε, 1+ε) A ) ],   r = exp(log_ratio) = π(a|s) / π_old(a|s)

    Where A ≥ 0 the objective stops growing at r = 1+ε; where A < 0 it stops at r = 1−ε. The minimum keeps the
    gradient wherever the ratio has moved to the wrong side, however far.

    Args:
        log_ratio: log π(a|s) − log π_old(a|s).
        advantage: A, no gradient.
        clip: ε > 0, a number or a scalar tensor.
    """
    require_alike(log_ratio=log_ratio, advantage=advantage)
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()


def value_loss(
    value: Float[Tensor, " *B"],
    target: Float[Tensor, " *B"],
    old_value: Float[Tensor, " *B"] | None = None,
    clip: Any = None,
) -> Float[Tensor, ""]:
    """The critic's loss, L^VF of arXiv:1707.06347, eq. 9, with the conventional half: ½ E[(V − target)²].

    With `clip`, the value may move only ε from what it was when the data was collected, and the larger of the two
    errors counts, element by element (PPO's reference code, not its paper):

        ½ E[ max( (V − target)², (V_old + clip(V − V_old, −ε, ε) − target)² ) ]

    Args:
        value: V(s) now.
        target: what it should be, no gradient.
        old_value: V(s) at collection; needed with `clip`.
        clip: ε > 0, a number or a scalar tensor; None for the plain loss.

    Raises:
        ValueError: `clip` without `old_value`.
    """
    require_alike(value=value, target=target, old_value=value if old_value is None else old_value)
    error = (value - target).square()
    if clip is not None:
        if old_value is None:
            raise ValueError("value_loss with clip needs old_value, the values at collection.")
        clipped = old_value + (value - old_value).clamp(-clip, clip)
        error = torch.max(error, (clipped - target).square())
    return 0.5 * error.mean()


def hl_gauss(target: Float[Tensor, " *B"], edges: Float[Tensor, " E"], width: float = 0.75) -> Float[Tensor, "*B K"]:
    """A number as probabilities of K bins: Farebrother et al. 2024, arXiv:2403.03950, "HL-Gauss".

        p_i = (Φ((e_{i+1} − y) / σ) − Φ((e_i − y) / σ)) / (Φ((e_K − y) / σ) − Φ((e_0 − y) / σ))

    Args:
        target: y, which is clamped to [e_0, e_K].
        edges: e_0 < … < e_K, at equal distances; E = K + 1.
        width: σ in units of a bin's width.
    """
    sigma = width * (edges[1] - edges[0])
    below = torch.erf((edges - target.clamp(edges[0], edges[-1])[..., None]) / (sigma * 2**0.5))
    return below.diff() / (below[..., -1:] - below[..., :1])


def cross_entropy(logits: Float[Tensor, "*B K"], target: Float[Tensor, "*B K"]) -> Float[Tensor, ""]:
    """−E[ Σ_i p_i log q_i ]: the loss of a distribution over K bins, arXiv:2403.03950, section 2.

    Args:
        logits: of q.
        target: p, no gradient.
    """
    require_alike(logits=logits, target=target)
    return -(target * logits.log_softmax(-1)).sum(-1).mean()
