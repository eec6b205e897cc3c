"""Exercises on the parts of an agent: its networks, and the replay buffer with the rows that go into it."""

import inspect
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from torch import Tensor, nn

from lemniscate.course.exercise import Note, Seen, close
from lemniscate.course.solution import Function, call_by_name, first_that_works, plain

# --- networks: shapes, initialization, distributions, bounds ---

O, A, B = 7, 3, 5
"""numbers of observations and actions, and rows of a batch"""
LOW, HIGH = np.array([-2, 0, 1], np.float32), np.array([1.5, 4, 3], np.float32)
"""bounds of actions that are neither −1 and 1 nor symmetric"""
ENVS = "envs env vec_env venv environment"
STATE, ACTION = "x obs observation observations state states s", "action actions act a u"
GREEDY = "deterministic greedy det determ is_deterministic"


def _envs(num_envs: int, low: np.ndarray, high: np.ndarray, is_vector: bool = True) -> Any:
    """Environments, or a single one, of which a network asks the spaces."""
    observation, action = spaces.Box(-np.inf, np.inf, (O,), np.float32), spaces.Box(low, high)
    envs: Any = gym.vector.VectorEnv() if is_vector else gym.Env()
    envs.observation_space, envs.action_space = observation, action
    if is_vector:
        envs.num_envs, envs.single_observation_space, envs.single_action_space = num_envs, observation, action
        envs.observation_space, envs.action_space = batch_space(observation, num_envs), batch_space(action, num_envs)
    return envs


def _make_network(network: Function, envs: Any) -> Any:
    made = call_by_name(network, {ENVS: envs}, {"device": "cpu"})
    if not isinstance(made, nn.Module):
        raise TypeError(f"{type(made).__name__} is no nn.Module, so it has no parameters to train or to save")
    return made.eval()


def _for_one(network: Function, trial: Callable[[Any], Any], seen: Seen) -> Any:
    """A network for a vector of one environment; for a single environment, if it is one for that."""

    def attempt(is_vector: bool) -> Any:
        trial(made := _make_network(network, _envs(1, LOW, HIGH, is_vector)))
        seen["is_vector"] = is_vector
        return made

    return first_that_works(attempt, (True,), (False,))


def _obs(made: Any, rows: int = B, size: int = O) -> Tensor:
    drawn = torch.randn(rows, size, generator=torch.Generator().manual_seed(0))
    return drawn.to(next(iter(made.parameters()), drawn).dtype)


def _shape(what: str, value: Any, *right: tuple[int, ...], likely: str = "") -> Iterator[str]:
    """A sentence where a value is no tensor, or has none of the shapes that are right."""
    if not isinstance(value, Tensor):
        yield f"{what} is {type(value).__name__}; it should be a tensor."
    if value.shape not in right:
        yield f"{what} has shape {list(value.shape)}; it should be {list(right[0])}.{likely}"


def _likely(found: Any, causes: Mapping[str, Any], otherwise: str = "", atol: float = 1e-2) -> str:
    """The cause that gives what was found."""
    words = next((words for words, value in causes.items() if close(found, value, 1e-2, atol)), otherwise)
    return f" Likely: {words}." if words else ""


def _shown(numbers: Any) -> str:
    return "(" + ", ".join(f"{float(number):.3g}" for number in numbers) + ")"


def _used(made: Any, output: Tensor) -> list[str]:
    """The names of the parameters on which an output depends."""
    parameters = {name: parameter for name, parameter in made.named_parameters() if parameter.requires_grad}
    if not output.requires_grad or not parameters:
        return []
    slopes = torch.autograd.grad(output.sum(), list(parameters.values()), allow_unused=True, retain_graph=True)
    return [name for name, slope in zip(parameters, slopes, strict=True) if slope is not None]


def _slope(output: Tensor, x: Tensor) -> Tensor:
    """The derivative of a number in x; 0 where it does not depend on it."""
    if not output.requires_grad:
        return torch.zeros_like(x)
    (found,) = torch.autograd.grad(output, x, retain_graph=True, allow_unused=True)
    return torch.zeros_like(x) if found is None else found


def _saved(network: Function, made: Any, envs: Any, answer: Callable[[Any], Tensor]) -> bool:
    """Whether another network that is made alike answers the same, with all that this one has to save."""
    with suppress(Exception), torch.random.fork_rng([]), torch.no_grad():  # what raises is seen elsewhere
        torch.manual_seed(1)
        twin = _make_network(network, envs)
        twin.load_state_dict(made.state_dict())
        return close(answer(made), plain(answer(twin)))
    return True


def _all_saved(seen: Seen) -> Iterator[str]:
    if not seen["saved"]:
        yield (
            "a copy with the same state_dict answers otherwise: some of its numbers are neither trained nor saved."
            " Likely: layers in a list of Python; nn.ModuleList, or attributes of their own, make them its parameters."
        )


def _gradient(what: str, used: Collection[str]) -> Iterator[str]:
    if not used:
        yield f"{what} has no gradient in the parameters of a network. Likely: detach, or no_grad."


def _unbounded(what: str, seen: Seen) -> Iterator[str]:
    if not (seen["reach"][0] < -10 and seen["reach"][1] > 10):
        yield f"{what} cannot have every value. Likely: there is an activation behind the last layer."


def _redraw(made: Any, std: float) -> None:
    for parameter in made.parameters():
        if parameter.requires_grad:
            nn.init.normal_(parameter, 0, std)


def _reach(made: Any, output: Callable[[], Tensor]) -> Tensor:
    """The least and the greatest outputs, [2, d], over many large parameters."""
    drawn = []
    for _ in range(20):
        _redraw(made, 10.0)
        drawn.append(output().detach())
    return torch.stack([torch.cat(drawn).amin(0), torch.cat(drawn).amax(0)])


def _bend(function: Callable[[Tensor], Tensor], x: Tensor) -> float:
    """The distance of a function from a linear one, relative to its values; rounding alone is less than 1e-4."""
    x, y = 5 * x, 5 * x.roll(1, 0)
    values = torch.stack([function(rows).detach() for rows in (x + y, torch.zeros_like(x), x, y)])
    apart = values[0] + values[1] - values[2] - values[3]
    return float(apart.abs().max() / values.abs().max().clamp(min=1e-12))


def see_agent(network: Function, seen: Seen) -> None:
    """`Agent(envs)` with `value(x)` and `action_and_value(x, action=None, deterministic=False)`."""
    made = _make_network(network, envs := _envs(2, -np.ones(A, np.float32), np.ones(A, np.float32)))
    obs, rows = _obs(made), _obs(made, 2000)

    def act(x: Tensor, action: Tensor | None = None, deterministic: bool = False) -> Any:
        return call_by_name(made.action_and_value, {STATE: x, ACTION: action, GREEDY: deterministic})

    def mean(x: Tensor) -> Tensor:
        return act(x, deterministic=True)[0].detach()

    def answers(agent: Any) -> Tensor:
        mean, _, entropy, value = call_by_name(agent.action_and_value, {STATE: obs, ACTION: None, GREEDY: True})
        return torch.cat([mean.flatten(), entropy.flatten(), value.flatten()])

    seen["widths"] = [size for parameter in made.parameters() for size in parameter.shape]
    seen["saved"] = _saved(network, made, envs, answers)
    answer = act(obs)
    seen["answer"] = plain(answer)
    seen["value"] = plain(made.value(obs))
    parameters = inspect.signature(made.action_and_value).parameters
    seen["has_mode"] = len(parameters) > 2 or any("*" in str(parameter) for parameter in parameters.values())
    seen["means"] = plain([mean(obs), mean(obs)])
    seen["samples"] = plain([act(obs)[0], act(obs)[0]])
    given = mean(obs) + 0.5
    of_given = act(obs, given)
    seen["given"], seen["of_given"] = plain(given), plain(of_given)
    seen["of_sample"] = plain([answer[1], act(obs, answer[0].detach())[1]])
    seen["rows"] = plain([mean(obs)[:2], mean(obs[:2]), made.value(obs)[:2], made.value(obs[:2])])
    outputs = {"critic": made.value(obs), "joint": of_given[3], "actor": of_given[1], "sigma": of_given[2]}
    seen |= {what: _used(made, output) for what, output in outputs.items()}
    seen["parameters"] = {name: plain(parameter) for name, parameter in made.named_parameters()}
    weights = {name: parameter.detach() for name, parameter in made.named_parameters() if parameter.dim() == 2}
    seen["gains"] = {name: torch.linalg.svdvals(weight.float()).tolist() for name, weight in weights.items()}
    seen["bends"] = [_bend(made.value, obs), _bend(mean, obs)]
    with torch.no_grad():
        for name, parameter in made.named_parameters():
            parameter += 0.3 * (name in seen["sigma"])
    seen["wider"] = plain(act(obs, given)[1:3])
    seen["spread"] = plain((act(rows)[0] - mean(rows)).std(0))
    seen["reach"] = plain(_reach(made, lambda: made.value(obs).reshape(B)))


def agent(seen: Seen) -> Iterator[str]:
    """Sentences on an agent: shapes, distribution, separate networks, first weights."""
    if "answer" not in seen and 2 * O in seen["widths"]:
        yield (
            f"a layer is made for {2 * O} observations; each of the 2 environments has {O}. Likely: the shape is that"
            " of observation_space, which is of all environments; single_observation_space is of one."
        )
    yield from _answers(seen)
    yield from _distribution(seen)
    yield from _all_saved(seen)
    for what, tensors in (("mean", seen["rows"][:2]), ("value", seen["rows"][2:])):
        if not close(*tensors):
            yield f"the {what} of a row depends on the other rows of its batch."
    yield from _gradient("value(x)", seen["critic"])
    yield from _gradient("the value of action_and_value", seen["joint"])
    if shared := set(seen["critic"]) & set(seen["actor"]):
        yield f"the critic and the actor share {min(shared)}. Likely: one trunk for both; they are separate networks."
    yield from _gradient("the log-probability", set(seen["actor"]) - set(seen["sigma"]))
    yield from _initialization(seen, "critic", 1.0)
    yield from _initialization(seen, "actor", 0.01)
    for what, bend in zip(("critic", "actor"), seen["bends"], strict=True):
        if bend < 1e-4:
            yield f"the {what} is linear in the observations. Likely: there are no activations between its layers."
    yield from _sigma(seen)
    yield from _unbounded("the value", seen)


def _answers(seen: Seen) -> Iterator[str]:
    """Sentences on what `value` and `action_and_value` take and return."""
    if not isinstance(seen["answer"], list) or len(seen["answer"]) != 4:
        yield "action_and_value should return action, log-probability, entropy and value."
    action, log_prob, entropy, value = seen["answer"]
    yield from _shape(f"for {B} observations of {A} actions the action", action, (B, A))
    causes = {(B, A): ".sum(1) is missing", (B, 1): "keepdim=True", (A,): ".sum(0) in place of .sum(1)"}
    causes[()] = ".sum() adds up the rows, too; .sum(1)"
    for name, tensor in (("log-probability", log_prob), ("entropy", entropy)):
        likely = causes.get(tuple(getattr(tensor, "shape", (0,))))
        yield from _shape(f"the {name}", tensor, (B,), likely=f" Likely: {likely}." if likely else "")
    yield from _shape("value(x)", seen["value"], (B, 1), (B,))
    yield from _shape("the value of action_and_value", value, (B, 1), (B,))
    if not close(value.flatten(), seen["value"].flatten()):
        yield "the value of action_and_value is another one than value(x)."
    if not seen["has_mode"]:
        yield "action_and_value takes no deterministic; an evaluation asks for the mean with deterministic=True."


def _distribution(seen: Seen) -> Iterator[str]:
    if not close(*seen["means"]):
        yield "with deterministic=True the action is drawn. Likely: the sample is returned, not the mean."
    if seen["samples"][0].tolist() == seen["samples"][1].tolist():
        yield "the action is the same each time. Likely: the mean is returned, not a sample."
    action, log_prob, entropy, _ = seen["of_given"]
    if not close(action, seen["given"]):
        yield "another action is returned than the one that was given. Likely: it is drawn again, or clipped."
    one = -math.log(2 * math.pi) / 2
    want, wanted_entropy = A * (one - 0.125), A * (0.5 - one)
    causes = {
        ".mean(1) in place of .sum(1)": want / A,
        "log-probability and entropy are exchanged": wanted_entropy,
        "it is the probability, without the logarithm": math.exp(want),
        "its sign": -want,
        "it is that of the mean, not of the action": A * one,
    }
    if not close(log_prob, [want] * B, 1e-3):
        yield (
            f"half a unit from the mean the log-probability is {log_prob[0]:.4g}; with σ = 1 it is {want:.4g}."
            + _likely(float(log_prob[0]), causes, "log σ does not begin at 0, or is taken for σ")
        )
    if not close(entropy, [wanted_entropy] * B, 1e-3):
        causes = {".mean(1) in place of .sum(1)": wanted_entropy / A, "it is −log π": -want}
        yield (
            f"the entropy is {entropy[0]:.4g}; of {A} Gaussians with σ = 1 it is {wanted_entropy:.4g}."
            + _likely(float(entropy[0]), causes)
        )
    of_sample, again = seen["of_sample"]
    if not close(of_sample, again, 1e-3, 1e-3):
        yield "the log-probability of a sample is that of another action. Likely: of the mean, or of a second sample."


def _sigma(seen: Seen) -> Iterator[str]:
    """Sentences on log σ, and where after a change of it not all is of the same Gaussian."""
    size = sum(seen["parameters"][name].numel() for name in seen["sigma"])
    if not size:
        yield "no parameter is a log σ of the actions. Likely: it is a tensor; nn.Parameter is trained and saved."
    if size != A:
        yield f"log σ has {size} parameters; it should have one for each of the {A} actions, whatever the state."
    log_prob, entropy = (float(tensor[0]) for tensor in seen["wider"])
    log_std = (entropy - A * (math.log(2 * math.pi) + 1) / 2) / A
    want = -A * (math.log(2 * math.pi) / 2 + log_std + 0.125 * math.exp(-2 * log_std))
    if not close(log_prob, want, 1e-3):
        yield "for another log σ log-probability and entropy differ in σ. Likely: the exponential of one of them."
    if not close(seen["spread"], [math.exp(log_std)] * A, 0.15):
        wide = f"the samples spread by {_shown(seen['spread'])} where the entropy is of σ = {math.exp(log_std):.3g}"
        yield f"{wide}. Likely: they are drawn with another σ."
    causes = {"the exponential is missing": math.log(1.3), "σ stands for σ²": 0.15, "σ² stands for σ": 0.6}
    if likely := _likely(log_std, causes | {"log and exponential are missing": math.log(1.3) / 2}):
        yield f"log σ changes by {log_std:.2g} where its parameter does by 0.3.{likely}"


def _initialization(seen: Seen, what: str, last_gain: float) -> Iterator[str]:
    names = [name for name in seen[what] if what == "critic" or name not in seen["sigma"]]
    for name in names:
        first, layer = seen["parameters"][name], name.removesuffix(".weight")
        if name in seen["gains"]:
            found, is_last = seen["gains"][name], min(first.shape) in (1, A)
            gain, shown = (last_gain, f"{last_gain:g}") if is_last else (math.sqrt(2), "√2")
            mean = sum(found) / len(found)
            if not close(found, [mean] * len(found), 1e-3, 0):
                yield f"{layer}, of the {what}, is not orthogonal. Likely: nn.init.orthogonal_ with {shown} is missing."
            if not close(mean, gain, 1e-2, 0):
                why = " so that the first actions hardly depend on the state" if is_last and last_gain < 1 else ""
                yield f"{layer}, of the {what}, has the gain {mean:.3g}; it should be {shown}{why}."
        if name.endswith("bias") and first.abs().max() > 0:
            layer = name.removesuffix(".bias")
            yield f"the bias of {layer}, of the {what}, does not begin at 0. Likely: nn.init.constant_(layer.bias, 0)."


def see_actor(network: Function, seen: Seen) -> None:
    """`Actor(env)` of DDPG: μ(s) between the bounds of the actions."""
    made = _for_one(network, lambda made: made(_obs(made)), seen)
    obs = _obs(made, 100)
    seen["saved"] = _saved(network, made, _envs(1, LOW, HIGH, seen["is_vector"]), lambda actor: actor(obs))
    seen["rows"] = plain([made(obs)[:2], made(obs[:2])])
    seen["action"], seen["again"] = plain(made(obs)), plain(made(obs))
    seen["used"] = _used(made, made(obs))
    seen["trained"] = [plain(parameter) for parameter in made.parameters() if parameter.requires_grad]
    seen["reach"] = plain(_reach(made, lambda: made(obs)))
    _redraw(made, 0.02)  # so that what goes into tanh is close to 0
    seen["middle"] = plain(made(obs).mean(0))
    _redraw(made, 0.05)
    moved = obs.clone().requires_grad_()
    slopes = [_slope(column.sum(), moved) for column in made(moved).unbind(1)]
    seen["moves"] = [bool(slope.any()) for slope in slopes]
    low, high = torch.from_numpy(LOW), torch.from_numpy(HIGH)

    def inner(x: Tensor) -> Tensor:
        return torch.atanh(((2 * made(x) - low - high) / (high - low)).clamp(-0.999999, 0.999999))

    seen["inner"] = plain(inner(obs))
    seen["bend"] = _bend(inner, obs)
    seen["buffers"] = {name: list(buffer.shape) for name, buffer in made.named_buffers()}
    held = [vars(module).items() for module in made.modules()]
    seen["loose"] = [name for items in held for name, value in items if isinstance(value, Tensor)]


def actor(seen: Seen) -> Iterator[str]:
    """Sentences on an actor: bounds, dependence on the state, buffers."""
    yield from _shape("for 100 observations the action", seen["action"], (100, A))
    if not close(seen["action"], seen["again"]):
        yield "for one state the action differs each time. Likely: noise for exploration, which the loop adds."
    yield from _all_saved(seen)
    if not close(*seen["rows"]):
        yield "the action of a state depends on the other states of its batch."
    yield from _gradient("the action", seen["used"])
    yield from _bounds(seen)
    if not all(seen["moves"]):
        yield f"action {seen['moves'].index(False)} does not depend on the state."
    if all(close(seen["inner"][:, 0], column) for column in seen["inner"].T):
        yield "all actions are one share of their range. Likely: the last layer has one output, not one for each."
    if seen["bend"] < 1e-4:
        yield "without tanh the actions are linear in the state. Likely: there are no activations between the layers."
    if seen["loose"]:
        said = f"{seen['loose'][0]} is neither saved nor moved to a GPU with it. Likely: it is no register_buffer."
        yield Note(said) if seen["buffers"] else said
    if batched := [name for name, shape in seen["buffers"].items() if shape == [1, A]]:
        yield Note(
            f"{batched[0]} has shape [1, {A}], from the action space of all environments; with more of them a"
            " checkpoint would not fit. That of one is single_action_space."
        )
    yield from _single(seen)


def _bounds(seen: Seen) -> Iterator[str]:
    """Sentences where the actions do not reach from the lower to the upper bounds, or would not in training."""
    scale, bias, one = (HIGH - LOW) / 2, (HIGH + LOW) / 2, np.ones(A, np.float32)
    trained = [values.flatten() for values in seen["trained"]]
    if any(close(values, numbers.tolist()) for values in trained for numbers in (scale, bias, LOW, HIGH)):
        yield "the bounds of the actions are parameters, which training changes. Likely: nn.Parameter; register_buffer."
    causes = {
        "action_bias is missing": (-scale, scale),
        "the output of tanh is not scaled": (-one, one),
        "action_scale is missing": (bias - 1, bias + 1),
        "the scale is half of high − low": (bias - 2 * scale, bias + 2 * scale),
        "the bias is half of high + low": (2 * bias - scale, 2 * bias + scale),
        "high alone is the scale, as if bounds were symmetric": (-HIGH, HIGH),
        "the bounds of the first action are taken for all": (LOW[0] * one, HIGH[0] * one),
        "high of the first action is taken for all": (-HIGH[0] * one, HIGH[0] * one),
        "scale and bias are exchanged": (scale - abs(bias), scale + abs(bias)),
        "sigmoid in place of tanh": (bias, HIGH),
        "low is not added": (0 * one, HIGH - LOW),
    }
    low, high = seen["reach"].tolist()
    otherwise = "there is no tanh" if max(high) > 100 else "they do not depend on the state" if low == high else ""
    likely = _likely([low, high], {words: [a.tolist(), b.tolist()] for words, (a, b) in causes.items()}, otherwise)
    if not close([low, high], [LOW.tolist(), HIGH.tolist()], 0, 0.1):
        is_inside = (low > LOW - 0.1).all() and (high < HIGH + 0.1).all()
        reach, bounds = f"from {_shown(low)} to {_shown(high)}", f"{_shown(LOW)} and {_shown(HIGH)}"
        yield f"the actions reach {'only ' if is_inside else ''}{reach}; the bounds are {bounds}.{likely}"
    if not close(seen["middle"], bias.tolist(), 0, 0.3):
        yield (
            f"with small weights the actions are {_shown(seen['middle'])}; the middle of the bounds is {_shown(bias)}."
            " Likely: clamp in place of tanh, whose gradient is 0 beyond the bounds."
        )


def _single(seen: Seen) -> Iterator[str]:
    if not seen["is_vector"]:
        yield Note("it fits a single environment; of a vector the spaces of one are single_observation_space and such.")


def see_q_network(network: Function, seen: Seen) -> None:
    """`QNetwork(env)` of DDPG: Q(s, a), [B, 1]."""

    def q(made: Any, pairs: Tensor) -> Tensor:
        return made(pairs[:, :O], pairs[:, O:])  # by position, as every loop calls it

    made = _for_one(network, lambda made: q(made, _obs(made, size=O + A)), seen)
    pairs = _obs(made, size=O + A).requires_grad_()
    seen["saved"] = _saved(network, made, _envs(1, LOW, HIGH, seen["is_vector"]), lambda network: q(network, pairs))
    seen["q"] = plain(q(made, pairs))
    seen["used"] = _used(made, q(made, pairs))
    _redraw(made, 0.05)
    values = q(made, pairs)
    seen["slopes"], seen["of_first"] = (plain(_slope(output, pairs)) for output in (values.sum(), values[0].sum()))
    seen["bend"] = _bend(lambda rows: q(made, rows), pairs.detach())
    seen["reach"] = plain(_reach(made, lambda: q(made, pairs).reshape(B)))


def q_network(seen: Seen) -> Iterator[str]:
    """Sentences on a Q network: shape, dependence on state and action, range."""
    yield from _shape(f"Q of {B} pairs", seen["q"], (B, 1), (B,))
    yield from _all_saved(seen)
    yield from _gradient("Q", seen["used"])
    slopes = seen["slopes"].abs().sum(0).tolist()
    for what, parts in (("state", slopes[:O]), ("action", slopes[O:])):
        if not any(parts):
            yield f"Q does not depend on the {what}. Likely: torch.cat([x, a], 1) is missing."
        if not all(parts):
            yield f"Q does not depend on element {parts.index(0)} of the {what}."
    if any(seen["of_first"][1:].flatten().tolist()):
        yield "Q of a pair depends on the other pairs of its batch."
    if seen["bend"] < 1e-4:
        yield "Q is linear in state and action. Likely: there are no activations between the layers."
    yield from _unbounded("Q", seen)
    yield from _single(seen)


PROBS = (0.125, 0.25, 0.625)


def see_sample_categorical(function: Function, seen: Seen) -> None:
    """`sample_categorical(probs [B, d])`, [B] of whole numbers."""
    probs = torch.tensor(PROBS).repeat(6000, 1)
    seen["drawn"], seen["again"] = plain(function(probs)), plain(function(probs))
    seen["certain"] = plain(function(torch.eye(3)[[2, 0, 1, 1]]))
    seen["one"] = plain(function(probs[:1]))
    function(probs[:2].requires_grad_())  # as from a network


def sample_categorical(seen: Seen) -> Iterator[str]:
    """Sentences on samples of categories: kind, shares, independence."""
    drawn = seen["drawn"]
    if not isinstance(drawn, Tensor) or drawn.dtype.is_floating_point:
        yield "it should return a tensor of whole numbers, to be used as indices."
    likely = " Likely: .squeeze(1) is missing." if drawn.shape == (6000, 1) else ""
    yield from _shape("of 6000 rows it", drawn, (6000,), likely=likely)
    counts = Counter(drawn.tolist() + seen["again"].tolist())
    if not set(counts) <= {0, 1, 2}:
        yield f"of three probabilities it draws {sorted(counts)}; indices are 0, 1, 2."
    if len(counts) == 1:
        yield "the action is always the same. Likely: argmax; or one draw for all rows."
    shares, powers = [counts[index] / 12000 for index in range(3)], [math.exp(share) for share in PROBS]
    causes = {
        "the probabilities are not used": [1 / 3] * 3,
        "they are exchanged, as by a comparison the wrong way round": [*PROBS[::-1]],
        "softmax once too often": [power / sum(powers) for power in powers],
    }
    if not close(shares, list(PROBS), 0, 0.025):
        likely = _likely(shares, causes, atol=0.02)
        yield f"with probabilities {', '.join(map(str, PROBS))} the shares are {_shown(shares)}.{likely}"
    if close(drawn, seen["again"]):
        yield "a second call draws the same. Likely: a seed is set in it."
    if not close(seen["certain"], [2, 0, 1, 1]):
        yield "rows are not drawn each by its own probabilities."
    yield from _shape("of one row it", seen["one"], (1,), likely=" Likely: .squeeze(); .squeeze(1) leaves the rows.")


# --- the replay buffer ---

SIZE = 6
COLUMNS = {
    "obs": "obs observations observation states state s x",
    "next_obs": "next_obs next_observations next_observation next_states next_state new_obs obs_next obs2 s2",
    "action": "action actions act acts a",
    "reward": "reward rewards rew rews r",
    "done": "done dones terminated terminations terminal terminals d",
}
"""each part of a transition, and what else it is called"""
ALIASES = {name: column for column, names in COLUMNS.items() for name in names.split()}
INFOS = "infos info"


def _rows(*numbers: int) -> dict[str, np.ndarray]:
    """Transitions in which every part says which one it is; every third one ends."""
    column = np.array(numbers, dtype=np.float32)
    obs = np.stack([column, column], axis=1)
    return dict(zip(COLUMNS, (obs, obs + 0.5, column[:, None] / 10, -column / 4, column % 3 == 0), strict=True))


def _add(buffer: Any, rows: Mapping[str, np.ndarray], infos: Any) -> None:
    call_by_name(buffer.add, {COLUMNS[name]: value for name, value in rows.items()} | {INFOS: infos})


def _columns(batch: Any) -> dict[str, np.ndarray]:
    """The parts of a sample: attributes, or entries of a dictionary."""
    if not isinstance(batch, Mapping):
        batch = {name: getattr(batch, name) for name in ALIASES if hasattr(batch, name)}
    fields = {names.split()[1]: column for column, names in COLUMNS.items()}
    names = fields if "observations" in batch else ALIASES
    parts = {column: np.atleast_1d(plain(batch[name])) for name, column in names.items() if name in batch}
    if missing := [name for name, column in fields.items() if column not in parts]:
        raise AttributeError(f"what sample returns has no {missing[0]}")
    return parts


def _sampled(buffer: Any, rows: int, times: int) -> dict[str, Tensor]:
    """Many samples, [times, rows, …] each, by column; each of no more rows than there are."""
    batches = [_columns(buffer.sample(rows)) for _ in range(times)]
    return {name: torch.as_tensor(np.stack([batch[name] for batch in batches]).astype(float)) for name in COLUMNS}


def see_replay_buffer(buffer: Function, seen: Seen) -> None:
    """`ReplayBuffer(buffer_size, observation_space, action_space)` with `add` and `sample`."""
    # A vector environment gives one dictionary; Stable-Baselines3 asks for a list of them.
    first_that_works(_see_replay_buffer, (buffer, seen, {}), (buffer, seen, [{}]))


def _see_replay_buffer(buffer: Function, seen: Seen, infos: Any) -> None:
    box, act = spaces.Box(-np.inf, np.inf, (2,), np.float32), spaces.Box(-1, 1, (1,), np.float32)
    sizes = "buffer_size capacity size max_size maxlen max_len memory_size"
    needed = {sizes: SIZE, "observation_space obs_space state_space": box, "action_space act_space": act}
    offered = {"device": "cpu", "handle_timeout_termination": False}
    offered |= {"obs_dim state_dim": 2, "action_dim act_dim": 1, "obs_shape": (2,), "action_shape act_shape": (1,)}
    made = call_by_name(buffer, needed, offered | {"n_envs num_envs": 1})
    seen["order"] = [ALIASES[name] for name in inspect.signature(made.add).parameters if name in ALIASES]
    rows = [_rows(number) for number in range(1, 10)]
    for row in rows[:2]:
        _add(made, row, infos)
    for name in ("obs", "next_obs", "action", "reward"):
        rows[0][name] += 100  # as an environment does that writes over its own arrays
    rows[0]["done"][:] = True
    seen["two"] = _sampled(made, 2, 200)
    for row in rows[2:]:
        _add(made, row, infos)
    seen["nine"] = _sampled(made, 3, 400)
    seen["pairs"] = {}
    with suppress(Exception):  # it may be for one environment
        made = call_by_name(buffer, needed, offered | {"n_envs num_envs": 2})
        for number in (1, 3, 5, 7):
            _add(made, _rows(number, number + 1), infos and infos * 2)
        seen["pairs"] = _sampled(made, 3, 400)


def replay_buffer(seen: Seen) -> Iterator[str]:
    """Sentences on a replay buffer: copies, places, whole rows, equal chances."""
    order = [name for name in seen["order"] if name != "next_obs"]  # which has many places
    if len(seen["order"]) == len(COLUMNS) and order != ["obs", "action", "reward", "done"]:
        yield f"add takes {', '.join(seen['order'])}; a loop calls rb.add({', '.join(COLUMNS)}, infos)."
    for when, rows in (("two", 2), ("nine", 3)):
        for name, values in seen[when].items():
            right = (rows, 2 if "obs" in name else 1)
            yield from _shape(f"{name} of {rows} sampled rows", values[0].reshape(values.shape[1], -1), right)
    yield from _after_two(_flat(seen["two"]))
    yield from _after_nine(_flat(seen["nine"]))
    if len({tuple(sorted(rows)) for rows in seen["nine"]["obs"].flatten(2)[..., 0].tolist()}) < 15:
        yield "rows of a batch belong together. Likely: one row is repeated, or neighbours are taken."
    if seen["pairs"]:
        yield from _of_pairs(_flat(seen["pairs"]))
    if seen["nine"]["obs"].dim() > 3:
        yield Note(f"observations of 3 rows has shape {[*seen['nine']['obs'].shape[1:]]}; networks take [3, 2].")


def _flat(sampled: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The rows of many samples, one after the other."""
    return {name: values.reshape(len(values) * values.shape[1], -1) for name, values in sampled.items()}


def _after_two(batch: dict[str, Tensor]) -> Iterator[str]:
    """Two rows were stored, and the arrays of the first were changed."""
    numbers = set(batch["obs"].flatten().tolist())
    if numbers & {1.5, 2.5}:
        yield "obs is that of the successor. Likely: obs and next_obs are exchanged."
    if numbers - {1.0, 2.0, 101.0}:
        yield "rows that were never written are sampled. Likely: it draws from the whole capacity."
    changed, second = (101, 101.5, 100.1, 99.75, 1), (2, 2.5, 0.2, -0.5, 0)
    for name, *values in zip(COLUMNS, changed, second, strict=True):
        found = batch[name].flatten().tolist()
        if all(any(close(number, value) for number in found) for value in values):
            yield f"{name} of a stored row changed with the array that it came from. Likely: it is not copied."
    if len(numbers) < 2:
        yield "of two stored rows one was found in 400 samples. Likely: the last one is not drawn, or not kept."


def _of_pairs(batch: dict[str, Tensor]) -> Iterator[str]:
    """Rows 1 to 8 were stored, of two environments; 3 to 8 have places."""
    numbers = {*batch["obs"][:, 0].tolist()}
    if not numbers & {2, 4, 6, 8}:
        yield Note("it is for one environment: of several it keeps the first alone.")
    elif not {*range(3, 9)} <= numbers:
        was = ", ".join(f"{number:g}" for number in sorted(numbers))
        yield f"of rows 1 to 8, of two environments, it holds {was}. Likely: one environment's takes the other's place."
    yield from _mixed_rows(batch)


def _after_nine(batch: dict[str, Tensor]) -> Iterator[str]:
    """Nine rows went into six places: 4 to 9 are left."""
    counts = Counter(batch["obs"][:, 0].tolist())
    if set(counts) != (held := set(range(4, 10))):
        was = ", ".join(f"{number:g}" for number in sorted(counts))
        why = "some places are never drawn" if set(counts) < held else "the oldest rows are not overwritten"
        why = "the last place is never used, or sampled" if len(counts) == 5 else why
        yield f"after nine rows in six places it holds {was}; it should hold 4 to 9. Likely: {why}."
    if max(counts.values()) > 1.6 * min(counts.values()):
        yield "some rows are sampled much more often than others; each should be as likely as any other."
    yield from _mixed_rows(batch)


def _mixed_rows(batch: dict[str, Tensor]) -> Iterator[str]:
    """Sentences where the parts of a row are not of one transition."""
    numbers = batch["obs"][:, 0].tolist()
    right = {"action": [number / 10 for number in numbers], "reward": [-number / 4 for number in numbers]}
    right |= {"next_obs": [number + 0.5 for number in numbers], "done": [float(number % 3 == 0) for number in numbers]}
    for name, want in right.items():
        values = batch[name][:, 0].tolist()
        others = {"its sign": [-value for value in want], "it is 1 − done": [1 - value for value in want]}
        others |= {f"it is {other}": column[:, 0] for other, column in batch.items() if other != name}
        others |= {"it is the next row's obs": [number + 1 if number < 9 else 4 for number in numbers]}
        if not close(values, want):
            is_torn = {round(value, 3) for value in values} <= {round(value, 3) for value in want}
            likely = _likely(values, others, "each part is drawn by indices of its own" if is_torn else "")
            yield f"{name} is of another row than obs.{likely}"


def see_add_to_replay(function: Function, seen: Seen) -> None:
    """`add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos)`, after each step.

    The environments are SAME_STEP: where one has ended, `next_obs` is the first of the next episode.
    """
    for end in ENDS:
        seen[end] = first_that_works(_replayed, (function, end, object), (function, end, float))


GOING_ON, FIRST_OF_NEXT, LAST = [[5.0, 5.0]], [[7.0, 7.0], [8.0, 8.0]], [[3.0, 3.0], [4.0, 4.0]]
ENDS = {"row within an episode": (0, 0), "death": (1, 0), "time-out": (0, 1), "death at the time limit": (1, 1)}


def _replayed(function: Function, end: str, kind: type) -> dict[str, Any]:
    """The rows added when two of three environments end; their last observations are in an array of that kind."""
    stored: list[dict[str, Any]] = []

    def add(*args: Any, **named: Any) -> None:
        columns = dict(zip((*COLUMNS, "infos"), args, strict=False))
        stored.append(plain(columns | {ALIASES.get(name, name): value for name, value in named.items()}))

    terminated, truncated = (np.array([False, flag, flag], bool) for flag in ENDS[end])
    number = np.arange(1, 4, dtype=np.float32)
    final = np.array([None, *np.array(LAST, np.float32)] if kind is object else [[0, 0], *LAST], kind)
    given = {
        "rb buffer replay_buffer memory": SimpleNamespace(add=add),
        COLUMNS["obs"]: np.stack([number, number], axis=1),
        COLUMNS["action"]: number[:, None] / 10,
        COLUMNS["next_obs"]: np.array(GOING_ON + (FIRST_OF_NEXT if any(ENDS[end]) else LAST), np.float32),
        COLUMNS["reward"]: -number / 4,
        COLUMNS["done"]: terminated,
        "truncations truncated truncs": truncated,
        INFOS: {"final_obs": final, "_final_obs": np.array([False, True, True])} if any(ENDS[end]) else {},
    }
    call_by_name(function, given)
    return {"stored": stored, "next_obs": plain(given[COLUMNS["next_obs"]])}


def add_to_replay(seen: Seen) -> Iterator[str]:
    """Sentences on the rows that were added."""
    for end in ENDS:
        if "final_observation" in seen.get("raised", "") and end not in seen:
            yield "infos has no final_observation: since Gymnasium 1.0 it is called final_obs."
        stored = seen[end]["stored"]
        rows = {name: [np.ravel(row.get(name, ())) for row in stored] for name in COLUMNS}
        columns = {name: np.concatenate(values).tolist() if values else [] for name, values in rows.items()}
        if len(stored) != 1 and len(columns["reward"]) != 3:
            yield f"it adds {len(stored)} times; one call of rb.add has the rows of all environments."
        if missing := [name for name in (*COLUMNS, "infos") if any(name not in row for row in stored)]:
            yield f"rb.add(obs, next_obs, action, reward, done, infos) was not given {missing[0]}."
        yield from _given(columns)
        yield from _stored(columns, end)
        if seen[end]["next_obs"].tolist() != GOING_ON + (FIRST_OF_NEXT if any(ENDS[end]) else LAST):
            yield "next_obs itself is changed, with which the loop goes on. Likely: .copy() is missing."


def _given(columns: dict[str, list[float]]) -> Iterator[str]:
    """Sentences where a column that needs no change is not the step's."""
    right = {"obs": [1, 1, 2, 2, 3, 3], "action": [0.1, 0.2, 0.3], "reward": [-0.25, -0.5, -0.75]}
    for name, want in right.items():
        if not close(columns[name], want):
            likely = f" Likely: the order of the arguments, which is {', '.join((*COLUMNS, 'infos'))}."
            others = [*right.values(), np.ravel(GOING_ON + LAST).tolist()]
            if len(columns[name]) == len(want) and not any(close(columns[name], other) for other in others):
                likely = ""
            yield f"{name} is not that of the step.{likely}"


def _stored(columns: dict[str, list[float]], end: str) -> Iterator[str]:
    """Sentences where the ends or the successors are wrong."""
    ended, next_obs = [bool(done) for done in columns["done"]], columns["next_obs"]
    if any(ended) and end == "time-out":
        yield "a time-out is stored as done. Likely: terminated | truncated; done is terminated alone."
    if ended != [False, *[bool(ENDS[end][0])] * 2]:
        yield f"a {end} is stored with done = {ended[-1]}, and a row within an episode with {ended[0]}."
    if next_obs[2:] != np.ravel(LAST).tolist():
        said = f"the successor of a {end} is stored as the first observation of the next episode. Likely:"
        if end == "time-out":
            yield f'{said} infos["final_obs"] is not used.'
        yield Note(f"{said} final_obs is used at time-outs alone. After a death the target does not look at it.")
    if next_obs[:2] != [5, 5]:
        yield "the successor of the other environment, which goes on, was changed."
