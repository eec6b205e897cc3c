"""Functions to write as an exercise, each with test cases and its well-known mistakes."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lemniscate import maths
from lemniscate.course import agents, clipping, drone, lander, loop, replay, saving, setup
from lemniscate.course.exercise import TWO_ENDS, Case, Exercise, Function, Inspection, drawn, late


def _column(*numbers: float) -> Tensor:
    return torch.tensor(numbers)[:, None]


def _flags(*rows: int, length: int = 4) -> Tensor:
    flags = torch.zeros(length, 1, dtype=torch.bool)
    flags[list(rows)] = True
    return flags


VALUES = (_column(1.0, -0.5, 2.0, 0.5), _column(0.3, 1.2, -0.4, 0.8), _column(0.9, -0.7, 0.6, 1.5))
"""r, V(s) and V(s') of four steps of one environment"""
DISCOUNTS = {"gamma": 0.9, "lam": 0.8}
NEVER, LAST = _flags(), _flags(3)
TWO = (drawn(5, 2), drawn(2, 5).T.contiguous(), drawn(2, 5).T.contiguous() + 1)
TWO_DONE = TWO_ENDS | torch.tensor([[0, 1], [0, 0], [0, 0], [0, 0], [1, 0]]).bool()
"""the deaths, and a time-out in each of the two environments"""


def _without(flags: Tensor) -> Tensor:
    return torch.zeros_like(flags)


def _chain_by(decay: Callable[[float, float], float]) -> Function:
    """GAE whose chain decays by another factor."""

    def gae(r: Tensor, v: Tensor, n: Tensor, term: Tensor, done: Tensor, *, gamma: float, lam: float) -> Any:
        delta = r + gamma * n * ~term - v
        zero = torch.zeros_like(delta)
        advantage, _ = maths.gae(delta, zero, zero, term, done, gamma=1.0, lam=decay(gamma, lam))
        return advantage, advantage + v

    return gae


def _clipped_value_alone(v: Tensor, target: Tensor, old: Any = None, clip: float | None = None) -> Tensor:
    return maths.value_loss(v if clip is None else old + (v - old).clamp(-clip, clip), target)


EXERCISES: dict[str, Exercise | Inspection] = {
    "gae": Exercise(
        maths.gae,
        ("advantage", "target"),
        [
            Case("no end", (*VALUES, NEVER, NEVER), DISCOUNTS),
            Case("a death at the last row", (*VALUES, LAST, LAST), DISCOUNTS),
            Case("a death at row 1", (*VALUES, _flags(1), _flags(1)), DISCOUNTS),
            Case("a time-out at row 1", (*VALUES, NEVER, _flags(1)), DISCOUNTS),
            Case("two environments, ends of both kinds", (*TWO, TWO_ENDS, TWO_DONE), DISCOUNTS),
        ],
        {
            "the chain is not cut at time-outs": lambda r, v, n, te, d, **o: maths.gae(r, v, n, te, te, **o),
            "the chain is cut nowhere": lambda r, v, n, te, d, **o: maths.gae(r, v, n, te, _without(d), **o),
            "a time-out is taken for a death": lambda r, v, n, te, d, **o: maths.gae(r, v, n, d, d, **o),
            "a value follows a death": lambda r, v, n, te, d, **o: maths.gae(r, v, n, _without(te), d, **o),
            "the flags are read one row too late": lambda r, v, n, te, d, **o: maths.gae(
                r, v, n, late(te), late(d), **o
            ),
            "V(s') is taken from the next row, which after an end is another episode's": lambda r, v, n, te, d, **o: (
                maths.gae(r, v, torch.cat([v[1:], n[-1:]]), te, d, **o)
            ),
            "λ is left out": _chain_by(lambda gamma, lam: gamma),
            "γ is left out of the chain": _chain_by(lambda gamma, lam: lam),
            "there is no chain": _chain_by(lambda gamma, lam: 0.0),
            "V is not added to the target": lambda *a, **o: (maths.gae(*a, **o)[0],) * 2,
            "the two are returned in the other order": lambda *a, **o: maths.gae(*a, **o)[::-1],
        },
    ),
    "reward_to_go": Exercise(
        maths.reward_to_go,
        ("return",),
        [
            Case("no end", (VALUES[0], VALUES[2], NEVER, NEVER), {"gamma": 0.9}),
            Case("a death at row 1", (VALUES[0], VALUES[2], _flags(1), _flags(1)), {"gamma": 0.9}),
            Case("a time-out at row 1", (VALUES[0], VALUES[2], NEVER, _flags(1)), {"gamma": 0.9}),
            Case("two environments, ends of both kinds", (TWO[0], TWO[2], TWO_ENDS, TWO_DONE), {"gamma": 0.9}),
        ],
        {
            "V(s') of the last row is left out": lambda r, n, te, d, **o: maths.reward_to_go(
                r, torch.where(d, n, 0.0), te, d, **o
            ),
            "a time-out is taken for a death": lambda r, n, te, d, **o: maths.reward_to_go(r, n, d, d, **o),
            "a value follows a death": lambda r, n, te, d, **o: maths.reward_to_go(r, n, _without(te), d, **o),
            "the sum runs on over the end": lambda r, n, te, d, **o: maths.reward_to_go(
                r, n, _without(te), _without(d), **o
            ),
            "γ is left out": lambda r, n, te, d, **o: maths.reward_to_go(r, n, te, d, gamma=1.0),
            "every row gets what came before it": lambda r, n, te, d, **o: maths.reward_to_go(
                r.flip(0), n, te, d, **o
            ).flip(0),
        },
    ),
    "td_target": Exercise(
        maths.td_target,
        ("target",),
        [
            Case("nothing ends", (drawn(6), drawn(6) + 1, torch.zeros(6).bool()), {"gamma": 0.9}),
            Case("some end", (drawn(6), drawn(6) + 1, torch.tensor([0, 1, 0, 0, 1, 1]).bool()), {"gamma": 0.9}),
        ],
        {
            "a value follows a death": lambda r, n, te, **o: maths.td_target(r, n, _without(te), **o),
            "only what ended bootstraps": lambda r, n, te, **o: maths.td_target(r, n, ~te, **o),
            "γ is left out": lambda r, n, te, **o: maths.td_target(r, n, te, gamma=1.0),
            "the reward is left out": lambda r, n, te, **o: maths.td_target(torch.zeros_like(r), n, te, **o),
            "the reward of a death is left out": lambda r, n, te, gamma: (r + gamma * n) * ~te,
        },
    ),
    "policy_gradient": Exercise(
        maths.policy_gradient,
        ("loss",),
        [Case("eight actions", (drawn(8), drawn(8) + 0.5))],
        {
            "the sign: optimizers descend": lambda log_prob, weight: -maths.policy_gradient(log_prob, weight),
            "the sum in place of the mean": lambda log_prob, weight: -(log_prob * weight).sum(),
            "π in place of log π": lambda log_prob, weight: maths.policy_gradient(log_prob.exp(), weight),
        },
        gradient_in=0,
    ),
    "clipped_surrogate": Exercise(
        maths.clipped_surrogate,
        ("loss",),
        [
            Case("ratios of one", (torch.zeros(4), torch.tensor([1.0, 2.0, -1.0, 0.5])), {"clip": 0.2}),
            Case("good actions", (torch.tensor([-0.5, -0.1, 0.1, 0.5]), torch.ones(4)), {"clip": 0.2}),
            Case("bad actions", (torch.tensor([-0.5, -0.1, 0.1, 0.5]), -torch.ones(4)), {"clip": 0.2}),
            Case("of all kinds", (drawn(12) / 3, drawn(12).flip(0)), {"clip": 0.1}),
        ],
        clipping.MISTAKES | clipping.RATIO_MISTAKES,
        gradient_in=0,
    ),
    "value_loss": Exercise(
        maths.value_loss,
        ("loss",),
        [
            Case("without a clip", (drawn(6), drawn(6) + 1)),
            Case("with a clip", (drawn(8), drawn(8).flip(0), drawn(8) + 0.3, 0.2)),
            Case("with an old value, and None for the clip", (drawn(8), drawn(8).flip(0), drawn(8) + 0.3, None)),
        ],
        {
            "the conventional half is missing": lambda *a: 2 * maths.value_loss(*a),
            "the sum in place of the mean": lambda v, *a: maths.value_loss(v, *a) * len(v),
            "the error is not squared": lambda v, target, *_: 0.5 * (v - target).abs().mean(),
            "the clip is left out": lambda v, target, *_: maths.value_loss(v, target),
            "only the clipped value counts": _clipped_value_alone,
        },
        gradient_in=0,
    ),
    "polyak": Exercise(
        maths.polyak,
        ("target[0]", "target[1]", "online[0]", "online[1]"),
        [Case("two tensors", ([drawn(3), drawn(2, 2)], [drawn(3) + 1, drawn(2, 2) - 1], 0.1))],
        {
            "the target is to be changed in place": lambda target, online, tau: None,
            "τ and 1 − τ are exchanged": lambda target, online, tau: maths.polyak(target, online, 1 - tau),
            "the online network is moved, not the target": lambda target, online, tau: maths.polyak(
                online, target, tau
            ),
        },
        in_place=True,
    ),
    **drone.EXERCISES,
    **lander.EXERCISES,
    "sample_categorical": Inspection(agents.sample_categorical),
    "Agent": Inspection(agents.agent),
    "Actor": Inspection(agents.actor),
    "QNetwork": Inspection(agents.q_network),
    "set_seeds": Inspection(setup.set_seeds),
    "make_envs": Inspection(setup.make_envs),
    "save_model": Inspection(saving.save_model),
    "load_model": Inspection(saving.load_model),
    "sync_envs": Inspection(setup.sync_envs),
    "ReplayBuffer": Inspection(replay.replay_buffer),
    "add_to_replay": Inspection(replay.add_to_replay),
    "train": Inspection(loop.train),
}
