"""The targets of Q for a transition, and the target networks."""

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


@torch.no_grad()
def polyak(target: Iterable[Tensor], online: Iterable[Tensor], tau: float) -> None:
    """Move a target network towards the online one, in place: arXiv:1509.02971, section 3.

        θ' ← (1 − τ) θ' + τ θ

    Applied once in every d updates, as a delayed algorithm does, it follows as τ' = 1 − (1 − τ)^(1/d) ≈ τ / d would
    at each.

    Args:
        target: θ', changed.
        online: θ, of the same shapes.
        tau: τ in [0, 1]; 1 copies. Whole numbers stay as they are.
    """
    for mine, theirs in zip(target, online, strict=True):
        if mine.is_floating_point():  # whole numbers do not learn
            mine.lerp_(theirs, tau)
