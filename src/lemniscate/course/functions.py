"""Functions to write, each with its cases; their well-known mistakes stand in `templates/mistakes.toml`.

The reference of an exercise is a function of `lemniscate.maths`, or one here that gives such a function the form of a
course: a method, with other names, another layout or other outputs. A mistake is an edit of their text.
"""

import inspect
import tomllib
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from lemniscate import maths
from lemniscate.course.exercise import TEMPLATES, Case, Exercise, normalised  # noqa: F401  (an edit may call it)
from lemniscate.course.solution import Function, Settings
from lemniscate.maths import clipped_surrogate, gae, q_lambda, reward_to_go, value_loss

# --- the forms of the courses ---


def calculate_advantages(self: Any, next_value: Tensor) -> tuple[Tensor, Tensor]:
    """(returns, advantages), each [T, N]; `terminated_buffer[t]` is 1 where action t ended the episode."""
    ended = self.terminated_buffer.bool()
    following = torch.cat([self.values_buffer[1:], next_value.reshape(1, -1)])
    rows = (self.rewards_buffer, self.values_buffer, following, ended, ended)
    advantages, returns = gae(*rows, gamma=self.config.gamma, lam=self.config.gae_lambda)
    return returns, advantages


def compute_advantages(self: Any, states: Tensor, rewards: Tensor, next_states: Tensor, ended: Tensor) -> Any:
    """(advantages, critic targets), each [N · T]: one environment after the other."""
    columns = (rewards, self.compute_values(states), self.compute_values(next_states), ended, ended)
    by_time = [column.reshape(-1, self.num_steps).T for column in columns]
    both = gae(*by_time, gamma=self.gamma, lam=self.lmbda)
    advantages, targets = (out.T.reshape(-1).detach() for out in both)
    return advantages, targets


def discounted_returns(rewards: Tensor, *, gamma: float) -> Tensor:
    """Σ_k γ^(k−t) r_k over k ≥ t, [T], of one whole episode."""
    never = torch.zeros(len(rewards), 1, dtype=torch.bool)
    return reward_to_go(rewards[:, None], torch.zeros(len(rewards), 1), never, never, gamma=gamma)[:, 0]


def calculate_pg_loss(mb_advantages: Tensor, ratio: Tensor, clip_coef: float) -> Tensor:
    """`clipped_surrogate` of a ratio that is given."""
    return clipped_surrogate(ratio.log(), mb_advantages, clip_coef)


def calculate_v_loss(
    newvalue: Tensor, b_returns: Tensor, b_values: Tensor, mb_inds: Tensor, if_clip: bool, clip_coef: float
) -> Tensor:
    """`value_loss`, where `newvalue` is of the rows `mb_inds` of the batch."""
    old_value, clip = (b_values[mb_inds], clip_coef) if if_clip else (None, None)
    return value_loss(newvalue, b_returns[mb_inds], old_value, clip)


def compute_loss(self: Any, states: Tensor, actions: Tensor, advantages: Tensor, targets: Tensor, old: Tensor) -> Any:
    """(actor's loss, critic's loss); that of the critic has no half."""
    log_ratio = self.compute_log_probs(states, actions) - old
    error = self.compute_values(states) - targets
    return clipped_surrogate(log_ratio, advantages, self.epsilon), error.square().mean()


def select_at_index(x: Tensor, indices: Tensor) -> Tensor:
    """x[i, indices[i]] for each row i, [B]."""
    return x.gather(-1, indices[:, None])[:, 0]


# --- what the cases are made of ---


def _drawn(*shape: int, seed: int = 0) -> Tensor:
    """Normal numbers, the same each time."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(sum(shape) + 100 * seed))


def _late(flags: Tensor) -> Tensor:
    """The flag of row t + 1 in row t, and that of the last row there too."""
    return torch.cat([flags[1:], flags[-1:]])


def _early(flags: Tensor) -> Tensor:
    """The flag of row t − 1 in row t, and none in the first."""
    return torch.cat([torch.zeros_like(flags[:1]), flags[:-1]])


def _sums(reward: Tensor, done: Tensor, gamma: float) -> Tensor:
    """The discounted rewards of each episode from row t on."""
    sums, follows = torch.zeros_like(gamma * reward), 0.0 * reward[0]
    for t in reversed(range(len(reward))):
        sums[t] = follows = reward[t] + gamma * follows * ~done[t]
    return sums


def _entropy(scores: Tensor) -> Tensor:
    return torch.distributions.Categorical(logits=scores).entropy().mean()


def _column(*numbers: float) -> Tensor:
    return torch.tensor(numbers)[:, None]


def _following(values: Tensor, done: Tensor, own: Tensor) -> Tensor:
    """V(s'): that of the next row, but at an end and in the last row its own."""
    following = torch.cat([values[1:], own[-1:]])
    return torch.where(done, own, following)


R, V = _column(1.0, -0.5, 2.0, 0.5), _column(0.3, 1.2, -0.4, 0.8)
"""reward and V(s) of four steps of one environment"""
NEVER, AT_1, AT_3 = _column(0, 0, 0, 0).bool(), _column(0, 1, 0, 0).bool(), _column(0, 0, 0, 1).bool()
N, N_1 = (_following(V, done, _column(0.9, -0.7, 0.6, 1.5)) for done in (NEVER, AT_1))
"""V(s') where no episode ends at row 1, and where one does"""
TWO_R, TWO_V = _drawn(5, 2), _drawn(2, 5).T.contiguous()
TWO_ENDS = torch.tensor([[0, 0], [1, 0], [0, 0], [0, 1], [0, 0]]).bool()
"""a death in each of two environments"""
TWO_DONE = TWO_ENDS | torch.tensor([[0, 1], [0, 0], [0, 0], [0, 0], [1, 0]]).bool()
"""the deaths, and a time-out in each of the two environments"""
TWO_N = _following(TWO_V, TWO_DONE, TWO_V + 1)
GAMMA, DISCOUNTS, CLIP, CLIP_COEF = {"gamma": 0.9}, {"gamma": 0.9, "lam": 0.8}, {"clip": 0.2}, {"clip_coef": 0.2}
OTHERS = {"gamma": 0.7, "lam": 0.6}
"""for one case of each exercise: a solution may have a number of its own in the place of the argument"""

TRAIN_CONFIG = Settings(
    {
        "n_envs": 4,
        "n_eval_envs": 2,
        "n_eval_steps": 10,
        "eval_interval": 1000,
        "total_timesteps": 1000,
        "seed": 0,
        "n_steps": 16,
        "n_minibatches": 4,
        "n_epochs": 2,
        "learning_rate": 1.5e-3,
        "lr_decay": True,
        "target_kl": None,
        "device": "cpu",
        "norm_adv": True,
        "clip_vloss": True,
        "ent_coef": 0.01,
        "vf_coef": 0.5,
        "max_grad_norm": 5.0,
        "gamma": 0.9,
        "gae_lambda": 0.95,
        "clip_coef": 0.25,
        "save_model": False,
        "wandb_log": False,
    }
)
"""the configuration of the drone's course, with fewer environments"""
TRAINER = {"config": TRAIN_CONFIG}
FOUR = (torch.ones(4, 1), _column(0.5, 0.6, 0.7, 0.8))
"""rewards and V(s) of the drone's course"""
FOUR_VALUES = (torch.tensor([2.5, 1.5, 3.0, 4.5]), torch.tensor([3.0, 1, 2, 5]), torch.tensor([2.0, 1, 2.5, 4]))
OLD = _drawn(12) + 0.6 * _drawn(12, seed=1)
"""values at collection, some within 0.2 of those now, some beyond on either side"""
INDS = torch.tensor([4, 1, 13, 5, 0, 7, 11, 9, 2, 14, 8, 3])
SHUFFLED = (_drawn(12), _drawn(15, seed=2), torch.zeros(15).index_put((INDS,), OLD), INDS)


def _drone_case(about: str, *given: Tensor, done: Tensor | None = None, discounts: tuple = (0.99, 0.95)) -> Case:
    """Given are next_value, rewards, values and flags of deaths; those of all ends where there are others."""
    next_value, rewards, values, ended = given
    done = (ended if done is None else done).float()
    held = {"rewards_buffer": rewards, "values_buffer": values, "terminated_buffer": ended.float()}
    held |= {"n_steps": len(rewards), "gamma": discounts[0], "gae_lambda": discounts[1]}
    more = {"dones_buffer": done, "truncated_buffer": done - ended.float(), "n_envs": rewards.shape[1]}
    return Case(about, (next_value,), held, TRAINER | more)


def _values(states: Tensor) -> Tensor:
    return NETWORKS["critic"](states)[:, 0]


def _log_probs(states: Tensor, actions: Tensor) -> Tensor:
    return NETWORKS["actor"](states).log_softmax(1).gather(1, actions[:, None])[:, 0]


def _layer(columns: Tensor) -> nn.Linear:
    """A layer without bias, of these columns."""
    made = nn.Linear(*columns.shape, bias=False)
    made.weight.data.copy_(columns.T)
    return made


ACTOR = _layer(torch.tensor([[1.0, 0.0], [-1.0, 0.5], [0.5, 1.0]]))
NETWORKS = {"actor": ACTOR, "critic": _layer(_column(0.5, -1.0, 0.25))}


def _lander_case(about: str, num_envs: int, steps: int, *ends: int, gamma: float = 0.9) -> Case:
    rows = num_envs * steps
    ended = torch.tensor([row in ends for row in range(rows)])
    held = {"gamma": gamma, "lmbda": 0.8, "num_steps": steps, "compute_values": _values}
    states, last = _drawn(rows, 3), torch.arange(1, rows + 1) % steps == 0
    following = torch.where((ended | last)[:, None], _drawn(rows, 3, seed=1), states.roll(-1, 0))
    return Case(about, (states, _drawn(rows), following, ended), held, NETWORKS)


def _of_tails(options: dict[str, float]) -> list[Case]:
    others = {name: OTHERS[name] for name in options}
    return [
        Case("no end", (R, N, NEVER, NEVER), options),
        Case("a death at row 1", (R, N, AT_1, AT_1), options),
        Case("a time-out at row 1", (R, N, NEVER, AT_1), options),
        Case("two environments, ends of both kinds", (TWO_R, TWO_V + 1, TWO_ENDS, TWO_DONE), others),
    ]


ROWS, MANY = _drawn(24, 3), torch.arange(24) % 2
"""states and actions of the lander"""
OLD_LOG_PROBS = _log_probs(ROWS, MANY).detach() + _drawn(24, seed=2) / 2
LANDER = {"epsilon": 0.2, "compute_log_probs": _log_probs, "compute_values": _values}

CASES: dict[str, list[Case]] = {
    "gae": [
        Case("no end", (R, V, N, NEVER, NEVER), DISCOUNTS),
        Case("a death at the last row", (R, V, N, AT_3, AT_3), DISCOUNTS),
        Case("a death at row 1", (R, V, N_1, AT_1, AT_1), DISCOUNTS),
        Case("a time-out at row 1", (R, V, N_1, NEVER, AT_1), DISCOUNTS),
        Case("two environments, ends of both kinds", (TWO_R, TWO_V, TWO_N, TWO_ENDS, TWO_DONE), OTHERS),
    ],
    "calculate_advantages": [
        _drone_case("no end", _column(0.9), *FOUR, NEVER),
        _drone_case("a death at the last row", _column(0.0), *FOUR, AT_3),
        _drone_case(
            "two environments", _drawn(1, 2), _drawn(5, 2), _drawn(5, 2, seed=1), TWO_ENDS, discounts=(0.9, 0.8)
        ),
        _drone_case("a time-out, which the loop does not look at", _column(0.9), *FOUR, NEVER, done=AT_1),
    ],
    "compute_advantages": [
        _lander_case("one step of three environments", 3, 1, 1),
        _lander_case("four steps of one environment", 1, 4),
        _lander_case("a death in between", 1, 4, 1),
        _lander_case("two environments of three steps", 2, 3),
        _lander_case("two environments, a death at a border", 2, 3, 2, 4, gamma=0.7),
    ],
    "reward_to_go": _of_tails(GAMMA),
    "q_lambda": _of_tails(DISCOUNTS),
    "discounted_returns": [
        Case("one step", (torch.tensor([2.0]),), GAMMA),
        Case("five steps", (_drawn(5) + 1,), {"gamma": 0.7}),
    ],
    "td_target": [
        Case("nothing ends", (_drawn(6), _drawn(6) + 1, torch.zeros(6).bool()), GAMMA),
        Case("some end", (_drawn(6), _drawn(6) + 1, torch.tensor([0, 1, 0, 0, 1, 1]).bool()), GAMMA),
        Case("two critics", (_drawn(6), _drawn(2, 6) + 1, torch.tensor([0, 1, 0, 0, 1, 1]).bool()), {"gamma": 0.8}),
    ],
    "policy_gradient": [Case("eight actions", (_drawn(8), _drawn(8, seed=1) + 0.5))],
    "clipped_surrogate": [
        Case("ratios of one", (torch.zeros(4), torch.tensor([1.0, 2.0, -1.0, 0.5])), CLIP),
        Case("good actions", (torch.tensor([-0.5, -0.1, 0.1, 0.5]), torch.ones(4)), CLIP),
        Case("bad actions", (torch.tensor([-0.5, -0.1, 0.1, 0.5, 1.5]), -torch.ones(5)), CLIP),
        Case("of all kinds", (_drawn(12) / 3, _drawn(12).flip(0)), {"clip": 0.1}),
        Case("one row", (torch.tensor([0.05]), torch.tensor([1.5])), {"clip": 0.2}),
    ],
    "calculate_pg_loss": [
        Case(
            "the course's", (torch.tensor([1, 0.5, -1, -0.5]), torch.tensor([1.1, 1.3, 0.7, 0.9])), CLIP_COEF, TRAINER
        ),
        Case("of all kinds", (_drawn(12), (_drawn(12, seed=1) / 3).exp()), {"clip_coef": 0.1}, TRAINER),
    ],
    "compute_loss": [
        Case("many actions", (ROWS, MANY, _drawn(24), _drawn(24, seed=1), OLD_LOG_PROBS), LANDER, NETWORKS),
        Case(
            "one action",
            (ROWS[:1], MANY[:1], _drawn(1), _drawn(1, seed=1), OLD_LOG_PROBS[:1]),
            LANDER | {"epsilon": 0.1},
            NETWORKS,
        ),
    ],
    "value_loss": [
        Case("without a clip", (_drawn(6), _drawn(6) + 1)),
        Case("with a clip", (_drawn(12), _drawn(12, seed=2), OLD, 0.2)),
        Case("with an old value, and None for the clip", (_drawn(12), _drawn(12, seed=2), OLD, None)),
        Case("with another clip", (_drawn(12), _drawn(12, seed=2), OLD, 0.3)),
    ],
    "calculate_v_loss": [
        Case("without a clip", (*FOUR_VALUES, torch.arange(4), False), CLIP_COEF, TRAINER),
        Case("with a clip", (*FOUR_VALUES, torch.arange(4), True), CLIP_COEF, TRAINER),
        Case("rows of a larger batch", (*SHUFFLED, False), CLIP_COEF, TRAINER),
        Case("rows of a larger batch, with a clip", (*SHUFFLED, True), CLIP_COEF, TRAINER),
        Case("with another clip", (*SHUFFLED, True), {"clip_coef": 0.3}, TRAINER),
    ],
    "polyak": [
        Case(
            "three tensors",
            ([_drawn(3), _drawn(2, 2), _drawn(2)], [_drawn(3) + 1, _drawn(2, 2) - 1, _drawn(2) / 2], 0.1),
        ),
        Case("another τ", ([_drawn(3), _drawn(2, 2), _drawn(2)], [_drawn(3) - 1, _drawn(2, 2), _drawn(2) + 1], 0.25)),
    ],
    "select_at_index": [
        Case("three rows of four", (_drawn(3, 4), torch.tensor([2, 0, 3]))),
        Case("one row", (_drawn(1, 4), torch.tensor([2]))),
    ],
}

# --- the mistakes ---

_source = cache(inspect.getsource)
"""the text of a function, which several mistakes edit"""
TABLES: dict[str, dict[str, Any]] = tomllib.loads((TEMPLATES / "mistakes.toml").read_text("utf-8"))


def edited(functions: Sequence[Function], edits: Sequence[str]) -> Function:
    """The last of some functions, each of which may call those before it, when their text is edited.

    Args:
        functions: as Python has their source.
        edits: old, new, old, new, …: texts that stand there, and what stands there instead.

    Raises:
        ValueError: an old text does not stand there.
    """
    originals = [inspect.unwrap(function) for function in functions]
    text = "\n".join(map(_source, originals))
    for old, new in zip(edits[::2], edits[1::2], strict=True):
        if old not in text:
            raise ValueError(f"mistakes.toml: {originals[-1].__name__} has no {old!r} to be replaced")
        text = text.replace(old, new)
    names = dict(globals())  # an edit may call what stands in this file, such as `_late`
    for original in originals:
        names |= original.__globals__
    exec(compile(text, f"<{originals[-1].__name__} with a mistake>", "exec"), names)
    return names[originals[-1].__name__]


def _exercise(*functions: Function, outputs: tuple[str, ...], **options: Any) -> Exercise:
    """The exercise whose reference is the last of these functions, each of which may call those before it."""
    name = functions[-1].__name__
    edits = {
        before + words: pairs
        for shared, before in {**TABLES[name].get("extends", {}), name: ""}.items()
        for words, pairs in TABLES[shared].items()
        if words != "extends"
    }
    mistakes, accepted = (
        {words: edited(functions, pairs) for words, pairs in table.items()}
        for table in (edits, TABLES["accepted"].get(name, {}))
    )
    return Exercise(functions[-1], outputs, CASES[name], mistakes, accepted, **options)


EXERCISES: dict[str, Exercise] = {
    "gae": _exercise(gae, outputs=("advantage", "target")),
    "calculate_advantages": _exercise(gae, calculate_advantages, outputs=("returns", "advantages")),
    "compute_advantages": _exercise(gae, compute_advantages, outputs=("advantages", "critic_targets"), detached=True),
    "reward_to_go": _exercise(reward_to_go, outputs=("return",)),
    "q_lambda": _exercise(q_lambda, outputs=("target",)),
    "discounted_returns": _exercise(reward_to_go, discounted_returns, outputs=("returns",)),
    "td_target": _exercise(maths.td_target, outputs=("target",)),
    "policy_gradient": _exercise(maths.policy_gradient, outputs=("loss",), gradient_in=0, value_is_free=True),
    "clipped_surrogate": _exercise(clipped_surrogate, outputs=("loss",), gradient_in=0),
    "calculate_pg_loss": _exercise(clipped_surrogate, calculate_pg_loss, outputs=("pg_loss",), gradient_in=1),
    "compute_loss": _exercise(clipped_surrogate, compute_loss, outputs=("actor_loss", "critic_loss"), gradient_in=0),
    "value_loss": _exercise(value_loss, outputs=("loss",), gradient_in=0),
    "calculate_v_loss": _exercise(value_loss, calculate_v_loss, outputs=("v_loss",), gradient_in=0),
    "polyak": _exercise(
        maths.polyak,
        outputs=tuple(f"{network}[{i}]" for network in ("target", "online") for i in range(3)),
    ),
    "select_at_index": _exercise(select_at_index, outputs=("result",), gradient_in=0),
}
