"""The zoo's losses, target networks and draws: what is called right is right, what is called wrong is not.

The oracles are plain Python in float64, written from the courses' formulas; a gradient is a central difference of the
formula. The checker has no part in it. A wrong solution has to differ from the oracle, or to raise what it says.
"""

import copy
import math
import random
import re
import signal
import sys
from collections import Counter
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from zoo_files import ZOO, execute, find, load

pytestmark = [
    pytest.mark.long,  # of the zoo itself, which the quick suite takes as it is
    pytest.mark.filterwarnings("ignore"),  # a student's broadcast is a warning, too
]

SECONDS = {"right": 60.0, "wrong": 2.0}  # of the processor: the machine may be busy
CALLS = {
    "policy_gradient": "f(log_prob, weight)",
    "clipped_surrogate": "f(log_ratio, advantage, clip)",
    "calculate_pg_loss": "f(mb_advantages, ratio)",
    "calculate_v_loss": "f(newvalue, b_returns, b_values, mb_inds, if_clip)",
    "compute_loss": "f(states, actions, advantages, critic_targets, log_probs_old)",
    "value_loss": "f(value, target, old_value, clip)",
    "polyak": "f(target, online, tau)",
    "select_at_index": "f(x, indices)",
    "sample_categorical": "f(probs)",
}


class WrongError(Exception):
    """What the oracle says of a solution."""


class EndlessError(Exception):
    """The time limit."""


# --- the formulas, in floats ---


def clamp(x, low, high):
    return min(max(x, low), high)


def mean(numbers):
    numbers = list(numbers)
    return math.fsum(numbers) / len(numbers)


def clipped_objective(ratio, advantage, clip):
    return min(ratio * advantage, clamp(ratio, 1 - clip, 1 + clip) * advantage)


def surrogate_loss(ratios, advantages, clip):
    return -mean(clipped_objective(r, a, clip) for r, a in zip(ratios, advantages, strict=True))


def half_square(values, targets, old_values, clip):
    errors = []
    for i, (value, target) in enumerate(zip(values, targets, strict=True)):
        error = (value - target) ** 2
        if clip is not None:
            error = max(error, (old_values[i] + clamp(value - old_values[i], -clip, clip) - target) ** 2)
        errors.append(error)
    return mean(errors) / 2


def slope(formula, numbers, step=1e-6):
    """The central differences of a formula of a list of numbers."""

    def at(i, change):
        return formula([x + change * (i == j) for j, x in enumerate(numbers)])

    return [(at(i, step) - at(i, -step)) / (2 * step) for i in range(len(numbers))]


# --- what is compared ---


def same(got, wanted, what, tolerance=2e-4):
    if not isinstance(got, torch.Tensor):
        raise WrongError(f"{what} is a {type(got).__name__}")
    flat, expected = got.detach().double().reshape(-1).tolist(), list(wanted)
    if len(flat) != len(expected) or any(
        not abs(a - b) <= tolerance * (1 + abs(b)) for a, b in zip(flat, expected, strict=True)
    ):
        raise WrongError(f"{what} is {flat[:6]}, not {expected[:6]}")


def scalar_with_slope(loss, wanted, variable, wanted_slope):
    if isinstance(loss, torch.Tensor) and loss.shape != ():
        raise WrongError(f"the shape is {tuple(loss.shape)}")
    if wanted is not None:
        same(loss, [wanted], "the loss")
    if not isinstance(loss, torch.Tensor) or not loss.requires_grad:
        raise WrongError("no gradient")
    if wanted_slope is not None:
        same(torch.autograd.grad(loss, variable, allow_unused=True)[0], wanted_slope, "the gradient")


def normals(rng, n, scale=1.0):
    """Numbers that float32 holds exactly."""
    return torch.tensor([rng.gauss(0, scale) for _ in range(n)], dtype=torch.float32).tolist()


def leaf(numbers):
    return torch.tensor(numbers, requires_grad=True)


# --- the exercises: each runs the solution on its inputs and raises Wrong ---


def policy_gradient(call):
    rng = random.Random(1)
    for n in (1, 4, 33):
        log_prob, weight = [-abs(x) - 0.01 for x in normals(rng, n)], normals(rng, n, 3.0)
        variable = leaf(log_prob)
        loss = call(log_prob=variable, weight=torch.tensor(weight))
        scalar_with_slope(loss, None, variable, [-w / n for w in weight])  # only the gradient means something


def ratios(rng, n, clip):
    """Ratios on both sides of the interval and inside, none at a kink; far away in large batches."""
    drawn = [math.exp(x) for x in normals(rng, n, 0.4 if n < 50 else 0.8)]
    return [r if min(abs(r - 1 - clip), abs(r - 1 + clip)) > 1e-3 else 1.0 for r in drawn]


def clipped_surrogate(call):
    rng = random.Random(2)
    for n, clip in ((1, 0.2), (1, 0.2), (6, 0.2), (40, 0.1), (64, 0.3)):
        log_ratio, advantage = [math.log(r) for r in ratios(rng, n, clip)], normals(rng, n, 2.0)
        variable = leaf(log_ratio)
        loss = call(log_ratio=variable, advantage=torch.tensor(advantage), clip=clip)

        def formula(logs, advantage=advantage, clip=clip):
            return surrogate_loss([math.exp(x) for x in logs], advantage, clip)

        scalar_with_slope(loss, formula(log_ratio), variable, slope(formula, log_ratio))
    edge = torch.tensor([1.5, 0.5], dtype=torch.float64).log().requires_grad_()
    for advantage in ([1.0, 2.0], [-1.0, -2.0]):
        loss = call(log_ratio=edge, advantage=torch.tensor(advantage, dtype=torch.float64), clip=0.5)
        scalar_with_slope(loss, surrogate_loss([1.5, 0.5], advantage, 0.5), edge, None)


def calculate_pg_loss(call):
    rng = random.Random(3)
    for n, clip in ((1, 0.25), (5, 0.25), (64, 0.2), (32, 0.1)):
        ratio, advantage = ratios(rng, n, clip), normals(rng, n)
        variable = leaf(ratio)
        loss = call(mb_advantages=torch.tensor(advantage), ratio=variable, clip_coef=clip)

        def formula(ratio, advantage=advantage, clip=clip):
            return surrogate_loss(ratio, advantage, clip)

        scalar_with_slope(loss, formula(ratio), variable, slope(formula, ratio))


def calculate_v_loss(call):
    rng = random.Random(4)
    for size, n, clip in ((12, 4, 0.25), (64, 16, 0.25), (64, 16, 0.2)):
        returns, values = normals(rng, size, 2.0), normals(rng, size, 2.0)
        inds = rng.sample(range(size), n)
        new = torch.tensor([values[i] for i in inds]) + torch.tensor(normals(rng, n, 0.5))
        for if_clip in (False, True):
            for mb_inds in (np.array(inds), torch.tensor(inds)):
                variable, given = new.clone().requires_grad_(), (torch.tensor(returns), torch.tensor(values))

                def formula(new, returns=returns, values=values, inds=inds, eps=clip if if_clip else None):
                    return half_square(new, [returns[i] for i in inds], [values[i] for i in inds], eps)

                loss = call(
                    newvalue=variable,
                    b_returns=given[0],
                    b_values=given[1],
                    mb_inds=mb_inds,
                    if_clip=if_clip,
                    clip_coef=clip,
                )
                scalar_with_slope(loss, formula(new.tolist()), variable, slope(formula, new.tolist()))
                same(given[0], returns, "b_returns, changed in place,", 0)
                same(given[1], values, "b_values, changed in place,", 0)


def value_loss(call):
    rng = random.Random(5)
    for n, clip in ((1, None), (3, None), (20, None), (3, 0.2), (40, 0.25), (40, 0.5)):
        target, old = normals(rng, n, 2.0), normals(rng, n, 2.0)
        value = (torch.tensor(old) + torch.tensor(normals(rng, n, 0.6))).tolist()
        variable = leaf(value)
        loss = call(
            value=variable,
            target=torch.tensor(target),
            old_value=None if clip is None else torch.tensor(old),
            clip=clip,
        )

        def formula(value, target=target, old=old, clip=clip):
            return half_square(value, target, old, clip)

        scalar_with_slope(loss, formula(value), variable, slope(formula, value))


def compute_loss(call):
    rng = random.Random(6)
    for n in (1, 4, 24):
        states = torch.tensor(normals(rng, n * 5)).reshape(n, 5)
        actions = torch.tensor([rng.randrange(3) for _ in range(n)])
        advantages, targets, noise = (normals(rng, n) for _ in range(3))
        agent = call.owner
        actor, critic = (copy.deepcopy(net).double() for net in (agent.actor, agent.critic))
        log_probs = []
        for logits, action in zip(actor(states.double()), actions.tolist(), strict=True):
            log_probs.append(logits[action] - sum(score.exp() for score in logits).log())
        old = [lp.item() - 0.5 * x for lp, x in zip(log_probs, noise, strict=True)]
        objective = [
            clipped_objective((lp - before).exp(), a, agent.epsilon)
            for lp, before, a in zip(log_probs, torch.tensor(old).double(), advantages, strict=True)
        ]
        squares = [(v - y) ** 2 for v, y in zip(critic(states.double())[:, 0], targets, strict=True)]
        wanted = -sum(objective) / n, sum(squares) / n
        result = call(
            states=states,
            actions=actions,
            advantages=torch.tensor(advantages),
            critic_targets=torch.tensor(targets),
            log_probs_old=torch.tensor(old),
        )
        if not isinstance(result, (tuple, list)) or len(result) != 2:
            raise WrongError("not two losses, which cannot be unpacked")
        networks = (agent.actor, agent.critic), (actor, critic)
        theirs, ours = ([p for net in pair for p in net.parameters()] for pair in networks)
        for loss, expected in zip(result, wanted, strict=True):
            scalar_with_slope(loss, expected.item(), None, None)
            got = torch.autograd.grad(loss, theirs, allow_unused=True, retain_graph=True)
            true = torch.autograd.grad(expected, ours, allow_unused=True, retain_graph=True)
            for a, b, parameter in zip(got, true, ours, strict=True):
                b = torch.zeros_like(parameter) if b is None else b
                same(torch.zeros_like(parameter) if a is None else a, b.reshape(-1).tolist(), "a gradient")


def polyak(call):
    rng = random.Random(7)
    for tau in (0.005, 0.3, 1.0):
        for needs_gradient in (False, True):
            networks = (
                nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 2)),
                nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 2)),
            )
            target, online = (list(net.parameters()) for net in networks)
            for tensor in target + online:
                tensor.data = torch.tensor(normals(rng, tensor.numel())).reshape(tensor.shape)
                tensor.requires_grad_(needs_gradient)
            before = [(t.reshape(-1).tolist(), o.reshape(-1).tolist()) for t, o in zip(target, online, strict=True)]
            call(target=target, online=online, tau=tau, target_module=networks[0], online_module=networks[1])
            for t, o, (was, theirs) in zip(target, online, before, strict=True):
                blend = [(1 - tau) * a + tau * b for a, b in zip(was, theirs, strict=True)]
                same(t, blend, "a target", 1e-6)
                same(o, theirs, "an online parameter", 0)
                if t.data_ptr() == o.data_ptr():
                    raise WrongError("the two share their memory")


def select_at_index(call):
    rng = random.Random(8)
    for n, d in ((1, 3), (4, 3), (3, 4), (5, 1), (16, 7)):
        numbers = normals(rng, n * d, 3.0)
        indices = [rng.randrange(d) for _ in range(n)]
        x = torch.tensor(numbers).reshape(n, d).requires_grad_()
        result = call(x=x, indices=torch.tensor(indices))
        same(result, [numbers[i * d + j] for i, j in enumerate(indices)], "x[i, indices[i]]", 1e-6)
        if result.shape != (n,):
            raise WrongError(f"the shape is {tuple(result.shape)}, one row or many")
        weights = normals(rng, n)
        if not result.requires_grad:
            raise WrongError("no gradient")
        gradient = torch.autograd.grad((result * torch.tensor(weights)).sum(), x)[0]
        same(gradient, [weights[i] * (j == indices[i]) for i in range(n) for j in range(d)], "the gradient", 1e-6)


def sample_categorical(call):
    for seed in (random.seed, np.random.seed, torch.manual_seed):
        seed(9)
    kinds = [[0.1, 0.2, 0.3, 0.4], [0.6, 0.0, 0.25, 0.15], [0.05, 0.05, 0.05, 0.85]]
    rounds = 1200
    draws = []
    for needs_gradient in (False, True):
        probs = torch.tensor(kinds * rounds).requires_grad_(needs_gradient)
        drawn = call(probs=probs)
        check_indices(drawn, len(probs), 4)
        draws.append(drawn.tolist())
    if draws[0] == draws[1]:
        raise WrongError("the same draw in each call")
    check_indices(call(probs=torch.tensor(kinds[:1])), 1, 4)
    check_indices(call(probs=torch.tensor([[0.5, 0.5], [1.0, 0.0]])), 2, 2)
    for drawn in draws:
        for kind, p in enumerate(kinds):
            likely(Counter(drawn[kind::3]), dict(enumerate(p)), rounds)
        pairs = [(a, b) for i, (a, b) in enumerate(pairwise(drawn)) if i % 3 == 0]
        joint = {(a, b): p * q for a, p in enumerate(kinds[0]) for b, q in enumerate(kinds[1])}
        likely(Counter(pairs), joint, rounds)


def check_indices(drawn, n, d):
    if not isinstance(drawn, torch.Tensor) or drawn.is_floating_point():
        raise WrongError("not a tensor of whole numbers")
    if drawn.shape != (n,):
        raise WrongError(f"the shape is {tuple(drawn.shape)}")
    if not all(0 <= k < d for k in drawn.tolist()):
        raise WrongError("an index out of range")


def likely(counts, probabilities, n):
    for outcome, p in probabilities.items():
        if abs(counts[outcome] - n * p) > 4.5 * math.sqrt(n * p * (1 - p)) + 1e-9:
            raise WrongError(f"{outcome} was drawn {counts[outcome]} times of {n}, and its probability is {p}")


ORACLES = {
    function.__name__: function
    for function in (
        *(policy_gradient, clipped_surrogate, calculate_pg_loss, calculate_v_loss, compute_loss),
        *(value_loss, polyak, select_at_index, sample_categorical),
    )
}


# --- a student's object, and the call ---


class Config(dict):
    """The course's settings: config.clip_coef, config["clip_coef"] and config.get are the same."""

    def __getattr__(self, name):
        if name not in self:
            raise AttributeError(f"has no attribute {name}")
        return self[name]

    __setattr__ = dict.__setitem__


def settings(clip):
    course = {"n_envs": 4, "n_eval_envs": 2, "n_steps": 8, "n_minibatches": 4, "device": "cpu", "learning_rate": 1e-3}
    losses = {"gamma": 0.9, "gae_lambda": 0.95, "norm_adv": True, "clip_coef": clip, "clip_vloss": True}
    return Config(course, **losses, ent_coef=0.01, vf_coef=0.5, max_grad_norm=5.0, target_kl=None, seed=0)


def two_envs(*args, **kwargs):
    spaces = {
        "single_observation_space": SimpleNamespace(shape=(43,)),
        "single_action_space": SimpleNamespace(shape=(4,)),
    }
    return SimpleNamespace(**spaces), SimpleNamespace(**spaces)


def student(owner, module, clip):
    """An object of the student's class, as the course would build it."""
    torch.manual_seed(0)
    if owner.__name__ == "PPOTrainer":
        if hasattr(module, "make_envs"):
            module.make_envs = two_envs
        if owner.__init__ in (object.__init__, nn.Module.__init__):
            trainer = owner()
            trainer.config = settings(clip)
            return trainer
        return owner(settings(clip))
    if owner.__name__ not in ("PPO", "LanderPPO"):
        return owner()
    if issubclass(owner, nn.Module):
        return owner(5, 3, 0.8, 0.95, 0.2, 4)
    agent = owner()  # a bare method: what the notebook's class has besides it
    agent.actor, agent.critic, agent.epsilon = nn.Linear(5, 3), nn.Linear(5, 1), 0.2
    agent.compute_log_probs = lambda s, a: agent.actor(s).log_softmax(-1).gather(-1, a[:, None])[:, 0]
    agent.compute_values = lambda s: agent.critic(s)[:, 0]
    return agent


class Call:
    """The solution as a function of named inputs: `# call: f(advantage, log_ratio)` in it says in which order."""

    def __init__(self, solution, exercise, module):
        line = re.search(r"^# call: (.+)$", solution.code, re.MULTILINE)
        self.expression = line[1] if line else CALLS[exercise]
        self.module, self.name, self.owner_class, self.owner = module, solution.name, None, None
        if "." in self.name:
            self.owner_class = getattr(module, self.name.split(".")[0])
        elif not hasattr(module, self.name):
            classes = [c for c in vars(module).values() if isinstance(c, type) and c.__module__ == module.__name__]
            self.owner_class = next(c for c in classes if self.name in vars(c))
        if self.owner_class is not None:
            self.owner = student(self.owner_class, module, 0.25)

    def __call__(self, **inputs):
        if self.owner is None:
            function = find(self.module, self.name)
        else:
            if "clip_coef" in inputs:
                self.owner = student(self.owner_class, self.module, inputs["clip_coef"])
            function = getattr(self.owner, self.name.split(".")[-1])
        return eval(self.expression, {"f": function, **inputs})


def verdict(solution, exercise):
    """None where the oracle agrees, else the exception, whichever it was."""

    def stop(*args):
        raise EndlessError("an endless loop: the time limit of some seconds")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS[solution.kind], 0.5)
    name = "a_student_of_losses"
    try:
        for seed in (random.seed, np.random.seed, torch.manual_seed):
            seed(9)
        ORACLES[exercise](Call(solution, exercise, execute(solution, name)))
    except (Exception, SystemExit) as error:
        return error
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        sys.modules.pop(name, None)
    return None


FILES = [path for path in sorted(ZOO.glob("*.py")) if path.name.split(".")[0] in ORACLES]
SOLUTIONS = [(path, solution) for path in FILES for solution in load(path)]
RIGHT = [pytest.param(p, s, id=f"{p.stem}: {s.title}") for p, s in SOLUTIONS if s.kind == "right"]
WRONG = [pytest.param(p, s, id=f"{p.stem}: {s.title}") for p, s in SOLUTIONS if s.kind == "wrong"]


@pytest.mark.parametrize(("path", "solution"), RIGHT)
def test_what_is_called_right_agrees_with_the_formula(path, solution):
    error = verdict(solution, path.name.split(".")[0])
    assert error is None, f"{type(error).__name__}: {error}"


@pytest.mark.parametrize(("path", "solution"), WRONG)
@pytest.mark.one_in(3)
def test_what_is_called_wrong_differs_or_raises_what_its_cause_says(path, solution):
    error = verdict(solution, path.name.split(".")[0])
    assert error is not None, "the oracle finds nothing wrong"
    said = f"{type(error).__name__}: {error}"
    cause = re.compile(solution.regex, re.IGNORECASE)
    assert isinstance(error, WrongError) or cause.search(said), f"raises what its cause does not name: {said}"


def test_the_zoo_has_both_kinds_for_each_exercise():
    for exercise in ORACLES:
        kinds = Counter(solution.kind for path, solution in SOLUTIONS if path.name.startswith(exercise + "."))
        assert kinds["right"] >= 6, (exercise, kinds)
        assert kinds["wrong"] >= 12, (exercise, kinds)
    titles = [(path.name.split(".")[0], solution.title) for path, solution in SOLUTIONS]
    assert len(set(titles)) == len(titles)
    assert all(solution.regex for _, solution in SOLUTIONS if solution.kind == "wrong")


NUMBERS_ALONE = {
    "policy_gradient": "the gradient in log_prob[1] is 0.2312; it should be -1.2, with weight = [2.0, -1.0].",
    "clipped_surrogate": "with log_ratio [0.1, -0.3], advantage [1.0, 2.0], clip = 0.2 it is 0.2312; it should be 1.2.",
    "calculate_pg_loss": "with mb_advantages [1.0], ratio [1.1], clip_coef = 0.25 the result is 0.2; it should be 2.1.",
    "calculate_v_loss": "with newvalue [1.0], b_returns [2.0], b_values [1.0], mb_inds [1, 3], if_clip=True it is 0.2.",
    "compute_loss": "actor_loss is 0.2312; it should be 1.2034 (epsilon = 0.2); critic_loss is 2.0.",
    "value_loss": "value_loss(value, target, old_value, clip=0.2) is 0.2312; it should be 1.2034.",
    "polyak": "with tau = 0.3, target[1] is 0.1 after polyak(target, online, tau); it should be 0.005.",
    "select_at_index": "with x = [[1, 2], [3, 4]], indices = [1, 0] the result is [1., 4.]; it should be [2., 3.].",
    "sample_categorical": "sample_categorical(probs)[1] is 3, which it should not be.",
}


def test_a_sentence_of_numbers_alone_names_no_cause():
    """Or else the share of wrong solutions whose cause is named would be flattered."""
    for path, solution in SOLUTIONS:
        sentence = NUMBERS_ALONE[path.name.split(".")[0]]
        named = solution.kind == "wrong" and re.search(solution.regex, sentence, re.IGNORECASE)
        assert not named, (path.name, solution.title, named)
