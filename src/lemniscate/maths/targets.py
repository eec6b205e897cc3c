"""What Q should say of a transition, and the networks that say it."""

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def td_target(
    reward: Float[Tensor, " B"],
    next_value: Float[Tensor, "*C B"],
    terminated: Bool[Tensor, " B"],
    *,
    gamma: float = 0.99,
) -> Float[Tensor, "*C B"]:
    """The one-step target of a critic: Lillicrap et al. 2016, arXiv:1509.02971, algorithm 1.

        y = r + γ Q(s', a')     r alone after a termination; a time-out bootstraps

    Args:
        reward: r.
        next_value: Q(s', a') at the true successor, from the target networks.
        terminated: the episode ended by its own rules.
        gamma: discount γ in [0, 1].
    """
    return reward + gamma * next_value * ~terminated


def hl_gauss(target: Float[Tensor, " B"], edges: Float[Tensor, " E"], width: float = 0.75) -> Float[Tensor, "B K"]:
    """A number as probabilities of K bins: Farebrother et al. 2024, arXiv:2403.03950, "HL-Gauss".

        p_i = (Φ((e_{i+1} − y) / σ) − Φ((e_i − y) / σ)) / (Φ((e_K − y) / σ) − Φ((e_0 − y) / σ))

    Args:
        target: y, which is clamped to [e_0, e_K].
        edges: e_0 < … < e_K, at equal distances; E = K + 1.
        width: σ in units of a bin's width.
    """
    sigma = width * (edges[1] - edges[0])
    below = torch.erf((edges - target.clamp(edges[0], edges[-1])[:, None]) / (sigma * 2**0.5))
    return below.diff() / (below[:, -1:] - below[:, :1])


@torch.no_grad()
def polyak(target: Iterable[Tensor], online: Iterable[Tensor], tau: float) -> None:
    """Move a target network towards the online one, in place: arXiv:1509.02971, section 3.

        θ' ← (1 − τ) θ' + τ θ

    Applied once in every d updates, as a delayed algorithm does, it follows as τ' = 1 − (1 − τ)^(1/d) ≈ τ / d would
    at each.

    Args:
        target: θ', changed.
        online: θ, of the same shapes.
        tau: τ in [0, 1]; 1 copies.
    """
    for mine, theirs in zip(target, online, strict=True):
        mine.lerp_(theirs, tau)
