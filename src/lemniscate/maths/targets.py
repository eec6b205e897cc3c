"""The targets of Q, for a transition and for a rollout, as numbers and over bins; and the target networks."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lemniscate.maths.returns import q_lambda
from lemniscate.maths.stats import require_alike


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
    require_alike(reward=reward, terminated=terminated)
    if getattr(reward, "ndim", 0) and next_value.shape[-1:] != reward.shape[-1:]:
        require_alike(reward=reward, next_value=next_value)
    return reward + gamma * next_value * ~terminated.bool()


@torch.no_grad()
def polyak(target: Sequence[Tensor], online: Sequence[Tensor], tau: float) -> None:
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


def soft_lambda_return(
    reward: Float[Tensor, "T N"],
    next_value: Float[Tensor, "T N"],
    next_bonus: Float[Tensor, "T N"],
    terminated: Bool[Tensor, "T N"],
    done: Bool[Tensor, "T N"],
    *,
    gamma: float = 0.99,
    lam: float = 0.95,
) -> Float[Tensor, "T N"]:
    """The TD(λ) return of Q(s, a) where entropy is rewarded: Voelcker et al. 2025, arXiv:2507.11019.

        G_t = r_t + γ (b_{t+1} + (1 − λ) Q(s_{t+1}, a') + λ G_{t+1})
        a' ~ π(·|s_{t+1}),   b_{t+1} = −α log π(a'|s_{t+1})

    r_t alone after a termination. Where the chain ends, at a time-out and in the last row, Q(s_{t+1}, a') stands for
    G_{t+1}. At λ = 0 it is SAC's target, arXiv:1812.05905, eq. 3.

    Args:
        reward: r_t.
        next_value: Q(s_{t+1}, a') at the true successor, before any reset.
        next_bonus: b_{t+1}, of the same action.
        terminated: the episode ended by its own rules at row t.
        done: the episode ended at row t for any reason.
        gamma: discount γ in [0, 1].
        lam: trace decay λ in [0, 1].
    """
    require_alike(reward=reward, next_bonus=next_bonus, terminated=terminated)
    terminated, done = terminated.bool(), done.bool()
    reward = reward + gamma * next_bonus * ~terminated
    return q_lambda(reward, next_value, terminated, done, gamma=gamma, lam=lam)


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
