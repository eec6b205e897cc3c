"""Exercises on the networks of an agent: shapes, initialization, distributions, bounds."""

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from torch import Tensor, nn

from lemniscate.course.exercise import Function, Note, call_by_name

O, A, B = 7, 3, 5
LOW, HIGH = np.array([-2, 0, 1], np.float32), np.array([1, 4, 3], np.float32)


def spaces_of(num_envs: int, low: np.ndarray, high: np.ndarray) -> Any:
    """The spaces of a vector environment as an agent sees them, with O observations and A actions between bounds."""
    observation, action = spaces.Box(-np.inf, np.inf, (O,), np.float32), spaces.Box(low, high)
    return SimpleNamespace(
        num_envs=num_envs,
        single_observation_space=observation,
        single_action_space=action,
        observation_space=batch_space(observation, num_envs),
        action_space=batch_space(action, num_envs),
    )


def _make(network: Function, envs: Any) -> Any:
    """The agent for these environments, whatever its constructor calls them."""
    return call_by_name(network, envs=envs, env=envs, vec_env=envs)


def _obs() -> Tensor:
    return torch.randn(B, O, generator=torch.Generator().manual_seed(0))


def agent(network: Function) -> Iterator[str]:
    """`Agent(envs)` with `value(x)` and `action_and_value(x, action=None, deterministic=False)`."""
    made = _make(network, spaces_of(2, -np.ones(A, np.float32), np.ones(A, np.float32)))
    obs = _obs()
    answer = made.action_and_value(obs)
    if not isinstance(answer, tuple) or len(answer) != 4:
        yield "action_and_value should return action, log-probability, entropy and value."
        return
    yield from _shapes(made, answer, obs)
    yield from _distribution(made, obs)
    value, mean = made.value(obs), made.action_and_value(obs, deterministic=True)[0]
    critic, actor = _parameters_of(made, value.sum()), _parameters_of(made, made.action_and_value(obs, mean)[1].sum())
    if shared := critic & actor:
        yield f"the critic and the actor share {min(shared)}. Likely: one trunk for both; they are separate networks."
    yield from _initialization(made, "critic", critic, 1.0)
    yield from _initialization(made, "actor", actor, 0.01)
    yield from _log_std(made)


def _shapes(made: Any, answer: tuple[Tensor, ...], obs: Tensor) -> Iterator[str]:
    action, log_prob, entropy, value = answer
    if action.shape != (B, A):
        yield f"for {B} observations of {A} actions the action has shape {list(action.shape)}; it should be [{B}, {A}]."
    for name, tensor in (("log-probability", log_prob), ("entropy", entropy)):
        if tensor.shape == (B, A):
            yield f"the {name} has shape [{B}, {A}]. Likely: .sum(1) is missing."
        elif tensor.shape != (B,):
            yield f"the {name} has shape {list(tensor.shape)}; it should be [{B}]."
    for name, tensor in (("value(x)", made.value(obs)), ("the value of action_and_value", value)):
        if tensor.shape not in {(B,), (B, 1)}:
            yield f"{name} has shape {list(tensor.shape)}; it should be [{B}, 1]."


def _distribution(made: Any, obs: Tensor) -> Iterator[str]:
    mean = made.action_and_value(obs, deterministic=True)[0]
    if not torch.equal(mean, made.action_and_value(obs, deterministic=True)[0]):
        yield "with deterministic=True the action is drawn. Likely: the sample is returned, not the mean."
    if torch.equal(made.action_and_value(obs)[0], made.action_and_value(obs)[0]):
        yield "the action is the same each time. Likely: the mean is returned, not a sample."
    given = mean.detach() + 0.5
    action, log_prob, entropy, _ = made.action_and_value(obs, given)
    if not torch.equal(action, given):
        yield "another action is returned than the one that was given. Likely: it is drawn again."
    want = torch.full((B,), -A * (0.5 * 0.25 + 0.5 * math.log(2 * math.pi)))
    if not torch.allclose(log_prob, want, atol=1e-4):
        yield (
            f"half a unit from the mean the log-probability is {log_prob[0]:.4g}; with σ = 1 it is {want[0]:.4g}."
            " Likely: log σ does not begin at 0, or is taken for σ."
        )
    if not torch.allclose(entropy, torch.full((B,), A * 0.5 * math.log(2 * math.pi * math.e)), atol=1e-4):
        yield f"the entropy is {entropy[0]:.4g}; of {A} Gaussians with σ = 1 it is {A * 1.4189385:.4g}."


def _parameters_of(made: Any, output: Tensor) -> set[str]:
    """The names of the parameters on which an output depends."""
    names, parameters = zip(*made.named_parameters(), strict=True)
    slopes = torch.autograd.grad(output, parameters, allow_unused=True)
    return {name for name, slope in zip(names, slopes, strict=True) if slope is not None}


def _initialization(made: Any, what: str, names: set[str], last_gain: float) -> Iterator[str]:
    layers = [(name, module) for name, module in made.named_modules() if isinstance(module, nn.Linear)]
    layers = [(name, module) for name, module in layers if f"{name}.weight" in names]
    for name, layer in layers:
        is_last = name == layers[-1][0]
        gain, shown = (last_gain, f"{last_gain:g}") if is_last else (math.sqrt(2), "√2")
        found = torch.linalg.svdvals(layer.weight.detach())
        if not torch.allclose(found, found.mean().expand_as(found), rtol=1e-3):
            yield f"{name}, of the {what}, is not orthogonal. Likely: nn.init.orthogonal_ with {shown} is missing."
        elif not torch.allclose(found, torch.full_like(found, gain), rtol=1e-2):
            why = " so that the first actions hardly depend on the state" if is_last and last_gain < 1 else ""
            yield f"{name}, of the {what}, has the gain {found.mean():.3g}; it should be {shown}{why}."
        if layer.bias is not None and layer.bias.abs().max() > 0:
            yield f"the bias of {name}, of the {what}, does not begin at 0. Likely: nn.init.constant_(layer.bias, 0)."


def _log_std(made: Any) -> Iterator[str]:
    own = [name for name, parameter in made.named_parameters() if parameter.numel() == A and "bias" not in name]
    if not own:
        yield "no parameter is a log σ of the actions. Likely: it is a tensor; nn.Parameter is trained and saved."


def actor(network: Function) -> Iterator[str]:
    """`Actor(env)` of DDPG: μ(s) between bounds that are neither −1 and 1 nor symmetric."""
    made = _make(network, spaces_of(1, LOW, HIGH))
    obs = 100 * torch.randn(2000, O, generator=torch.Generator().manual_seed(0))
    action = made(obs)
    if action.shape != (2000, A):
        yield f"for 2000 observations the action has shape {list(action.shape)}; it should be [2000, {A}]."
        return
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.mul_(3)  # far enough that tanh is at its ends
        low, high = made(obs).amin(0), made(obs).amax(0)
    bounds = torch.from_numpy(LOW), torch.from_numpy(HIGH)
    if (low < bounds[0] - 1e-3).any() or (high > bounds[1] + 1e-3).any():
        said = (
            f"the actions reach from {_shown(low)} to {_shown(high)}; the bounds are {_shown(LOW)} and {_shown(HIGH)}."
        )
        inside = torch.allclose(-low, high, atol=0.1)
        cause = "action_bias is missing" if inside and high.max() > 1.01 else "the output of tanh is not scaled"
        yield f"{said} Likely: {cause if inside else 'there is no tanh'}."
    elif (low > bounds[0] + 0.3).any() or (high < bounds[1] - 0.3).any():
        yield f"the actions reach only from {_shown(low)} to {_shown(high)}, not to {_shown(LOW)} and {_shown(HIGH)}."
    parameters, saved = dict(made.named_parameters()), made.state_dict()
    scales = [name for name in saved if name not in parameters]
    if not scales:
        yield "scale and bias of the actions are not saved with it. Likely: they are no buffers: register_buffer."
    if any(saved[name].shape == (1, A) for name in scales):
        yield Note(
            f"{scales[0]} has shape [1, {A}], from the action space of all environments; with more of them a checkpoint"
            " would not fit. That of one is single_action_space."
        )


def _shown(numbers: Any) -> str:
    return "(" + ", ".join(f"{float(number):.3g}" for number in numbers) + ")"


def q_network(network: Function) -> Iterator[str]:
    """`QNetwork(env)` of DDPG: Q(s, a), [B, 1]."""
    made = _make(network, spaces_of(1, LOW, HIGH))
    obs, action = _obs(), torch.zeros(B, A)
    q = made(obs, action)
    if q.shape not in {(B, 1), (B,)}:
        yield f"Q of {B} pairs has shape {list(q.shape)}; it should be [{B}, 1]."
    last = [module for module in made.modules() if isinstance(module, nn.Linear)][-1]
    with torch.no_grad():
        bias = last.bias.clone()
        last.bias.sub_(1000)
        shifted = made(obs, action)
        last.bias.copy_(bias)
    if not torch.allclose(shifted, q - 1000, atol=1):
        yield "Q cannot have every value. Likely: there is an activation behind the last layer."
    if torch.equal(q, made(obs, action + 1)):
        yield "Q does not depend on the action. Likely: torch.cat([x, a], 1) is missing."
    if torch.equal(q, made(obs + 1, action)):
        yield "Q does not depend on the state. Likely: torch.cat([x, a], 1) is missing."


def sample_categorical(function: Function) -> Iterator[str]:
    """`sample_categorical(probs [B, d])`, [B] of whole numbers."""
    probs = torch.tensor([0.1, 0.2, 0.7]).expand(6000, 3)
    drawn = function(probs)
    if not isinstance(drawn, Tensor) or drawn.dtype.is_floating_point:
        yield "it should return a tensor of whole numbers, to be used as indices."
        return
    if drawn.shape != (6000,):
        yield f"of 6000 rows it has shape {list(drawn.shape)}; it should be [6000]. Likely: .squeeze(1) is missing."
        return
    shares = torch.bincount(drawn, minlength=3) / 6000
    if (shares > 0).sum() == 1:
        yield "the action is always the same. Likely: argmax; or one draw for all rows."
    elif not torch.allclose(shares, probs[0], atol=0.04):
        yield f"with probabilities 0.1, 0.2, 0.7 the shares are {_shown(shares)}. Likely: softmax once too often."
    rows = torch.eye(3)[[2, 0, 1, 1]]
    if function(rows).tolist() != [2, 0, 1, 1]:
        yield "rows are not drawn each by its own probabilities."
