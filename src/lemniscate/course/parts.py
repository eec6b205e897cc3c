"""Exercises on the parts of an agent: its networks, and the replay buffer with the rows that go into it."""

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

# --- networks: shapes, initialization, distributions, bounds ---

O, A, B = 7, 3, 5
"""numbers of observations and actions, and rows of a batch"""
LOW, HIGH = np.array([-2, 0, 1], np.float32), np.array([1, 4, 3], np.float32)
"""bounds of actions that are neither −1 and 1 nor symmetric"""


def _made(network: Function, num_envs: int, low: np.ndarray, high: np.ndarray) -> Any:
    """A network for the spaces of a vector environment, whatever its constructor calls the environment."""
    observation, action = spaces.Box(-np.inf, np.inf, (O,), np.float32), spaces.Box(low, high)
    envs = SimpleNamespace(
        num_envs=num_envs,
        single_observation_space=observation,
        single_action_space=action,
        observation_space=batch_space(observation, num_envs),
        action_space=batch_space(action, num_envs),
    )
    return call_by_name(network, envs=envs, env=envs, vec_env=envs)


def _obs(rows: int = B) -> Tensor:
    return torch.randn(rows, O, generator=torch.Generator().manual_seed(0))


def _shape(what: str, tensor: Tensor, *right: tuple[int, ...], likely: str = "") -> Iterator[str]:
    """A sentence where a tensor has none of the shapes that are right."""
    if tensor.shape not in right:
        yield f"{what} has shape {list(tensor.shape)}; it should be {list(right[0])}.{likely}"


def _shown(numbers: Any) -> str:
    return "(" + ", ".join(f"{float(number):.3g}" for number in numbers) + ")"


def agent(network: Function) -> Iterator[str]:
    """`Agent(envs)` with `value(x)` and `action_and_value(x, action=None, deterministic=False)`."""
    made, obs = _made(network, 2, -np.ones(A, np.float32), np.ones(A, np.float32)), _obs()
    answer = made.action_and_value(obs)
    if not isinstance(answer, tuple) or len(answer) != 4:
        yield "action_and_value should return action, log-probability, entropy and value."
    action, log_prob, entropy, value = answer
    yield from _shape(f"for {B} observations of {A} actions the action", action, (B, A))
    for name, tensor in (("log-probability", log_prob), ("entropy", entropy)):
        if tensor.shape == (B, A):
            yield f"the {name} has shape [{B}, {A}]. Likely: .sum(1) is missing."
        yield from _shape(f"the {name}", tensor, (B,))
    yield from _shape("value(x)", made.value(obs), (B, 1), (B,))
    yield from _shape("the value of action_and_value", value, (B, 1), (B,))
    yield from _distribution(made, obs)
    mean = made.action_and_value(obs, deterministic=True)[0]
    critic = _parameters_of(made, made.value(obs).sum())
    actor = _parameters_of(made, made.action_and_value(obs, mean)[1].sum())
    if shared := critic & actor:
        yield f"the critic and the actor share {min(shared)}. Likely: one trunk for both; they are separate networks."
    yield from _initialization(made, "critic", critic, 1.0)
    yield from _initialization(made, "actor", actor, 0.01)
    if all(parameter.numel() != A or "bias" in name for name, parameter in made.named_parameters()):
        yield "no parameter is a log σ of the actions. Likely: it is a tensor; nn.Parameter is trained and saved."


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
    standard = torch.distributions.Normal(torch.zeros(A), 1.0)
    want, wanted_entropy = standard.log_prob(torch.tensor(0.5)).sum(), standard.entropy().sum()
    if not torch.allclose(log_prob, want, atol=1e-4):
        yield (
            f"half a unit from the mean the log-probability is {log_prob[0]:.4g}; with σ = 1 it is {want:.4g}."
            " Likely: log σ does not begin at 0, or is taken for σ."
        )
    if not torch.allclose(entropy, wanted_entropy, atol=1e-4):
        yield f"the entropy is {entropy[0]:.4g}; of {A} Gaussians with σ = 1 it is {wanted_entropy:.4g}."


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
        if not torch.allclose(found, found.mean(), rtol=1e-3):
            yield f"{name}, of the {what}, is not orthogonal. Likely: nn.init.orthogonal_ with {shown} is missing."
        if not torch.allclose(found, torch.tensor(gain), rtol=1e-2):
            why = " so that the first actions hardly depend on the state" if is_last and last_gain < 1 else ""
            yield f"{name}, of the {what}, has the gain {found.mean():.3g}; it should be {shown}{why}."
        if layer.bias is not None and layer.bias.abs().max() > 0:
            yield f"the bias of {name}, of the {what}, does not begin at 0. Likely: nn.init.constant_(layer.bias, 0)."


def actor(network: Function) -> Iterator[str]:
    """`Actor(env)` of DDPG: μ(s) between the bounds of the actions."""
    made, obs = _made(network, 1, LOW, HIGH), 100 * _obs(2000)
    yield from _shape("for 2000 observations the action", made(obs), (2000, A))
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.mul_(3)  # far enough that tanh is at its ends
        low, high = made(obs).amin(0), made(obs).amax(0)
    lowest, highest = torch.from_numpy(LOW), torch.from_numpy(HIGH)
    reach, bounds = f"from {_shown(low)} to {_shown(high)}", f"{_shown(LOW)} and {_shown(HIGH)}"
    if (low < lowest - 1e-3).any() or (high > highest + 1e-3).any():
        is_symmetric = torch.allclose(-low, high, atol=0.1)
        cause = "action_bias is missing" if high.max() > 1.01 else "the output of tanh is not scaled"
        cause = cause if is_symmetric else "there is no tanh"
        yield f"the actions reach {reach}; the bounds are {bounds}. Likely: {cause}."
    if (low > lowest + 0.3).any() or (high < highest - 0.3).any():
        yield f"the actions reach only {reach}, not to {bounds}."
    parameters, saved = dict(made.named_parameters()), made.state_dict()
    scales = [name for name in saved if name not in parameters]
    if not scales:
        yield "scale and bias of the actions are not saved with it. Likely: they are no buffers: register_buffer."
    if any(saved[name].shape == (1, A) for name in scales):
        yield Note(
            f"{scales[0]} has shape [1, {A}], from the action space of all environments; with more of them a checkpoint"
            " would not fit. That of one is single_action_space."
        )


def q_network(network: Function) -> Iterator[str]:
    """`QNetwork(env)` of DDPG: Q(s, a), [B, 1]."""
    made, obs, action = _made(network, 1, LOW, HIGH), _obs(), torch.zeros(B, A)
    q, other_action, other_state = made(obs, action), made(obs, action + 1), made(obs + 1, action)
    yield from _shape(f"Q of {B} pairs", q, (B, 1), (B,))
    last = [module for module in made.modules() if isinstance(module, nn.Linear)][-1]
    with torch.no_grad():
        last.bias.sub_(1000)
    if not torch.allclose(made(obs, action), q - 1000, atol=1):
        yield "Q cannot have every value. Likely: there is an activation behind the last layer."
    for what, other in (("action", other_action), ("state", other_state)):
        if torch.equal(q, other):
            yield f"Q does not depend on the {what}. Likely: torch.cat([x, a], 1) is missing."


def sample_categorical(function: Function) -> Iterator[str]:
    """`sample_categorical(probs [B, d])`, [B] of whole numbers."""
    probs = torch.tensor([0.1, 0.2, 0.7]).expand(6000, 3)
    drawn = function(probs)
    if not isinstance(drawn, Tensor) or drawn.dtype.is_floating_point:
        yield "it should return a tensor of whole numbers, to be used as indices."
    yield from _shape("of 6000 rows it", drawn, (6000,), likely=" Likely: .squeeze(1) is missing.")
    shares = torch.bincount(drawn, minlength=3) / 6000
    if (shares > 0).sum() == 1:
        yield "the action is always the same. Likely: argmax; or one draw for all rows."
    if not torch.allclose(shares, probs[0], atol=0.04):
        yield f"with probabilities 0.1, 0.2, 0.7 the shares are {_shown(shares)}. Likely: softmax once too often."
    if function(torch.eye(3)[[2, 0, 1, 1]]).tolist() != [2, 0, 1, 1]:
        yield "rows are not drawn each by its own probabilities."


# --- the replay buffer ---

SIZE = 6
COLUMNS = ("obs", "next_obs", "action", "reward", "done")
SAMPLED = ("observations", "next_observations", "actions", "rewards", "dones")
"""the attributes of a sample, in the order of the columns"""
ALIASES = {"actions": "action", "rewards": "reward", "dones": "done", "terminated": "done", "terminations": "done"}
"""other names of arguments of `add`"""


def _row(number: int) -> dict[str, Any]:
    """A transition in which every part says which one it is; every third one ends."""
    ones = np.full(1, number, dtype=np.float32)
    obs = np.stack([ones, ones], axis=1)
    return dict(zip(COLUMNS, (obs, obs + 0.5, ones[:, None] / 10, -ones, ones % 3 == 0), strict=True))


def _add(buffer: Any, row: dict[str, Any]) -> None:
    aliases = {name: row[column] for name, column in ALIASES.items()}
    call_by_name(buffer.add, **row, **aliases, infos=[{}])


def _sampled(buffer: Any, rows: int = 3000) -> dict[str, np.ndarray]:
    """Many samples, [rows, …] each, by column."""
    batch = buffer.sample(rows)
    parts = (np.asarray(getattr(batch, name)).reshape(rows, -1) for name in SAMPLED)
    return dict(zip(COLUMNS, parts, strict=True))


def replay_buffer(buffer: Function) -> Iterator[str]:
    """`ReplayBuffer(buffer_size, observation_space, action_space)` with `add` and `sample`."""
    box, act = spaces.Box(-np.inf, np.inf, (2,), np.float32), spaces.Box(-1, 1, (1,), np.float32)
    sizes = {"buffer_size": SIZE, "capacity": SIZE, "size": SIZE, "device": "cpu", "n_envs": 1}
    made = call_by_name(buffer, **sizes, observation_space=box, action_space=act, handle_timeout_termination=False)
    reused = _row(1)
    _add(made, reused)
    _add(made, _row(2))
    for name in ("obs", "next_obs", "action", "reward"):
        reused[name] += 100  # as an environment does that writes over its own arrays
    reused["done"][:] = True
    batch = _sampled(made)
    seen = set(batch["obs"][:, 0].tolist())
    if seen - {1.0, 2.0, 101.0}:
        yield "rows that were never written are sampled. Likely: it draws from the whole capacity."
    for name in COLUMNS:
        if np.isclose(batch[name].astype(float), np.ravel(reused[name])[0]).any():
            yield f"{name} of a stored row changed with the array that it came from. Likely: it is not copied."
    if len(seen) < 2:
        yield "of two stored rows one was found in 3000 samples."
    for number in range(3, 10):
        _add(made, _row(number))
    yield from _after_nine(_sampled(made))


def _after_nine(batch: dict[str, np.ndarray]) -> Iterator[str]:
    """Nine rows went into six places: 4 to 9 are left."""
    numbers = batch["obs"][:, 0]
    seen, counts = np.unique(numbers, return_counts=True)
    if set(seen.tolist()) != set(range(4, 10)):
        was = ", ".join(f"{number:g}" for number in seen)
        why = "the last place is never used, or sampled" if len(seen) == 5 else "the oldest rows are not overwritten"
        yield f"after nine rows in six places it holds {was}; it should hold 4 to 9. Likely: {why}."
    if counts.max() > 1.5 * counts.min():
        yield "some rows are sampled much more often than others; each should be as likely as any other."
    for name, want in (("action", numbers / 10), ("reward", -numbers), ("next_obs", numbers + 0.5)):
        if not np.allclose(batch[name][:, 0], want, atol=1e-5):
            yield f"{name} is of another row than obs. Likely: each part is drawn by indices of its own."
    if not np.array_equal(batch["done"][:, 0] > 0.5, numbers % 3 == 0):
        yield "done is not what was stored with the row."


def add_to_replay(function: Function) -> Iterator[str]:
    """`add_to_replay(rb, obs, actions, next_obs, rewards, terminations, truncations, infos)`, after each step.

    The environments are SAME_STEP: where one has ended, `next_obs` is the first of the next episode.
    """
    first_of_next, last = np.full(2, 7, np.float32), np.full(2, 3, np.float32)
    for end in ("", "death", "time-out"):
        stored: list[tuple[Any, dict[str, Any]]] = []
        rb = SimpleNamespace(add=lambda *args, **named: stored.append((args, named)))  # noqa: B023
        next_obs = np.stack([first_of_next if end else last, np.full(2, 5, np.float32)])
        finals = {"final_obs": np.array([last, None], dtype=object), "_final_obs": np.array([True, False])}
        flags = {"terminations": np.array([end == "death", False]), "truncations": np.array([end == "time-out", False])}
        number = np.arange(1, 3, dtype=np.float32)
        row = {"obs": np.stack([number, number], axis=1), "action": number[:, None] / 10, "reward": -number}
        given = {"obs": row["obs"].copy(), "actions": row["action"].copy(), "rewards": row["reward"].copy()}
        try:
            call_by_name(function, rb=rb, **given, next_obs=next_obs, **flags, infos=finals if end else {})
        except KeyError as error:
            if "final_observation" not in str(error):
                raise
            yield "infos has no final_observation: since Gymnasium 1.0 it is called final_obs."
        if len(stored) != 1:
            yield f"it adds {len(stored)} times; one call of rb.add has the rows of all environments."
        args, named = stored[0]
        order = dict(zip((*COLUMNS, "infos"), args, strict=False))
        order |= {ALIASES.get(name, name): value for name, value in named.items()}
        yield from _given(order, row)
        yield from _stored(order, end, last)


def _given(order: dict[str, Any], row: dict[str, np.ndarray]) -> Iterator[str]:
    """Sentences where a column is not there, or one that needs no change is not the step's."""
    for name in COLUMNS:
        if name not in order:
            yield f"rb.add(obs, next_obs, action, reward, done, infos) was not given {name}."
    for name, want in row.items():
        if not np.array_equal(np.ravel(order[name]), want.ravel()):
            yield (
                f"{name} is not that of the step. Likely: the order of the arguments, which is obs, next_obs, action,"
                " reward, done, infos."
            )


def _stored(order: dict[str, Any], end: str, last: np.ndarray) -> Iterator[str]:
    """Sentences where the end or the successor of the first environment's row is wrong."""
    done, next_obs = order["done"], order["next_obs"]
    if done[0] and end == "time-out":
        yield (
            "a time-out is stored as done, so nothing is bootstrapped from it. Likely: terminated | truncated; done is"
            " terminated alone."
        )
    if bool(done[0]) != (end == "death"):
        yield f"a {end or 'row within an episode'} is stored with done = {bool(done[0])}."
    if end and not np.array_equal(next_obs[0], last):
        said = f"the successor of a {end} is stored as the first observation of the next episode. Likely:"
        if end == "time-out":
            yield f'{said} infos["final_obs"] is not used.'
        yield Note(f"{said} final_obs is used at time-outs alone. After a death the target does not look at it.")
    if not np.array_equal(next_obs[1], np.full(2, 5)):
        yield "the successor of the other environment, which goes on, was changed."
