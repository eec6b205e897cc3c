"""The inside of a training loop: its networks, gradients and optimizer steps while it runs, against PPO's equations.

`watched` runs a loop on a probe, an environment in which every observation is unique, so that each row that a network
sees is that of a known step. PyTorch's global hooks show the outputs of the last layers and the gradients of the loss L
in them, whatever the loop looks like. For row i of a minibatch, before its step:

    ∂L/∂logits_i = c_i (onehot(a_i) − π_i) − β ∂H/∂logits_i      π = softmax(logits), H its entropy
    c_i = −κ r_i A'_i, and 0 where the clip acts                 arXiv:1707.06347, eq. 7; r = π/π_old, A' = A − m, κ > 0
    ∂L/∂V_i = k (V_i − target_i), k > 0                          before the first step

A and the target are linear in the rewards and the values, so κ, m and k follow by least squares; γ and λ are those that
fit best, m is 0 or a mean, and the clip's edges are where c becomes 0. `judged` says only what is certain: a wrong form
is named where it fits to the precision of float32 and the right one does not. What is not understood is no finding.
"""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_hook, register_module_forward_pre_hook
from torch.optim.optimizer import register_optimizer_step_pre_hook

from lemniscate.course.exercise import TEMPLATES
from lemniscate.course.functions import EXERCISES, edited
from lemniscate.envs.vector_view import VectorView, make_vec
from lemniscate.maths import clipped_surrogate, gae

OBS, ACTIONS, NUM_ENVS = 8, 4, 8
MOST = {"updates": 4, "gradients": 1_000, "rows": 200_000, "steps": 4_096}
"""how much is watched; what is reached first ends it"""
FITS, FAILS = 1e-3, 2e-2
"""relative residuals: the right form is below the first, the others are above the second"""
SETTINGS = {"gamma": "gamma|discount(_factor)?", "lam": "(gae_?)?(lam|lambda_?|lambd|lmbda|lamda)"}
TEXT = tomllib.loads((TEMPLATES / "inside.toml").read_text("utf-8"))
SAYS = TEXT["says"]
RIGHT = edited([gae], [])  # the copy takes one more dimension, that of pairs of γ and λ
FORMS = {"": RIGHT, **EXERCISES["gae"].mistakes, **{words: edited([gae], it) for words, it in TEXT["gae"].items()}}
OBJECTIVES = {words: edited([clipped_surrogate], it) for words, it in TEXT["objective"].items()}


class Enough(BaseException):
    """The probe has seen what it needs; an `except Exception` of the loop does not keep it."""


class UnclearError(Exception):
    """Something is not understood: no finding, and no proof."""


class ProbeEnv(gym.Env):
    """Random observations; the best action is the place of the largest of the first numbers; random ends."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (OBS,), np.float32)
    action_space = gym.spaces.Discrete(ACTIONS)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """A random observation."""
        super().reset(seed=seed)
        self._obs = self.np_random.normal(size=OBS).astype(np.float32)
        return self._obs, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """A death or a time-out after a tenth of the steps each."""
        reward = 2.0 * (int(action) == self._obs[:ACTIONS].argmax()) + self.np_random.normal() / 2
        self._obs, end = self.np_random.normal(size=OBS).astype(np.float32), self.np_random.random()
        return self._obs, reward, end < 0.1, 0.1 <= end < 0.2, {}


class Probe(VectorView):
    """The environments, a note of each step, and what the hooks see until it is enough.

    `events`, in their order: {t, rows [M], out [M, K], grad [M, K], own} for a pass through a last layer, t steps of
    the environments before it, of the observations `rows`, with the gradient if there was one; {t, taken} for a step of
    an optimizer, with the gradient [K · H] of the weight of each last layer, by K; `own` is a pass's part of it.
    """

    def __init__(self) -> None:
        super().__init__(make_vec(ProbeEnv, NUM_ENVS).env)
        self.numbers: dict[bytes, int] = {}  # of each observation
        self.steps: list[dict[str, Tensor]] = []
        self.restarts: set[int] = set()  # the numbers of steps before each reset
        self.events: list[dict[str, Any]] = []
        self.counts = dict.fromkeys(MOST, 0)
        self.layers: dict[nn.Linear, tuple[int, Tensor]] = {}  # K if it is a last one, 0 if not, and its first weight
        self.moved: set[int] = set()  # ids of parameters that an optimizer steps on
        self.reached: set[int] = set()  # ids of weights that have had a gradient at such a step
        self.known = torch.zeros(0).long()  # the observations that went into a module last

    def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """That of `VectorView`, noted."""
        obs, info = super().reset(**options)
        self.obs = self._numbered(obs)
        self.restarts.add(len(self.steps))
        return obs, info

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """That of `VectorView`, noted."""
        self._count("steps", *MOST)
        obs, reward, terminated, truncated, info = super().step(actions)
        last, done = obs.copy(), terminated | truncated
        for i in np.flatnonzero(done):
            last[i] = info["final_obs"][i]
        noted = {"action": np.array(actions), "reward": reward, "terminated": terminated, "done": done}
        step = {"obs": self.obs} | {name: torch.tensor(part) for name, part in noted.items()}
        self.obs = self._numbered(obs)
        self.steps.append(step | {"next": self._numbered(last), "following": self.obs})
        return obs, reward, terminated, truncated, info

    def _numbered(self, obs: np.ndarray) -> Tensor:
        return torch.tensor([self.numbers.setdefault(row.tobytes(), len(self.numbers)) for row in obs])

    def _count(self, name: str, *limited: str, more: int = 1) -> None:
        if any(self.counts[each] >= MOST[each] for each in limited):
            raise Enough
        self.counts[name] += more

    def enter(self, module: nn.Module, inputs: tuple[Any, ...]) -> None:
        """Before a module: is its input a batch of the observations?"""
        self._count("rows", "gradients", "rows", more=0)  # in the middle of an update too, which may be long
        with suppress(Exception):  # what cannot be read is not understood; it is no fault of the loop
            x = inputs[0].detach()
            if x.shape[-1] == OBS:
                found = [self.numbers.get(row.tobytes(), -1) for row in x.reshape(-1, OBS).float().numpy()]
                self.known = torch.tensor(found if min(found) >= 0 else []).long()

    def leave(self, module: nn.Module, inputs: tuple[Any, ...], out: Any) -> None:
        """After a module: is it a last layer, of the logits or of V?"""
        with suppress(Exception):
            size, before = out.shape[-1], inputs[0].shape[-1]
            is_last = size in (1, ACTIONS) and before != size and out.numel() == size * len(self.known)
            if isinstance(module, nn.Linear) and (is_last or out.requires_grad):
                self.layers.setdefault(module, (size * is_last, module.weight.detach().clone()))
            if is_last and next(module.children(), None) is None:
                event = {"t": len(self.steps), "rows": self.known, "out": out.detach().reshape(-1, size).clone()}
                self.events.append(event)
                if out.requires_grad:
                    x = inputs[0].detach().reshape(-1, before)
                    out.register_hook(lambda grad: self._add(event, grad.detach().reshape(-1, size), x))

    def _add(self, event: dict[str, Any], grad: Tensor, x: Tensor) -> None:
        event["grad"] = grad + event.get("grad", 0)
        event["own"] = (grad.T @ x).flatten().double() + event.get("own", 0)
        self._count("gradients")
        self._count("rows", more=len(grad))

    def optimize(self, optimizer: torch.optim.Optimizer, *_: Any) -> None:
        """Before a step of an optimizer."""
        with suppress(Exception):
            event: dict[str, Any] = {"t": len(self.steps), "taken": {}}
            mine = {id(p) for group in optimizer.param_groups for p in group["params"]}
            for layer, (size, _was) in self.layers.items():
                if size and id(layer.weight) in mine and layer.weight.grad is not None:
                    event["taken"][size] = layer.weight.grad.detach().flatten().double()
            self.moved |= mine
            self.reached |= {id(layer.weight) for layer in self.layers if layer.weight.grad is not None}
            self.counts["updates"] += not any("out" not in e and e["t"] == event["t"] for e in self.events[-99:])
            self.events.append(event)

    def noted(self) -> dict[str, Any]:
        """The notes, in plain tensors and numbers.

        `steps` in columns [S, N]; `events`; `restarts`, the numbers of steps before each reset; and `stays`, of linear
        layers: K, whether the weight stays as it was, and whether it has had a gradient, but no optimizer that
        made a step has it.
        """
        stays = [
            (k, layer.weight.equal(was), id(layer.weight) in self.reached and id(layer.weight) not in self.moved)
            for layer, (k, was) in self.layers.items()
        ]
        columns = {name: torch.stack([step[name] for step in self.steps]) for name in (self.steps or [{}])[0]}
        return {"steps": columns, "events": self.events, "stays": stays, "restarts": sorted(self.restarts)}


def watched(start: Callable[[VectorView], Any], names: Mapping[str, Any]) -> dict[str, Any]:
    """The notes on a training loop on the probe (`Probe.noted`); the loop is stopped when they are enough.

    Args:
        start: starts the loop.
        names: those of its file and of its defaults, in which γ and λ may stand.
    """
    probe = Probe()
    with ExitStack() as stack:
        stack.callback(probe.close)
        stack.enter_context(register_module_forward_pre_hook(probe.enter))
        stack.enter_context(register_module_forward_hook(probe.leave))
        stack.callback(register_optimizer_step_pre_hook(probe.optimize).remove)
        with suppress(Enough, Exception):  # what the loop raises, it raises again in the next environment
            start(probe)
    holders = [names, *(each if isinstance(each, dict) else getattr(each, "__dict__", {}) for each in names.values())]
    pairs = [(str(name).lower(), value) for holder in holders for name, value in list(holder.items())]
    settings = {
        name: sorted(
            {float(value) for word, value in pairs if re.fullmatch(words, word) and type(value) in (int, float)}
        )
        for name, words in SETTINGS.items()
    }
    return probe.noted() | {"settings": settings}


# --- the updates ---


class Step(NamedTuple):
    """A minibatch: rows [M] of the update, and what the hooks saw of the logits, [M, K], or of V, [M, 1]."""

    rows: Tensor
    out: Tensor
    grad: Tensor
    latest: Tensor
    """what these rows had last without a gradient"""


class Update(NamedTuple):
    """The steps of optimizers between two steps of the environments, on the T · N rows before them."""

    env: dict[str, Tensor]
    """columns [T, N]: those of the probe; value, next_value and following_value of the first weights"""
    logits: Tensor
    """[T · N, K] of the first weights"""
    policy: list[Step]
    critic: list[Step]
    places: tuple[int, int]
    """where these rows begin among all since the last update, and how many those are"""


def grouped(events: list[dict[str, Any]]) -> dict[int, list[list[dict[str, Any]]]]:
    """By t, the passes before each step of an optimizer that has new gradients."""
    groups: dict[int, list[list[dict[str, Any]]]] = {}
    passes: list[dict[str, Any]] = []
    for event in events:
        if "out" in event:
            passes.append(event)
        elif any("grad" in one for one in passes):
            groups.setdefault(event["t"], []).append(passes)
            passes = []
    return groups


def updates(seen: Mapping[str, Any]) -> Iterator[Update]:
    """The updates that are understood: of rows since the last one, each with one output before the first step."""
    start = 0
    for end, segments in grouped(seen["events"]).items():
        with suppress(UnclearError):
            yield _update({name: column[start:end] for name, column in seen["steps"].items()}, segments)
        start = end


def _update(env: dict[str, Tensor], segments: list[list[dict[str, Any]]]) -> Update:
    graded = torch.cat([one["rows"] for passes in segments for one in passes if "grad" in one])
    trained = torch.isin(env["obs"], graded).any(1).nonzero()[:, 0].tolist()
    if not trained:
        raise UnclearError
    numbers = [*(one["rows"] for passes in segments for one in passes), env["next"], env["following"]]
    most = 1 + max(int(each.max()) for each in numbers)
    place, known = torch.full((most,), -1), {k: torch.full((most, k), torch.nan).double() for k in (1, ACTIONS)}
    for one in segments[0]:
        rows, out = one["rows"], one["out"].double()
        if ((known[out.shape[1]][rows] - out).abs() > 1e-3 * (1 + out.abs())).any():
            raise UnclearError  # an observation has two outputs: dropout, two critics, …
        known[out.shape[1]][rows] = out
    count, env = env["obs"].numel(), {name: column[trained[0] : trained[-1] + 1] for name, column in env.items()}
    place[env["obs"].flatten()] = torch.arange(env["obs"].numel())
    if (place[graded] < 0).any():
        raise UnclearError  # rows of other updates
    values = {"value": "obs", "next_value": "next", "following_value": "following"}
    env |= {name: known[1][env[obs], 0] for name, obs in values.items()}
    steps = {k: list(minibatches(segments, place, known[k].clone())) for k in known}
    return Update(env, known[ACTIONS][env["obs"].flatten()], steps[ACTIONS], steps[1], (trained[0] * NUM_ENVS, count))


def minibatches(segments: list[list[dict[str, Any]]], place: Tensor, latest: Tensor) -> Iterator[Step]:
    """The passes [M, K] with a gradient before each step; `latest` has the last ones without, by number."""
    for passes in segments:
        merged: dict[tuple[int, ...], Step] = {}  # two passes of the same rows, one for log π and one for H, are one
        for one in (one for one in passes if one["out"].shape[1] == latest.shape[1]):
            rows, key = one["rows"], tuple(sorted(one["rows"].tolist()))
            if "grad" not in one:
                latest[rows] = one["out"].double()
                continue
            step = Step(place[rows], one["out"].double(), one["grad"].double(), latest[rows])
            if key in merged:
                at = merged[key].rows.argsort().argsort()
                step = merged[key]._replace(grad=merged[key].grad + step.grad[step.rows.argsort()][at])
            merged[key] = step
        if merged:
            yield Step(*map(torch.cat, zip(*merged.values(), strict=True)))


# --- what fits ---


def fitted(y: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """Least squares of y [M] by columns [… M, K]: the residual […, M], and the coefficients […, K]."""
    scale = columns.norm(dim=-2, keepdim=True) + 1e-12
    found = torch.linalg.lstsq(columns / scale, y[..., None].expand(*columns.shape[:-1], 1), driver="gelsd").solution
    return y - (columns / scale @ found)[..., 0], (found / scale.mT)[..., 0]


def coefficients(step: Step, action: Tensor) -> tuple[Tensor, float]:
    """(c [M], β) of gradients c_i (onehot(a_i) − π_i) − β ∂H/∂logits_i in the logits.

    Raises:
        UnclearError: they are of another form.
    """
    log_p = step.out.log_softmax(1)
    p, toward = log_p.exp(), torch.eye(ACTIONS).double()[action] - log_p.exp()
    entropy = -p * (log_p - (p * log_p).sum(1, keepdim=True))
    beside = [x - toward * ((x * toward).sum(1) / toward.square().sum(1))[:, None] for x in (step.grad, entropy)]
    rest, found = fitted(-beside[0].flatten(), beside[1].flatten()[:, None])
    whole = step.grad.norm().clamp(min=1e-12)
    if rest.norm() > 5 * FITS * whole:
        raise UnclearError
    beta = float(found) * float(beside[0].norm() > 1e-5 * whole)  # less is rounding
    return ((step.grad + beta * entropy) * toward).sum(1) / toward.square().sum(1), beta


class Sample(NamedTuple):
    """Some rows of a minibatch, the gradient y of each, its place there, and the row whose advantage counts for it."""

    update: Update
    rows: Tensor
    y: Tensor
    place: Tensor
    others: Tensor


class Fit(NamedTuple):
    """The best γ and λ of a form: the relative residual, and the coefficients in each sample."""

    error: float
    gamma: float
    lam: float
    coefficients: list[Tensor]


def parts(form: Callable[..., Any], update: Update, following: str, gamma: Tensor, lam: Tensor, out: int) -> Tensor:
    """The parts [T · N, C, 2] of A (out 0) or of the target (out 1) that come of the rewards, and of the values.

    Each of C pairs of γ and λ has its own. A value that was never computed is replaced by noise, so that no form that
    needs it can fit.
    """
    env = {name: column[..., None] for name, column in update.env.items()}
    noise = 100 * torch.randn(env["value"].shape, generator=torch.Generator().manual_seed(0)).double()
    value, after = (torch.where(v.isnan(), noise, v) for v in (env["value"], env[following]))
    zero = torch.zeros_like(value)
    both = [
        form(*rows, env["terminated"], env["done"], gamma=gamma, lam=lam)[out].expand(*value.shape[:2], len(gamma))
        for rows in ((env["reward"].double(), zero, zero), (zero, value, after))
    ]
    return torch.stack(both, -1).flatten(0, 1)


def search(samples: Sequence[Sample], form: Any = RIGHT, following: str = "next_value", out: int = 0) -> Fit:
    """Fit −y of some minibatches by A and a constant (out 0), or by target − V (out 1; 2 with a constant)."""

    def errors(points: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Relative residuals [C, B] and coefficients at points [C, 2]: (γ, γλ), which depend on each other little."""
        gamma, decay = points.T
        rests, found = [], []
        for update, rows, y, _, others in samples:
            columns = parts(form, update, following, gamma, decay / gamma.clamp(min=0.1), min(out, 1))[others]
            if out:
                columns[..., 1] -= update.env["value"].flatten()[rows, None]
            columns = columns if out == 1 else torch.cat([columns, torch.ones_like(columns[..., :1])], -1)
            rest, each = fitted(-y, columns.transpose(0, 1))
            rests.append(rest / (y if out == 1 else y - y.mean()).norm().clamp(min=1e-12))
            found.append(each)
        return torch.cat(rests, -1), found

    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 9).double()] * 2)
    centre, width = torch.tensor([0.75, 0.5]).double(), torch.tensor([0.25, 0.5]).double()
    for _ in range(3):
        points = (centre + grid * width).clamp(0, 1)
        centre, width = points[errors(points)[0].norm(dim=-1).argmin()], width * 0.5
    best = Fit(torch.inf, 0.0, 0.0, [])
    for _ in range(8):  # Gauss–Newton
        rest, found = errors(centre + torch.tensor([[0, 0], [1e-4, 0], [0, 1e-4]]).double())
        error = float(rest[0].norm())
        if error < best.error:
            best = Fit(error, float(centre[0]), float(centre[1] / centre[0]), [each[0] for each in found])
        if error > 0.5:
            break  # no form that fits is as far away as that so near to its γ and λ
        move = torch.linalg.lstsq((rest[1:] - rest[:1]).T / 1e-4, rest[0][:, None]).solution[:, 0]
        centre = (centre - move).clamp(0, 1)
    return best


def form_that_fits(samples: list[Sample], out: int) -> str | None:
    """The well-known mistake in the advantages or the targets."""
    later = [s.rows >= NUM_ENVS for s in samples]  # what the first row has of the rollout before is unknown
    kept = [Sample(s.update, *(part[keep] for part in s[1:])) for s, keep in zip(samples, later, strict=True)]
    candidates = [(words, following) for following in ("next_value", "following_value") for words in FORMS]
    for words, following in [("", "following_value"), *candidates]:
        if out == 0 and "other order" in words:
            continue  # returns in place of advantages are right in the policy's loss
        if search(kept, FORMS[words], following, out).error < FITS:
            return words or SAYS["final_obs"]
    return None


def other_rows(samples: list[Sample]) -> Iterator[tuple[str, list[Sample]]]:
    """Samples in which the advantages are of rows that may be taken for the right ones."""
    steps, envs = samples[0].update.env["reward"].shape
    yield SAYS["own_rows"], [s._replace(others=s.place) for s in samples]
    yield SAYS["order"], [s._replace(others=(s.rows % envs) * steps + s.rows // envs) for s in samples]
    yield SAYS["order"], [s._replace(others=(s.rows % steps) * envs + s.rows // steps) for s in samples]


# --- what is certain ---


class Verdict(NamedTuple):
    """A sentence on what is wrong, if anything is; whether all is proved right."""

    sentence: str | None = None
    is_proved: bool = False


def judged(seen: Mapping[str, Any]) -> Verdict:
    """The verdict on the notes of `watched`: only what is certain."""
    is_proved, them = True, list[Update]()
    with suppress(Exception):
        them = list(updates(seen))
    for point in (optimizer_mistakes, row_mistakes, policy_mistakes, critic_mistakes):
        with suppress(Exception):  # an `UnclearError`, or of numbers of another form: no fault of the loop's
            if sentence := point(seen, them):
                return Verdict(sentence)
            continue
        is_proved = False
    return Verdict(None, is_proved)


def optimizer_mistakes(seen: Mapping[str, Any], them: list[Update]) -> str | None:
    """Parameters that no step reaches, and gradients that a step takes twice."""
    graded = {one["out"].shape[1] for one in seen["events"] if "grad" in one and one["grad"].any()}
    has_steps = any("out" not in event for event in seen["events"])
    for k, name in (
        (ACTIONS, "the last layer of the policy"),
        (1, "the last layer of the critic"),
        (0, "a hidden layer"),
    ):
        its = [rest for size, *rest in seen["stays"] if size == k]
        is_still = its and all(stays for stays, _ in its) if k else [True, True] in its
        if is_still and (graded or has_steps):
            why = "not_in_optimizer" if [True, True] in its else "zeroed" if k in graded else "no_gradient"
            why = why if graded and has_steps else "no_step" if graded else "no_backward"
            return f"{name} never changes. Likely: {SAYS[why]}."
    if any(_is_added_up(seen["events"], k) for k in (ACTIONS, 1)):
        return SAYS["zero_grad"]
    if not has_steps:
        raise UnclearError
    return None


def _is_added_up(events: list[dict[str, Any]], k: int) -> bool:
    """Whether steps take the gradients of a last layer of K outputs again. Raises `UnclearError` if others than its."""
    steps = [passes for group in grouped(events).values() for passes in group]
    owns = [[one["own"] for one in passes if "grad" in one and one["out"].shape[1] == k] for passes in steps]
    owns = [torch.stack(own).sum(0) for own in owns if own]
    takes = [event["taken"][k] for event in events if k in event.get("taken", {})]
    apart = []
    for before, taken, own in zip(takes, takes[1:], owns[1:], strict=False):
        columns, size = torch.stack([own, before], 1), taken.norm().clamp(min=1e-12)
        apart.append([float(fitted(taken, columns[:, :n])[0].norm() / size) for n in (1, 2)])
    alone, together = torch.tensor(apart).reshape(-1, 2).T
    if len(apart) and ((alone > FAILS) & (together < FAILS / 2)).double().mean() > 0.7:
        return True
    if (alone > FAILS).any():
        raise UnclearError
    return False


def row_mistakes(seen: Mapping[str, Any], them: list[Update]) -> str | None:
    """Rows that are not trained on; the first rollout and one that may have been cut off do not count."""
    used = [torch.cat([step.rows for step in each.policy]).unique() + each.places[0] for each in them if each.policy]
    if not used:
        raise UnclearError
    count, whole = them[-1].places[1], used[1:-1]
    share = max(map(len, used)) / count
    if share <= 0.6 and len(whole) > 1 and all(rows.equal(whole[0]) for rows in whole):
        return f"the same {len(whole[0])} of the {count} rows of a rollout are trained on, the others never."
    if share <= 0.5 and len(whole) > 1 and all(len(each.policy) == 1 for each in them):
        return f"one minibatch of the {count} rows of a rollout is trained on, once."
    if share <= 0.6:
        raise UnclearError
    begins = {t for t in grouped(seen["events"]) if t > 0}
    if len(begins) > 2 and begins - {max(begins)} <= set(seen["restarts"]):
        return SAYS["restart"]
    return None


def policy_mistakes(seen: Mapping[str, Any], them: list[Update]) -> str | None:
    """The advantages, the ratio and the entropy in the policy's loss."""
    steps = [(update, step, update.env["action"].flatten()[step.rows]) for update in them for step in update.policy]
    if any(_is_of_others(step, action) for _, step, action in steps):
        return SAYS["actions"]
    if _are_twice(steps):
        return SAYS["twice"]
    weights = [(update, step, *coefficients(step, action)) for update, step, action in steps]
    firsts = {id(update): _sample(update, step, c) for update, step, c, _ in reversed(weights)}
    samples = [sample for sample in reversed(firsts.values()) if len(sample.rows) >= 16]
    if not samples:
        raise UnclearError
    if torch.tensor([beta < 0 for *_, beta in weights]).double().mean() > 0.8:
        return SAYS["entropy"]
    if all(sample.y.std() < 1e-3 * sample.y.mean().abs() for sample in samples):
        return SAYS["same_weight"]
    fit = search(samples[:2])
    if fit.error > FAILS:
        return _advantage_mistake(samples[:2], fit)
    if fit.error > FITS:
        raise UnclearError
    return _setting_mistake(seen["settings"], fit) or _ratio_mistake(weights, samples, fit)


def _sample(update: Update, step: Step, y: Tensor) -> Sample:
    """Rows of a minibatch that count: not those without a gradient, nor those where the Huber loss has its largest."""
    counts = y.abs() > 1e-5 * y.abs().max()
    inner = counts & (y.abs() < 0.9999 * y.abs().max())
    counts = inner if 16 <= inner.sum() < counts.sum() - 2 else counts
    return Sample(update, step.rows[counts], y[counts], counts.nonzero()[:, 0], step.rows[counts])


def _is_of_others(step: Step, action: Tensor) -> bool:
    """Whether each row's gradient is that of log π of some action, but often not of its own."""
    toward = torch.eye(ACTIONS).double() - step.out.softmax(1)[:, None]  # [M, A, K]
    along = (toward * step.grad[:, None]).sum(-1, keepdim=True) / toward.square().sum(-1, keepdim=True)
    rest, likely = ((step.grad[:, None] - along * toward).norm(dim=-1) / step.grad.norm(dim=1, keepdim=True)).min(1)
    return bool(rest.max() < FAILS and (likely != action).double().mean() > 0.25)


def _are_twice(steps: list[tuple[Update, Step, Tensor]]) -> bool:
    """Whether each row's gradient is that of log π, π = softmax(softmax(out)), and not of softmax(out)."""
    apart = []
    for _, step, action in steps:
        p = step.out.softmax(1)
        once, twice = (torch.eye(ACTIONS).double()[action] - q for q in (p, p.softmax(1)))
        for toward in (once, p * (twice - (p * twice).sum(1, keepdim=True))):
            along = (step.grad * toward).sum(1) / toward.square().sum(1)
            apart.append((step.grad - along[:, None] * toward).norm() / step.grad.norm().clamp(min=1e-12))
    return any(x > FAILS for x in apart[::2]) and all(x < FITS for x in apart[1::2])


def _advantage_mistake(samples: list[Sample], right: Fit) -> str | None:
    """The wrong advantage, or the wrong rows, that fit where the right one does not."""
    if words := form_that_fits(samples, 0):
        return f"the weights of log π are not the advantages. Likely: {words}."
    for words, moved in other_rows(samples):
        if search(moved).error < FITS:
            return f"the advantages are of other rows than log π. Likely: {words}."
        ratios = []
        for s, other in zip(samples, moved, strict=True):
            log_prob = _log_prob(s.update.logits, s.update.env["action"].flatten())
            ratios.append(s._replace(y=s.y / (log_prob[s.rows] - log_prob[other.others]).exp()))
        if search(ratios).error < FITS:
            return f"{SAYS['old_rows']}{words}."
    if right.error > 0.9 and all(len(s.rows) >= 60 for s in samples):
        return SAYS["unrelated"]
    raise UnclearError


def _log_prob(logits: Tensor, action: Tensor) -> Tensor:
    return logits.log_softmax(1).gather(1, action[:, None])[:, 0]


def _setting_mistake(settings: Mapping[str, list[float]], fit: Fit) -> str | None:
    """Whether γ or λ is left out, by the only ones that the file names."""
    if [len(settings["gamma"]), len(settings["lam"])] != [1, 1]:
        return None
    (gamma,), (lam,) = settings["gamma"], settings["lam"]
    forms = {
        "there is no chain": (gamma, 0.0),
        "λ is left out": (gamma, gamma),
        "γ is left out of the chain": (gamma, lam),
        "γ is left out of δ": (1.0, gamma * lam),
        "γ is left out": (1.0, lam),
    }
    for words, form in {"": (gamma, gamma * lam), **forms}.items():
        if max(abs(fit.gamma - form[0]), abs(fit.gamma * fit.lam - form[1])) < 1e-3:
            return words and f"the advantage is not that of γ = {gamma} and λ = {lam}. Likely: {words}."
    return None


class Weight(NamedTuple):
    """Of a minibatch [M]: c, A', and log π less that of the first weights, and less that of the last pass before."""

    c: Tensor
    a: Tensor
    log_ratio: Tensor
    to_latest: Tensor


def _ratio_mistake(weights: list[tuple[Update, Step, Tensor, float]], samples: list[Sample], fit: Fit) -> str | None:
    """The ratio, its clip and the sign of the policy's loss, where the advantages are known."""
    kinds = list(_known_weights(weights, samples, fit))
    if not kinds and list(_known_weights(weights, samples, fit, -1.0)):
        return SAYS["mean_added"]
    for kind in kinds:
        beyond, far = _edges(kind)
        if _misfit(clipped_surrogate, kind, beyond) < 5 * FITS:
            return f"the ratio is not clipped where it is far {far}, and the advantage has its sign." if far else None
    for kind in kinds:
        for words, form in OBJECTIVES.items():
            if _misfit(form, kind, _edges(kind)[0], 0.9) < 5 * FITS:  # far away, a wrong one has edges of its own
                return f"the policy's gradient is not that of the clipped objective. Likely: {words}."
        again = [each._replace(log_ratio=each.to_latest) for each in kind if not each.to_latest.isnan().any()]
        if len(again) == len(kind) and _misfit(clipped_surrogate, again, _edges(again)[0], 0.9) < 5 * FITS:
            return SAYS["again"]
    if any(map(_is_one_sided, kinds)):
        return SAYS["one_sided"]
    raise UnclearError


def _known_weights(weights: list[Any], samples: list[Sample], fit: Fit, sign: float = 1.0) -> Iterator[list[Weight]]:
    """The minibatches, for each m that agrees with the first ones: 0, the rollout's mean, or the minibatch's.

    With `sign` −1, m is the negative of one of these means.
    """
    gamma, lam = torch.tensor([[fit.gamma], [fit.lam]]).double()
    advantages, possible = {}, [True] * 3
    for sample in samples:
        both = parts(RIGHT, sample.update, "next_value", gamma, lam, 0)[:, 0]
        rest, (*scales, shift) = fitted(-sample.y, torch.cat([both[sample.rows], torch.ones(len(sample.rows), 1)], 1))
        if rest.norm() > 5 * FITS * sample.y.norm():
            raise UnclearError  # a γ of each update, …
        a, m = both @ torch.stack(scales) * scales[0].sign(), -shift * scales[0].sign()
        advantages[id(sample.update)] = a
        means = (0, sign * a.mean(), sign * a[sample.update.policy[0].rows].mean())
        possible = [was and bool(abs(mean - m) < 0.02 * a.std()) for was, mean in zip(possible, means, strict=True)]
    for kind in np.flatnonzero(possible):
        its = []
        for update, step, c, _ in weights:
            if id(update) in advantages:
                a, action = advantages[id(update)], update.env["action"].flatten()[step.rows]
                now, first, latest = (_log_prob(z, action) for z in (step.out, update.logits[step.rows], step.latest))
                mean = (0, a.mean(), a[step.rows].mean())[kind]
                its.append(Weight(c, a[step.rows] - mean, now - first, now - latest))
        yield its


def _is_one_sided(weights: list[Weight]) -> bool:
    """Whether rows whose ratio is 1 have no gradient where the advantage is above some number, or where it is below."""
    c, a, log_ratio, _ = map(torch.cat, zip(*weights, strict=True))
    counts = (log_ratio.abs() < 0.01) & (a.abs() > 0.1 * a.std())
    has = c[counts].abs() > 1e-6 * c.abs().max()
    without, beside = a[counts][~has], a[counts][has]
    return min(len(without), len(beside)) > 8 and bool(without.min() >= beside.max() or without.max() <= beside.min())


def _edges(weights: list[Weight]) -> tuple[tuple[float, float], str]:
    """Log ratios below and above 0 from which on c is 0; where the ratio is far from 1, but c is not 0."""
    c, a, log_ratio, _ = map(torch.cat, zip(*weights, strict=True))
    is_zero = (c.abs() < 1e-3 * (c * a).abs().sum() / a.square().sum() * a.abs()) & (a.abs() > 0.01 * a.std())
    below, above = log_ratio[is_zero & (log_ratio <= 0)], log_ratio[is_zero & (log_ratio >= 0)]
    low = float(below.max()) + 1e-7 if len(below) else -torch.inf
    high = float(above.min()) - 1e-7 if len(above) else torch.inf
    is_far = ~is_zero & (a.abs() > 0.1 * a.std())
    far = ((log_ratio < -0.4) & is_far & (a < 0)).sum() > 2, ((log_ratio > 0.4) & is_far & (a > 0)).sum() > 2
    return (low, high), " and ".join(
        side for side, is_there in zip(("below 1", "above 1"), far, strict=True) if is_there
    )


def _misfit(objective: Any, weights: list[Weight], edges: tuple[float, float], share: float = 1.0) -> float:
    """The relative residual of an objective's gradient in log π, κ > 0 for each, in a share of minibatches."""
    rests = []
    for c, a, log_ratio, _ in weights:
        leaf = log_ratio.clone().requires_grad_()
        clip = torch.where((log_ratio <= edges[0]) | (log_ratio >= edges[1]), 0.0, 1e9)  # whatever ε is
        (p,) = torch.autograd.grad(objective(leaf, a, clip), leaf)
        kappa = ((c * p).sum() / p.square().sum().clamp(min=1e-20)).clamp(min=0)
        rests.append((c - kappa * p).norm() / c.norm().clamp(min=1e-12))
    return float(torch.stack(rests).quantile(share))


def critic_mistakes(seen: Mapping[str, Any], them: list[Update]) -> str | None:
    """The target and the sign of the critic's loss, in the first steps of updates."""
    samples = []
    for update in them:
        for step in update.critic[:1]:
            value, sample = update.env["value"].flatten()[step.rows], _sample(update, step, step.grad[:, 0])
            if len(sample.rows) >= 16 and (value - step.out[:, 0]).abs().max() < 1e-3 * (1 + value.abs().max()):
                samples.append(sample)
    samples = samples[:2]
    if not samples:
        raise UnclearError
    fit = search(samples, out=1)
    if fit.error < FITS:
        is_turned = all(float(each[0]) < 0 for each in fit.coefficients)
        return SAYS["value_sign"] if is_turned else SAYS["value_reward"] if fit.gamma < 1e-3 else None
    return _target_mistake(samples, fit)


def _target_mistake(samples: list[Sample], right: Fit) -> str:
    """The wrong target, or the wrong rows, that fit where the right one does not."""
    if right.error < FAILS:
        raise UnclearError
    if all(
        fitted(s.y, torch.stack([s.update.env["value"].flatten()[s.rows], torch.ones(len(s.rows))], 1))[0].norm()
        < FITS * s.y.norm()
        for s in samples
    ):
        return SAYS["value_shapes"]
    if search(samples, out=2).error < FITS:
        return SAYS["value_constant"]
    if words := form_that_fits(samples, 1):
        return f"V does not go towards its target. Likely: {words}."
    for words, moved in other_rows(samples):
        if search(moved, out=1).error < FITS:
            return f"the targets are of other rows than V. Likely: {words}."
    raise UnclearError
