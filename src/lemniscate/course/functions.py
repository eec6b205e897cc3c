"""Functions to write, each with its cases and its well-known mistakes.

A course's function is often one of `lemniscate.maths` in another form: a method, with other names, another layout or
other outputs. Its reference is then a form of that function, and a mistake in the function is a mistake in its form.
r, v, n, te and d are reward, V(s), V(s'), terminated and done, [T, N].
"""

from typing import Any

import torch
from torch import Tensor

from lemniscate import maths
from lemniscate.course.exercise import Case, Exercise, Function
from lemniscate.maths import clipped_surrogate, gae, reward_to_go, td_target, value_loss


def _drawn(*shape: int, seed: int = 0) -> Tensor:
    """Normal numbers, the same each time."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(sum(shape) + 100 * seed))


def _column(*numbers: float) -> Tensor:
    return torch.tensor(numbers)[:, None]


def _none(flags: Tensor) -> Tensor:
    return torch.zeros_like(flags)


def _late(flags: Tensor) -> Tensor:
    """The flag of row t + 1 in row t, and that of the last row there too."""
    return torch.cat([flags[1:], flags[-1:]])


# --- advantages and returns of rollouts ---

R, V, N = _column(1.0, -0.5, 2.0, 0.5), _column(0.3, 1.2, -0.4, 0.8), _column(0.9, -0.7, 0.6, 1.5)
"""reward, V(s) and V(s') of four steps of one environment"""
NEVER, AT_1, AT_3 = _column(0, 0, 0, 0).bool(), _column(0, 1, 0, 0).bool(), _column(0, 0, 0, 1).bool()
TWO_R, TWO_V = _drawn(5, 2), _drawn(2, 5).T.contiguous()
TWO_ENDS = torch.tensor([[0, 0], [1, 0], [0, 0], [0, 1], [0, 0]]).bool()
"""a death in each of two environments"""
TWO_DONE = TWO_ENDS | torch.tensor([[0, 1], [0, 0], [0, 0], [0, 0], [1, 0]]).bool()
"""the deaths, and a time-out in each of the two environments"""
GAMMA, DISCOUNTS = {"gamma": 0.9}, {"gamma": 0.9, "lam": 0.8}

GAE: dict[str, Function] = {
    "the chain is not cut at time-outs": lambda r, v, n, te, d, **o: gae(r, v, n, te, te, **o),
    "the chain is cut nowhere": lambda r, v, n, te, d, **o: gae(r, v, n, te, _none(d), **o),
    "a time-out is taken for a death": lambda r, v, n, te, d, **o: gae(r, v, n, d, d, **o),
    "a value follows a death": lambda r, v, n, te, d, **o: gae(r, v, n, _none(te), d, **o),
    "the flags are read one row too late": lambda r, v, n, te, d, **o: gae(r, v, n, _late(te), _late(d), **o),
    "V(s') is taken from the next row, which after an end is another episode's": (
        lambda r, v, n, te, d, **o: gae(r, v, torch.cat([v[1:], n[-1:]]), te, d, **o)
    ),
    "λ is left out": lambda *rows, gamma, lam: gae(*rows, gamma=gamma, lam=1.0),
    "γ is left out of the chain": lambda *rows, gamma, lam: gae(*rows, gamma=gamma, lam=lam / gamma),
    "there is no chain": lambda *rows, gamma, lam: gae(*rows, gamma=gamma, lam=0.0),
    "V is not added to the target": lambda *rows, **o: (gae(*rows, **o)[0],) * 2,
    "the two are returned in the other order": lambda *rows, **o: gae(*rows, **o)[::-1],
}
UNCUT: dict[str, Function] = {
    "a value follows a death, and the chain is not cut": (
        lambda r, v, n, te, d, **o: gae(r, v, n, _none(te), _none(d), **o)
    ),
    "the chain is not cut at a death": GAE["the chain is cut nowhere"],
}
"""mistakes where every end is a death"""
LEFT_OUT: dict[str, Function] = {
    "V(s) is not subtracted": lambda r, v, *rows, **o: gae(r + v, v, *rows, **o),
    "γ is left out of δ": lambda r, v, n, te, d, **o: gae(r, v, n / o["gamma"], te, d, **o),
    "1 − terminated is left out of δ, so a value follows a death": GAE["a value follows a death"],
    "the chain is not cut at a death": GAE["the chain is cut nowhere"],
}
"""parts of the loop that the drone's course leaves to be filled in"""
LATE = "; also, the flags are read one row too late, as in the loop that the course gives"
RETURN: dict[str, Function] = {
    "γ is left out": lambda *rows, gamma: reward_to_go(*rows, gamma=1.0),
    "every row gets what came before it": lambda r, *rows, **o: reward_to_go(r.flip(0), *rows, **o).flip(0),
}


def _also_late(function: Function) -> Function:
    return lambda r, v, n, te, d, **o: function(r, v, n, _late(te), _late(d), **o)


def _drone_advantages(function: Function) -> Function:
    """`gae` in the form of the drone's course: buffers [T, N], and flags that are numbers."""

    def calculate_advantages(self: Any, next_value: Tensor) -> tuple[Tensor, Tensor]:
        """(returns, advantages), each [T, N]; `terminated_buffer[t]` is 1 where action t ended the episode."""
        ended = self.terminated_buffer.bool()
        following = torch.cat([self.values_buffer[1:], next_value.reshape(1, -1)])
        rows = (self.rewards_buffer, self.values_buffer, following, ended, ended)
        advantages, returns = function(*rows, gamma=self.gamma, lam=self.gae_lambda)
        return returns, advantages

    return calculate_advantages


def _drone_case(about: str, next_value: Tensor, rewards: Tensor, values: Tensor, ended: Tensor) -> Case:
    buffers = {"rewards_buffer": rewards, "values_buffer": values, "terminated_buffer": ended.float()}
    return Case(about, (next_value,), {**buffers, "n_steps": len(rewards), "gamma": 0.99, "gae_lambda": 0.95})


FOUR = (torch.ones(4, 1), _column(0.5, 0.6, 0.7, 0.8))


def _lander_advantages(function: Function) -> Function:
    """`gae` in the form of the lander's course: rows [N · T], one environment after the other."""

    def compute_advantages(self: Any, states: Tensor, rewards: Tensor, next_states: Tensor, ended: Tensor) -> Any:
        """(advantages, critic targets), each [N · T]."""
        columns = (rewards, self.compute_values(states), self.compute_values(next_states), ended, ended)
        by_time = [column.reshape(-1, self.num_steps).T for column in columns]
        return tuple(out.T.reshape(-1).detach() for out in function(*by_time, gamma=self.gamma, lam=self.lmbda))

    return compute_advantages


compute_advantages = _lander_advantages(gae)


def _in_one_chain(self: Any, *rows: Tensor) -> Any:
    self.num_steps = len(rows[1])
    return compute_advantages(self, *rows)


def _time_major(self: Any, *rows: Tensor) -> Any:
    order = torch.arange(len(rows[1])).reshape(self.num_steps, -1).T.reshape(-1)
    return tuple(out[order.argsort()] for out in compute_advantages(self, *(column[order] for column in rows)))


def _next_row(self: Any, states: Tensor, rewards: Tensor, next_states: Tensor, ended: Tensor) -> Any:
    return compute_advantages(self, states, rewards, torch.cat([states[1:], next_states[-1:]]), ended)


def _forwards(self: Any, *rows: Tensor) -> Any:
    advantages = compute_advantages(self, *rows)[0].flip(0)
    return advantages, advantages + self.compute_values(rows[0])


def _values(states: Tensor) -> Tensor:
    return states @ torch.tensor([0.5, -1.0, 0.25])


def _scores(states: Tensor) -> Tensor:
    return states @ torch.tensor([[1.0, 0.0], [-1.0, 0.5], [0.5, 1.0]])


def _log_probs(states: Tensor, actions: Tensor) -> Tensor:
    return _scores(states).log_softmax(1).gather(1, actions[:, None])[:, 0]


NETWORKS = {"actor": _scores, "critic": lambda states: _values(states)[:, None]}


def _lander_case(about: str, num_envs: int, steps: int, *ends: int) -> Case:
    rows = num_envs * steps
    ended = torch.tensor([row in ends for row in range(rows)])
    held = {"gamma": 0.9, "lmbda": 0.8, "num_steps": steps, "compute_values": _values}
    return Case(about, (_drawn(rows, 3), _drawn(rows), _drawn(rows, 3, seed=1), ended), held, NETWORKS)


def _discounted(function: Function) -> Function:
    """`reward_to_go` in the form of one whole episode."""

    def discounted_returns(rewards: Tensor, *, gamma: float) -> Tensor:
        """Σ_k γ^(k−t) r_k over k ≥ t, [T]."""
        never = torch.zeros(len(rewards), 1, dtype=torch.bool)
        return function(rewards[:, None], torch.zeros(len(rewards), 1), never, never, gamma=gamma)[:, 0]

    return discounted_returns


discounted_returns = _discounted(reward_to_go)

ADVANTAGES: dict[str, Exercise] = {
    "gae": Exercise(
        gae,
        ("advantage", "target"),
        [
            Case("no end", (R, V, N, NEVER, NEVER), DISCOUNTS),
            Case("a death at the last row", (R, V, N, AT_3, AT_3), DISCOUNTS),
            Case("a death at row 1", (R, V, N, AT_1, AT_1), DISCOUNTS),
            Case("a time-out at row 1", (R, V, N, NEVER, AT_1), DISCOUNTS),
            Case("two environments, ends of both kinds", (TWO_R, TWO_V, TWO_V + 1, TWO_ENDS, TWO_DONE), DISCOUNTS),
        ],
        GAE,
    ),
    "calculate_advantages": Exercise(
        _drone_advantages(gae),
        ("returns", "advantages"),
        [
            _drone_case("no end", _column(0.9), *FOUR, NEVER),
            _drone_case("a death at the last row", _column(0.0), *FOUR, AT_3),
            _drone_case("two environments", _drawn(1, 2), _drawn(5, 2), _drawn(5, 2, seed=1), TWO_ENDS),
        ],
        {
            words: _drone_advantages(wrong)
            for words, wrong in {
                **{
                    key: GAE[key]
                    for key in ("the two are returned in the other order", "λ is left out", "there is no chain")
                },
                **UNCUT,
                **LEFT_OUT,
                **{words + LATE: _also_late(wrong) for words, wrong in LEFT_OUT.items()},
            }.items()
        },
        accepted={
            "the loop that the course gives reads the flags one row too late, and its own test expects that. Row t"
            " holds what action t ended, so a crash is cut off from the action before it. With terminated_buffer[t] in"
            " every row it is right, but fails the course's test": _drone_advantages(_also_late(gae)),
        },
    ),
    "compute_advantages": Exercise(
        compute_advantages,
        ("advantages", "critic_targets"),
        [
            _lander_case("one step of three environments", 3, 1, 1),
            _lander_case("four steps of one environment", 1, 4),
            _lander_case("a death in between", 1, 4, 1),
            _lander_case("two environments of three steps", 2, 3),
            _lander_case("two environments, a death at a border", 2, 3, 2, 4),
        ],
        {
            "the chain runs on from one environment into the next": _in_one_chain,
            "the rows are read as [T, N], a step of all environments after the other": _time_major,
            "V(s') is taken from the next row, which may be another environment's or episode's": _next_row,
            "the list that was made backwards is not reversed": _forwards,
            **{words: _lander_advantages(wrong) for words, wrong in UNCUT.items()},
            "there is no chain, only δ. With one step for each environment, as in the course's own test, they are"
            " equal": _lander_advantages(GAE["there is no chain"]),
            "λ is left out": _lander_advantages(GAE["λ is left out"]),
            "V is not added to the targets": _lander_advantages(GAE["V is not added to the target"]),
        },
    ),
    "reward_to_go": Exercise(
        reward_to_go,
        ("return",),
        [
            Case("no end", (R, N, NEVER, NEVER), GAMMA),
            Case("a death at row 1", (R, N, AT_1, AT_1), GAMMA),
            Case("a time-out at row 1", (R, N, NEVER, AT_1), GAMMA),
            Case("two environments, ends of both kinds", (TWO_R, TWO_V + 1, TWO_ENDS, TWO_DONE), GAMMA),
        ],
        {
            "V(s') of the last row is left out": lambda r, n, te, d, **o: reward_to_go(r, n * d, te, d, **o),
            "a time-out is taken for a death": lambda r, n, te, d, **o: reward_to_go(r, n, d, d, **o),
            "a value follows a death": lambda r, n, te, d, **o: reward_to_go(r, n, _none(te), d, **o),
            "the sum runs on over the end": lambda r, n, te, d, **o: reward_to_go(r, n, _none(te), _none(d), **o),
            **RETURN,
        },
    ),
    "discounted_returns": Exercise(
        discounted_returns,
        ("returns",),
        [Case("one step", (torch.tensor([2.0]),), GAMMA), Case("five steps", (_drawn(5) + 1,), GAMMA)],
        {
            "the exponent is upside down: γ^(t−k) grows": lambda r, gamma: discounted_returns(r, gamma=1 / gamma),
            "every row has the return of the whole episode": (
                lambda r, gamma: discounted_returns(r, gamma=gamma)[:1].expand(len(r))
            ),
            "it is discounted from the beginning of the episode": (
                lambda r, gamma: discounted_returns(r, gamma=gamma) * gamma ** torch.arange(len(r))
            ),
            **{words: _discounted(wrong) for words, wrong in RETURN.items()},
        },
    ),
    "td_target": Exercise(
        td_target,
        ("target",),
        [
            Case("nothing ends", (_drawn(6), _drawn(6) + 1, torch.zeros(6).bool()), GAMMA),
            Case("some end", (_drawn(6), _drawn(6) + 1, torch.tensor([0, 1, 0, 0, 1, 1]).bool()), GAMMA),
        ],
        {
            "a value follows a death": lambda r, n, te, **o: td_target(r, n, _none(te), **o),
            "only what ended bootstraps": lambda r, n, te, **o: td_target(r, n, ~te, **o),
            "γ is left out": lambda r, n, te, **o: td_target(r, n, te, gamma=1.0),
            "the reward is left out": lambda r, n, te, **o: td_target(torch.zeros_like(r), n, te, **o),
            "the reward of a death is left out": lambda r, n, te, gamma: (r + gamma * n) * ~te,
        },
    ),
}

# --- losses ---

CLIPPED: dict[str, Function] = {
    "the sign: optimizers descend": lambda x, a, clip: -clipped_surrogate(x, a, clip),
    "the larger objective is taken; of the negative losses it is the larger, of the objectives the smaller": (
        lambda x, a, clip: -clipped_surrogate(x, -a, clip)
    ),
    "only the clipped ratio counts, so what went the wrong way has no gradient": (
        lambda x, a, clip: -(x.exp().clamp(1 - clip, 1 + clip) * a).mean()
    ),
    "nothing is clipped": lambda x, a, clip: maths.surrogate(x, a),
    "the sum in place of the mean": lambda x, a, clip: clipped_surrogate(x, a, clip) * len(x),
}
"""mistakes of (log ratio [B], advantage [B], ε)"""
RATIO: dict[str, Function] = {
    "the ratio is exp of the difference of log-probabilities": (
        lambda x, a, clip: -torch.min(x * a, x.clamp(1 - clip, 1 + clip) * a).mean()
    ),
    "the ratio is upside down: π_old / π": lambda x, a, clip: clipped_surrogate(-x, a, clip),
}
"""more of them, where the ratio is to be computed too"""


def _clipped_value_alone(v: Tensor, target: Tensor, old: Any = None, clip: float | None = None) -> Tensor:
    return value_loss(v if clip is None else old + (v - old).clamp(-clip, clip), target)


def _smaller_error(v: Tensor, target: Tensor, old: Any = None, clip: float | None = None) -> Tensor:
    near = v if clip is None else old + (v - old).clamp(-clip, clip)
    return 0.5 * torch.min((v - target).square(), (near - target).square()).mean()


VALUE_LOSS: dict[str, Function] = {
    "the conventional half is missing": lambda *a: 2 * value_loss(*a),
    "the sum in place of the mean": lambda v, *a: value_loss(v, *a) * len(v),
    "the error is not squared": lambda v, target, *_: 0.5 * (v - target).abs().mean(),
    "the clip is left out": lambda v, target, *_: value_loss(v, target),
    "only the clipped value counts": _clipped_value_alone,
    "the smaller of the two errors is taken": _smaller_error,
}
"""mistakes of (V [B], target [B], old V [B], ε); the last two may be absent or None"""


def _pg_loss(function: Function) -> Function:
    """`clipped_surrogate` in the form of the drone's course, where the ratio is given."""
    return lambda mb_advantages, ratio, clip_coef: function(ratio.log(), mb_advantages, clip_coef)


def _v_loss(function: Function) -> Function:
    """`value_loss` in the form of the drone's course: `new` is of the rows `mb_inds` of the batch."""

    def calculate_v_loss(
        new: Tensor, b_returns: Tensor, b_values: Tensor, mb_inds: Tensor, if_clip: bool, clip_coef: float
    ) -> Tensor:
        return function(new, b_returns[mb_inds], *((b_values[mb_inds], clip_coef) if if_clip else ()))

    return calculate_v_loss


def _first_rows(new: Tensor, returns: Tensor, old: Tensor, rows: Tensor, if_clip: bool, clip_coef: float) -> Tensor:
    return _v_loss(value_loss)(new, returns, old, torch.arange(len(new)), if_clip, clip_coef)


def _mean_square(v: Tensor, target: Tensor) -> Tensor:
    return (v - target).square().mean()


def _lander_losses(actor: Function = clipped_surrogate, critic: Function = _mean_square) -> Function:
    """Both losses in the form of the lander's course; its critic's has no half."""

    def compute_loss(
        self: Any, states: Tensor, actions: Tensor, advantages: Tensor, targets: Tensor, old: Tensor
    ) -> Any:
        log_ratio = self.compute_log_probs(states, actions) - old
        return actor(log_ratio, advantages, self.epsilon), critic(self.compute_values(states), targets)

    return compute_loss


FOUR_VALUES = (torch.tensor([2.5, 1.5, 3.0, 4.5]), torch.tensor([3.0, 1, 2, 5]), torch.tensor([2.0, 1, 2.5, 4]))
SHUFFLED = (_drawn(3), _drawn(6), _drawn(6) + 0.4, torch.tensor([4, 1, 5]))
EIGHT = (
    _drawn(8, 3),
    torch.tensor([0, 1, 1, 0, 0, 1, 0, 1]),
    _drawn(8),
    _drawn(8, seed=1),
    _drawn(8, seed=2) / 4 - 0.7,
)
CLIP_COEF = {"clip_coef": 0.2}

LOSSES: dict[str, Exercise] = {
    "policy_gradient": Exercise(
        maths.policy_gradient,
        ("loss",),
        [Case("eight actions", (_drawn(8), _drawn(8) + 0.5))],
        {
            "the sign: optimizers descend": lambda log_prob, weight: -maths.policy_gradient(log_prob, weight),
            "the sum in place of the mean": lambda log_prob, weight: -(log_prob * weight).sum(),
            "π in place of log π": lambda log_prob, weight: maths.policy_gradient(log_prob.exp(), weight),
        },
        gradient_in=0,
    ),
    "clipped_surrogate": Exercise(
        clipped_surrogate,
        ("loss",),
        [
            Case("ratios of one", (torch.zeros(4), torch.tensor([1.0, 2.0, -1.0, 0.5])), {"clip": 0.2}),
            Case("good actions", (torch.tensor([-0.5, -0.1, 0.1, 0.5]), torch.ones(4)), {"clip": 0.2}),
            Case("bad actions", (torch.tensor([-0.5, -0.1, 0.1, 0.5]), -torch.ones(4)), {"clip": 0.2}),
            Case("of all kinds", (_drawn(12) / 3, _drawn(12).flip(0)), {"clip": 0.1}),
        ],
        CLIPPED | RATIO,
        gradient_in=0,
    ),
    "calculate_pg_loss": Exercise(
        _pg_loss(clipped_surrogate),
        ("pg_loss",),
        [
            Case("the course's", (torch.tensor([1, 0.5, -1, -0.5]), torch.tensor([1.1, 1.3, 0.7, 0.9])), CLIP_COEF),
            Case("of all kinds", (_drawn(12), (_drawn(12, seed=1) / 3).exp()), {"clip_coef": 0.1}),
        ],
        {
            **{words: _pg_loss(wrong) for words, wrong in CLIPPED.items()},
            "the ratio is taken for its logarithm": lambda a, r, clip_coef: clipped_surrogate(r, a, clip_coef),
        },
        gradient_in=1,
    ),
    "compute_loss": Exercise(
        _lander_losses(),
        ("actor_loss", "critic_loss"),
        [
            Case(
                "eight actions",
                EIGHT,
                {"epsilon": 0.2, "compute_log_probs": _log_probs, "compute_values": _values},
                NETWORKS,
            )
        ],
        {
            **{f"in the actor's loss, {words}": _lander_losses(wrong) for words, wrong in (CLIPPED | RATIO).items()},
            "a half before the critic's loss, which this course has not": _lander_losses(critic=value_loss),
            "the critic's error is not squared": _lander_losses(critic=lambda v, target: (v - target).abs().mean()),
        },
        gradient_in=0,
    ),
    "value_loss": Exercise(
        value_loss,
        ("loss",),
        [
            Case("without a clip", (_drawn(6), _drawn(6) + 1)),
            Case("with a clip", (_drawn(8), _drawn(8).flip(0), _drawn(8) + 0.3, 0.2)),
            Case("with an old value, and None for the clip", (_drawn(8), _drawn(8).flip(0), _drawn(8) + 0.3, None)),
        ],
        VALUE_LOSS,
        gradient_in=0,
    ),
    "calculate_v_loss": Exercise(
        _v_loss(value_loss),
        ("v_loss",),
        [
            Case("without a clip", (*FOUR_VALUES, torch.arange(4), False), CLIP_COEF),
            Case("with a clip", (*FOUR_VALUES, torch.arange(4), True), CLIP_COEF),
            Case("rows of a larger batch", (*SHUFFLED, False), CLIP_COEF),
            Case("rows of a larger batch, with a clip", (*SHUFFLED, True), CLIP_COEF),
        ],
        {
            **{words: _v_loss(wrong) for words, wrong in VALUE_LOSS.items()},
            "the rows mb_inds of b_returns and b_values are not chosen": _first_rows,
        },
        gradient_in=0,
    ),
}

# --- the rest ---


def select_at_index(x: Tensor, indices: Tensor) -> Tensor:
    """x[i, indices[i]] for each row i, [B]."""
    return x.gather(-1, indices[:, None])[:, 0]


EXERCISES: dict[str, Exercise] = {
    **ADVANTAGES,
    **LOSSES,
    "polyak": Exercise(
        maths.polyak,
        ("target[0]", "target[1]", "online[0]", "online[1]"),
        [Case("two tensors", ([_drawn(3), _drawn(2, 2)], [_drawn(3) + 1, _drawn(2, 2) - 1], 0.1))],
        {
            "the target is to be changed in place": lambda target, online, tau: None,
            "τ and 1 − τ are exchanged": lambda target, online, tau: maths.polyak(target, online, 1 - tau),
            "the online network is moved, not the target": lambda target, online, tau: maths.polyak(
                online, target, tau
            ),
        },
        in_place=True,
    ),
    "select_at_index": Exercise(
        select_at_index,
        ("result",),
        [Case("three rows of four", (_drawn(3, 4), torch.tensor([2, 0, 3])))],
        {
            "the numbers are taken from one row": lambda x, indices: x[0, indices],
            "it counts from the end": lambda x, indices: x.flip(1).gather(1, indices[:, None])[:, 0],
        },
    ),
}
