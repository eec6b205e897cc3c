"""The functions of a course on LunarLander, as methods of its agent: rows [N · T], one environment after the other."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lemniscate import maths
from lemniscate.course import clipping
from lemniscate.course.exercise import Case, Exercise, Function, drawn


def compute_advantages(
    states: Tensor,
    rewards: Tensor,
    next_states: Tensor,
    terminations: Tensor,
    *,
    gamma: float,
    lmbda: float,
    num_steps: int,
    compute_values: Function,
) -> tuple[Tensor, Tensor]:
    """(advantages, critic targets), each [N · T]."""
    columns = (rewards, compute_values(states), compute_values(next_states), terminations, terminations)
    by_time = [column.reshape(-1, num_steps).T for column in columns]  # [T, N]
    out = maths.gae(*by_time, gamma=gamma, lam=lmbda)
    return out[0].T.reshape(-1).detach(), out[1].T.reshape(-1).detach()


def _lander(**changes: Callable[..., Any]) -> Function:
    """`compute_advantages` with arguments changed, each by a function of the four tensors."""

    def wrong(*args: Tensor, **held: Any) -> Any:
        names = ("states", "rewards", "next_states", "terminations")
        changed = {name: change(*args, **held) for name, change in changes.items()}
        options = {**dict(zip(names, args, strict=True)), **held, **changed}
        return compute_advantages(**options)

    return wrong


def _uncut_lander(states: Tensor, rewards: Tensor, next_states: Tensor, ended: Tensor, **held: Any) -> Any:
    """The value is cut at a death, the chain is not."""
    values, following = held["compute_values"](states), held["compute_values"](next_states)
    r, v, n, term = (column.reshape(-1, held["num_steps"]).T for column in (rewards, values, following, ended))
    out = maths.gae(r, v, n, term, torch.zeros_like(term), gamma=held["gamma"], lam=held["lmbda"])
    return tuple(part.T.reshape(-1) for part in out)


def _time_major(*args: Tensor, **held: Any) -> Any:
    """The rows of a step are taken to be together."""
    steps, rows = held["num_steps"], torch.arange(len(args[1]))
    env_major = rows.reshape(steps, -1).T.reshape(-1)
    out = compute_advantages(*(arg[env_major] for arg in args), **held)
    back = env_major.argsort()
    return tuple(part[back] for part in out)


def _forwards(*args: Tensor, **held: Any) -> Any:
    """The list that was made backwards is not reversed."""
    out = compute_advantages(*args, **held)[0].flip(0)
    return out, out + held["compute_values"](args[0])


def _shifted(states: Tensor, rewards: Tensor, next_states: Tensor, ended: Tensor, **held: Any) -> Tensor:
    return torch.cat([states[1:], next_states[-1:]])


def _values(states: Tensor) -> Tensor:
    return states @ torch.tensor([0.5, -1.0, 0.25])


def _log_probs(states: Tensor, actions: Tensor) -> Tensor:
    return _scores(states).log_softmax(1).gather(1, actions[:, None])[:, 0]


def _scores(states: Tensor) -> Tensor:
    return states @ torch.tensor([[1.0, 0.0], [-1.0, 0.5], [0.5, 1.0]])


def _env_major(about: str, num_envs: int, steps: int, ends: tuple[int, ...]) -> Case:
    rows = num_envs * steps
    ended = torch.zeros(rows, dtype=torch.bool)
    ended[list(ends)] = True
    args = (drawn(rows, 3), drawn(rows), drawn(rows, 3, seed=1), ended)
    held = {"gamma": 0.9, "lmbda": 0.8, "num_steps": steps, "compute_values": _values}
    return Case(about, args, held, {"critic": lambda states: _values(states)[:, None]})


def compute_loss(
    states: Tensor,
    actions: Tensor,
    advantages: Tensor,
    critic_targets: Tensor,
    log_probs_old: Tensor,
    *,
    epsilon: float,
    compute_log_probs: Function,
    compute_values: Function,
) -> tuple[Tensor, Tensor]:
    """(actor loss, critic loss); the critic's is the mean square, without a half."""
    actor_loss = maths.clipped_surrogate(compute_log_probs(states, actions) - log_probs_old, advantages, epsilon)
    return actor_loss, 2 * maths.value_loss(compute_values(states), critic_targets)


def _actor_loss(wrong: Function) -> Function:
    """`compute_loss` with an actor loss of (log ratio, advantages, ε)."""

    def compute(states: Tensor, actions: Tensor, advantages: Tensor, targets: Tensor, old: Tensor, **held: Any) -> Any:
        right = compute_loss(states, actions, advantages, targets, old, **held)
        return wrong(held["compute_log_probs"](states, actions) - old, advantages, held["epsilon"]), right[1]

    return compute


def _critic_loss(wrong: Function) -> Function:
    """`compute_loss` with a critic loss of (values, targets)."""

    def compute(states: Tensor, actions: Tensor, advantages: Tensor, targets: Tensor, old: Tensor, **held: Any) -> Any:
        right = compute_loss(states, actions, advantages, targets, old, **held)
        return right[0], wrong(held["compute_values"](states), targets)

    return compute


LOSS_ARGS = (
    drawn(8, 3),
    torch.tensor([0, 1, 1, 0, 0, 1, 0, 1]),
    drawn(8),
    drawn(8, seed=1),
    drawn(8, seed=2) / 4 - 0.7,
)
LOSS_HELD = {"epsilon": 0.2, "compute_log_probs": _log_probs, "compute_values": _values}
LOSS_SELF = {"actor": _scores, "critic": lambda states: _values(states)[:, None]}


def discounted_returns(rewards: Tensor, *, gamma: float) -> Tensor:
    """Σ_k γ^(k−t) r_k over k ≥ t, [T], of one whole episode."""
    out = torch.zeros_like(rewards)
    follows = torch.zeros(())
    for t in reversed(range(len(rewards))):
        follows = rewards[t] + gamma * follows
        out[t] = follows
    return out


def _weighted(weight: Callable[[Tensor, Tensor, float], Tensor]) -> Function:
    """Returns whose rewards k are weighted in row t by a function of (t [T, 1], k [T], γ)."""

    def returns(rewards: Tensor, *, gamma: float) -> Tensor:
        k = torch.arange(len(rewards)).float()
        return weight(k[:, None], k, gamma) @ rewards

    return returns


def select_at_index(x: Tensor, indices: Tensor) -> Tensor:
    """x[i, indices[i]] for each row i, [B]."""
    return x.gather(-1, indices[:, None])[:, 0]


EXERCISES: dict[str, Exercise] = {
    "compute_advantages": Exercise(
        compute_advantages,
        ("advantages", "critic_targets"),
        [
            _env_major("one step of three environments", 3, 1, (1,)),
            _env_major("four steps of one environment", 1, 4, ()),
            _env_major("a death in between", 1, 4, (1,)),
            _env_major("two environments of three steps", 2, 3, ()),
            _env_major("two environments, a death at a border", 2, 3, (2, 4)),
        ],
        {
            "the chain runs on from one environment into the next": _lander(num_steps=lambda *a, **held: len(a[1])),
            "the rows are read as [T, N], a step of all environments after the other": _time_major,
            "V(s') is taken from the next row, which may be another environment's or episode's": _lander(
                next_states=_shifted
            ),
            "a value follows a death, and the chain is not cut": _lander(
                terminations=lambda *a, **held: torch.zeros_like(a[3])
            ),
            "the chain is not cut at a death": _uncut_lander,
            "the list that was made backwards is not reversed": _forwards,
            "there is no chain, only δ. With one step for each environment, as in the course's own test, they are"
            " equal": _lander(lmbda=lambda *a, **held: 0.0),
            "λ is left out": _lander(lmbda=lambda *a, **held: 1.0),
            "V is not added to the targets": lambda *a, **held: (compute_advantages(*a, **held)[0],) * 2,
        },
    ),
    "compute_loss": Exercise(
        compute_loss,
        ("actor_loss", "critic_loss"),
        [Case("eight actions", LOSS_ARGS, LOSS_HELD, LOSS_SELF)],
        {
            **{
                f"in the actor's loss, {words}": _actor_loss(wrong)
                for words, wrong in (clipping.MISTAKES | clipping.RATIO_MISTAKES).items()
            },
            "a half before the critic's loss, which this course has not": _critic_loss(maths.value_loss),
            "the critic's error is not squared": _critic_loss(lambda v, target: (v - target).abs().mean()),
        },
        gradient_in=0,
    ),
    "discounted_returns": Exercise(
        discounted_returns,
        ("returns",),
        [
            Case("one step", (torch.tensor([2.0]),), {"gamma": 0.9}),
            Case("five steps", (drawn(5) + 1,), {"gamma": 0.9}),
        ],
        {
            "the exponent is upside down: γ^(t−k) grows": _weighted(lambda t, k, gamma: gamma ** (t - k) * (k >= t)),
            "every row has the return of the whole episode": _weighted(lambda t, k, gamma: gamma**k + 0 * t),
            "it is discounted from the beginning of the episode": _weighted(lambda t, k, gamma: gamma**k * (k >= t)),
            "γ is left out": _weighted(lambda t, k, gamma: (k >= t).float()),
            "every row gets what came before it": _weighted(lambda t, k, gamma: gamma ** (t - k).abs() * (k <= t)),
        },
    ),
    "select_at_index": Exercise(
        select_at_index,
        ("result",),
        [Case("three rows of four", (drawn(3, 4), torch.tensor([2, 0, 3])))],
        {
            "the numbers are taken from one row": lambda x, indices: x[0, indices],
            "it counts from the end": lambda x, indices: x.flip(1).gather(1, indices[:, None])[:, 0],
        },
    ),
}
