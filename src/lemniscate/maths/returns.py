"""Advantages, returns and the targets of V and Q; the target networks. `ValueError` for tensors whose shapes differ."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lemniscate.maths.stats import require_alike


def gae(
    reward: Float[Tensor, "T N"],
    value: Float[Tensor, "T N"],
    next_value: Float[Tensor, "T N"],
    terminated: Bool[Tensor, "T N"],
    done: Bool[Tensor, "T N"],
    *,
    gamma: float = 0.99,
    lam: float = 0.95,
) -> tuple[Float[Tensor, "T N"], Float[Tensor, "T N"]]:
    """Generalized advantage estimation: Schulman et al. 2016, arXiv:1506.02438, eq. 16 cut where episodes end.

        δ_t = r_t + γ V(s_{t+1}) − V(s_t)               V = 0 after a termination; arXiv:1707.06347, eq. 12
        A_t = δ_t + γλ A_{t+1} = Σ_l (γλ)^l δ_{t+l}     up to the end of the episode; eq. 16

    Two flags, because there are two ends. A *termination* ends the value: nothing follows it. Any end (`done`:
    terminated or truncated) ends the chain: the next row belongs to another episode. A time-out therefore bootstraps
    from `next_value`, the value of the true final observation.

    Args:
        reward: r_t.
        value: V(s_t).
        next_value: V(s_{t+1}) of the true successor, before any reset.
        terminated: the episode ended by its own rules at row t.
        done: the episode ended at row t for any reason.
        gamma: discount γ in [0, 1].
        lam: trace decay λ in [0, 1]; 0 is the one-step TD error, 1 is Monte Carlo minus the baseline.

    Returns:
        (advantage, target), each [T, N]; target = advantage + value is the TD(λ) return the critic regresses on.
    """
    require_alike(reward=reward, value=value, next_value=next_value, terminated=terminated, done=done)
    terminated, done = terminated.bool(), done.bool()
    delta = reward + gamma * next_value * ~terminated - value
    decay = gamma * lam * (~done).to(delta.dtype)
    advantage = torch.empty_like(delta)
    trace = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        trace = delta[t] + decay[t] * trace
        advantage[t] = trace
    return advantage, advantage + value


def q_lambda(
    reward: Float[Tensor, "T N"],
    next_value: Float[Tensor, "T N"],
    terminated: Bool[Tensor, "T N"],
    done: Bool[Tensor, "T N"],
    *,
    gamma: float = 0.99,
    lam: float = 0.8,
) -> Float[Tensor, "T N"]:
    """The λ-return of Q-learning: Gallici et al. 2025, arXiv:2407.04811, section 4, which is Peng's Q(λ).

        G_t = r_t + γ (λ G_{t+1} + (1 − λ) max_a Q(s_{t+1}, a))

    r_t alone after a termination. Where the chain ends, at a time-out and in the last row, the maximum stands for
    G_{t+1}. An exploratory action does not end it, as it would in Watkins's Q(λ).

    Args:
        reward: r_t.
        next_value: max_a Q(s_{t+1}, a) at the true successor, before any reset.
        terminated: the episode ended by its own rules at row t.
        done: the episode ended at row t for any reason.
        gamma: discount γ in [0, 1].
        lam: trace decay λ in [0, 1]; 0 is the target of one-step Q-learning.
    """
    require_alike(reward=reward, next_value=next_value, terminated=terminated, done=done)
    terminated, done = terminated.bool(), done.bool()
    target = torch.empty_like(next_value)
    follows = next_value[-1]
    for t in reversed(range(len(reward))):
        ahead = torch.lerp(next_value[t], follows, lam * (~done[t]).to(follows.dtype))
        target[t] = follows = reward[t] + gamma * ahead * ~terminated[t]
    return target


def reward_to_go(
    reward: Float[Tensor, "T N"],
    next_value: Float[Tensor, "T N"],
    terminated: Bool[Tensor, "T N"],
    done: Bool[Tensor, "T N"],
    *,
    gamma: float = 0.99,
) -> Float[Tensor, "T N"]:
    """The discounted rewards that follow each action: Sutton & Barto 2018, section 13.3.

        G_t = r_t + γ G_{t+1}       up to the end of the episode

    Where rows run out before the episode does, and where a time-out cut it, `next_value` stands for the rest; zeros
    leave it out.

    Args:
        reward: r_t.
        next_value: V(s_{t+1}) of the true successor.
        terminated: the episode ended by its own rules at row t.
        done: the episode ended at row t for any reason.
        gamma: discount γ in [0, 1].
    """
    require_alike(reward=reward, next_value=next_value, terminated=terminated, done=done)
    terminated, done = terminated.bool(), done.bool()
    delta = reward + gamma * next_value * (done & ~terminated)
    delta[-1] = reward[-1] + gamma * next_value[-1] * ~terminated[-1]
    go = torch.empty_like(delta)
    follows = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        follows = delta[t] + gamma * follows * ~done[t]
        go[t] = follows
    return go


def episode_return(
    to_go: Float[Tensor, "T N"], reward: Float[Tensor, "T N"], done: Bool[Tensor, "T N"], *, gamma: float = 0.99
) -> Float[Tensor, "T N"]:
    """The return of the whole episode at each of its rows: Williams 1992, section 5, where every action gets it.

        G_0 = Σ_{k<t} γ^k r_k + γ^t G_t

    Args:
        to_go: G_t of `reward_to_go`.
        reward: r_t.
        done: the episode ended at row t. Row 0 begins an episode, and so does every row after an end.
        gamma: discount γ in [0, 1].
    """
    require_alike(to_go=to_go, reward=reward, done=done)
    whole, weight, paid = torch.empty_like(to_go), torch.ones_like(to_go[0]), torch.zeros_like(to_go[0])
    for t in range(len(to_go)):
        whole[t] = paid + weight * to_go[t]
        paid = torch.where(done[t], 0.0, paid + weight * reward[t])
        weight = torch.where(done[t], 1.0, gamma * weight)
    return whole


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
