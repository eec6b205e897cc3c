"""The functions of a course on the drone, as methods of its trainer: buffers [T, N], flags as numbers."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lemniscate import maths
from lemniscate.course import clipping
from lemniscate.course.exercise import TWO_ENDS, Case, Exercise, Function, drawn, late


def calculate_advantages(
    next_value: Tensor,
    *,
    rewards_buffer: Tensor,
    values_buffer: Tensor,
    terminated_buffer: Tensor,
    n_steps: int,
    gamma: float,
    gae_lambda: float,
) -> tuple[Tensor, Tensor]:
    """(returns, advantages), each [T, N]; `terminated_buffer[t]` is 1 where action t ended the episode."""
    ended = terminated_buffer.bool()
    following = torch.cat([values_buffer[1:], next_value.reshape(1, -1)])
    rewards = rewards_buffer[:n_steps]
    advantages, returns = maths.gae(rewards, values_buffer, following, ended, ended, gamma=gamma, lam=gae_lambda)
    return returns, advantages


def _buffers(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Function:
    """`calculate_advantages` after a change of what it is computed from."""
    return lambda next_value, **held: calculate_advantages(next_value, **{**held, **change(held)})


def _late(held: dict[str, Any]) -> dict[str, Any]:
    return {"terminated_buffer": late(held["terminated_buffer"])}


def _without(part: str, is_late: bool) -> Function:
    """`calculate_advantages` without a part of δ = r + γ (1 − terminated) V(s') − V(s), or of the chain."""

    def wrong(next_value: Tensor, **held: Any) -> tuple[Tensor, Tensor]:
        flags, values = held["terminated_buffer"].bool(), held["values_buffer"]
        ended = late(flags) if is_late else flags
        following = torch.cat([values[1:], next_value.reshape(1, -1)])
        following = following if part == "1 − terminated" else following * ~ended
        following = following if part == "γ" else held["gamma"] * following
        zero = torch.zeros_like(values)
        delta = held["rewards_buffer"] + following - (zero if part == "V(s)" else values)
        done = torch.zeros_like(ended) if part == "end of the chain" else ended
        advantages, _ = maths.gae(delta, zero, zero, ended, done, gamma=held["gamma"], lam=held["gae_lambda"])
        return advantages + values, advantages

    return wrong


LEFT_OUT = {
    "V(s) is not subtracted": "V(s)",
    "γ is left out of δ": "γ",
    "1 − terminated is left out of δ, so a value follows a death": "1 − terminated",
    "the chain is not cut at a death": "end of the chain",
}
"""mistake: the part that is missing"""
LATE = "; also, the flags are read one row too late, as in the loop that the course gives"


def _held(rewards: Tensor, values: Tensor, ended: Tensor) -> dict[str, Any]:
    buffers = {"rewards_buffer": rewards, "values_buffer": values, "terminated_buffer": ended}
    return {**buffers, "n_steps": len(rewards), "gamma": 0.99, "gae_lambda": 0.95}


FOUR = (torch.ones(4, 1), torch.tensor([[0.5], [0.6], [0.7], [0.8]]))


def calculate_pg_loss(mb_advantages: Tensor, ratio: Tensor, *, clip_coef: float) -> Tensor:
    """A scalar."""
    return maths.clipped_surrogate(ratio.log(), mb_advantages, clip_coef)


def _pg_loss(wrong: Function) -> Function:
    """`calculate_pg_loss` as a function of (log ratio, advantages, ε)."""
    return lambda mb_advantages, ratio, *, clip_coef: wrong(ratio.log(), mb_advantages, clip_coef)


def calculate_v_loss(
    newvalue: Tensor, b_returns: Tensor, b_values: Tensor, mb_inds: Any, if_clip: bool = False, *, clip_coef: float
) -> Tensor:
    """A scalar; `newvalue` are the values of the rows `mb_inds`."""
    old = b_values[mb_inds] if if_clip else None
    return maths.value_loss(newvalue, b_returns[mb_inds], old, clip_coef if if_clip else None)


def _v_loss(wrong: Function) -> Function:
    """`calculate_v_loss` as a function of (new value, return, old value, ε or None), all of the minibatch."""

    def compute(
        new: Tensor, returns: Tensor, old: Tensor, rows: Any, if_clip: bool = False, *, clip_coef: float
    ) -> Any:
        return wrong(new, returns[rows], old[rows], clip_coef if if_clip else None)

    return compute


def _first_rows(new: Tensor, returns: Tensor, old: Tensor, rows: Any, if_clip: bool = False, **held: Any) -> Tensor:
    return calculate_v_loss(new, returns, old, torch.arange(len(new)), if_clip, **held)


V_LOSS = (
    torch.tensor([2.5, 1.5, 3.0, 4.5]),
    torch.tensor([3.0, 1, 2, 5]),
    torch.tensor([2.0, 1, 2.5, 4]),
    torch.arange(4),
)
SHUFFLED = (drawn(3), drawn(6), drawn(6) + 0.4, torch.tensor([4, 1, 5]))


def _clipped(new: Tensor, returns: Tensor, old: Tensor, clip: float | None) -> Tensor:
    return maths.value_loss(new, returns, old, clip)


EXERCISES: dict[str, Exercise] = {
    "calculate_advantages": Exercise(
        calculate_advantages,
        ("returns", "advantages"),
        [
            Case("no end", (torch.tensor([[0.9]]),), _held(*FOUR, torch.zeros(4, 1))),
            Case("a death at the last row", (torch.zeros(1, 1),), _held(*FOUR, torch.tensor([[0.0], [0], [0], [1]]))),
            Case("two environments", (drawn(1, 2),), _held(drawn(5, 2), drawn(5, 2, seed=1), TWO_ENDS.float())),
        ],
        {
            "the two are returned in the other order": lambda *a, **held: calculate_advantages(*a, **held)[::-1],
            "a value follows a death, and the chain is not cut": _buffers(
                lambda held: {"terminated_buffer": torch.zeros_like(held["terminated_buffer"])}
            ),
            "λ is left out": _buffers(lambda held: {"gae_lambda": 1.0}),
            "there is no chain": _buffers(lambda held: {"gae_lambda": 0.0}),
            **{words: _without(part, is_late=False) for words, part in LEFT_OUT.items()},
            **{words + LATE: _without(part, is_late=True) for words, part in LEFT_OUT.items()},
        },
        accepted={
            "the loop that the course gives reads the flags one row too late, and its own test expects that. Row t"
            " holds what action t ended, so a crash is cut off from the action before it. With terminated_buffer[t] in"
            " every row it is right, but fails the course's test": _buffers(_late),
        },
    ),
    "calculate_pg_loss": Exercise(
        calculate_pg_loss,
        ("pg_loss",),
        [
            Case(
                "the course's",
                (torch.tensor([1, 0.5, -1, -0.5]), torch.tensor([1.1, 1.3, 0.7, 0.9])),
                {"clip_coef": 0.2},
            ),
            Case("of all kinds", (drawn(12), (drawn(12, seed=1) / 3).exp()), {"clip_coef": 0.1}),
        ],
        {
            **{words: _pg_loss(wrong) for words, wrong in clipping.MISTAKES.items()},
            "the ratio is taken for its logarithm": lambda a, r, clip_coef: maths.clipped_surrogate(r, a, clip_coef),
        },
        gradient_in=1,
    ),
    "calculate_v_loss": Exercise(
        calculate_v_loss,
        ("v_loss",),
        [
            Case("without a clip", (*V_LOSS, False), {"clip_coef": 0.2}),
            Case("with a clip", (*V_LOSS, True), {"clip_coef": 0.2}),
            Case("rows of a larger batch", (*SHUFFLED, False), {"clip_coef": 0.2}),
            Case("rows of a larger batch, with a clip", (*SHUFFLED, True), {"clip_coef": 0.2}),
        ],
        {
            "the conventional half is missing": _v_loss(lambda *a: 2 * _clipped(*a)),
            "the sum in place of the mean": _v_loss(lambda new, *a: _clipped(new, *a) * len(new)),
            "the clip is left out": _v_loss(lambda new, returns, old, clip: _clipped(new, returns, old, None)),
            "only the clipped value counts": _v_loss(
                lambda new, returns, old, clip: _clipped(
                    new if clip is None else old + (new - old).clamp(-clip, clip), returns, old, None
                )
            ),
            "the smaller of the two errors is taken": _v_loss(
                lambda new, returns, old, clip: (
                    _clipped(new, returns, old, None)
                    if clip is None
                    else 0.5
                    * torch.min(
                        (new - returns).square(), (old + (new - old).clamp(-clip, clip) - returns).square()
                    ).mean()
                )
            ),
            "the rows mb_inds of b_returns and b_values are not chosen": _first_rows,
        },
        gradient_in=0,
    ),
}
