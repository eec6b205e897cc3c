"""Policies that were not trained here: functions, torch modules, objects of a user, and .pt files of their weights."""

import copy
import math
import pickle
import re
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from inspect import signature
from itertools import pairwise, product
from os import PathLike
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from gymnasium.vector.utils import batch_space
from torch import Tensor, nn

from lemniscate.api.policy import TrainedPolicy, TrainedRun, load
from lemniscate.envs.conversion import normalized_action, physical_action, row_of, unflatten_observation
from lemniscate.envs.returned import MASKS, as_array, kind_of, shown_space
from lemniscate.envs.spaces import random_action, read_mask, read_observation
from lemniscate.envs.vec_env import VecEnv
from lemniscate.envs.vector_view import action_space, observation_space
from lemniscate.errors import UserError, shown
from lemniscate.hub import repository as hub
from lemniscate.maths import Deterministic
from lemniscate.nn.policies import Policy
from lemniscate.run.directory import difference
from lemniscate.run.evaluate import evaluate
from lemniscate.run.run import globals_undisturbed
from lemniscate.run.seeding import seed_globals
from lemniscate.spec import Box, Discrete, MultiDiscrete, Spec
from lemniscate.system import named
from lemniscate.system.console import say
from lemniscate.system.files import at_home

FILES = (".pt", ".pth")
"""the endings of files of weights"""

LOOKS, ROWS = 10, 48
"""steps of random play, and observations of these, by which it is found out how a policy is called"""
ARRAYS: list[Any] = [np.ndarray, np.dtype, *(type(np.dtype(kind)) for kind in ("f4", "f8", "i4", "i8"))]
"""what torch may make of a file besides tensors: the statistics may be arrays, of NumPy 1 or 2"""
_makers: list[Any] = [np.zeros(0).__reduce__()[0], np.float64(0).__reduce__()[0]]
for _made in _makers:
    ARRAYS += [(_made, f"numpy.{core}.multiarray.{_made.__name__}") for core in ("core", "_core")]


def observed(spec: Spec) -> str:
    """A clause on the size of an environment's observation and its parts."""
    parts = ", ".join(f"{part.name} {part.own_shape or part.shape}" for part in spec.observation_parts)
    return f"{spec.env_id} observes {spec.observation_size} numbers, {parts}"


def read_weights(file: Path, spec: Spec, agent: Any = None) -> tuple[Any, list[Tensor], bool, str]:
    """The agent with the weights of a file; mean and variance of its observations, if there; in words what was read.

    Beside these, whether it scales its actions to the environment's bounds itself, as a DDPG actor does.

    Args:
        file: a state_dict, or a dictionary with one, such as `model_state_dict`, and `obs_mean` and `obs_var`.
        spec: of the environment.
        agent: what takes the weights: a class that is made with the environments or without arguments, a function, or
            a module; its name; or None, for the layouts of the courses, whose widths and depths the weights tell.

    Raises `UserError` for a file that cannot be read, of another layout, or for other sizes.
    """
    try:
        with torch.serialization.safe_globals(ARRAYS):
            record = torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise UserError(f"{file} does not exist.") from None
    except Exception as error:  # of pickle, of zip and of torch
        if "global" not in str(error).lower():  # what torch refuses to import
            raise UserError(f"{file} is damaged, or no file of torch.save's: {type(error).__name__}.") from error
        line = f"torch.save(agent.state_dict(), {file.name!r})"
        raise UserError(f"{file} cannot be read without running what it holds; save weights alone: {line}.") from error
    held = record if isinstance(record, dict) else {}
    parts = (part for name, part in held.items() if re.match(r"(?!.*optim).*state_dict$", str(name)))
    weights = next(parts, held)
    named_tensors = weights.items() if isinstance(weights, dict) else ()
    if not named_tensors or not all(isinstance(name, str) and isinstance(x, Tensor) for name, x in named_tensors):
        raise UserError(f"{file} has no weights: a state_dict, or a dictionary with one, such as model_state_dict.")
    moments = _moments(held, file)
    said, sizes = f"{file}: {'with' if moments else 'without'} obs_mean and obs_var", list(map(len, moments))
    if agent is None:
        made, widths = _of_layout(weights, file)
        sizes, said = [widths[0], *sizes], f"{said}, {'-'.join(map(str, widths))}"
        space: Any = action_space(spec.action)
        if widths[-1] != (actions := getattr(space, "n", math.prod(space.shape))):
            raise UserError(f"{file} is for {widths[-1]} numbers of an action; {spec.env_id} takes {actions}.")
    else:
        made = _filled(agent, weights, spec, file)
    for wrong in (size for size in sizes if size != spec.observation_size):
        raise UserError(f"{file} is for {wrong} observed numbers; {observed(spec)}{_remedy(wrong, spec)}.")
    return made, moments, any(name.endswith("action_scale") for name in weights), said


def _moments(held: dict[Any, Any], file: Path) -> list[Tensor]:
    """Mean and variance of the observations, if a file has them. Raises `UserError` for others than these."""
    names = [name for name in ("obs_mean", "obs_var") if name in held]
    if len(names) == 1:
        raise UserError(f"{file} has one of obs_mean and obs_var; a normalizer needs both.")
    arrays = [as_array(held[name]) for name in names]
    right = [array.dtype.kind in "iuf" and np.isfinite(array).all() for array in arrays]
    if not all(right) or (arrays and (arrays[1] < 0).any()):
        raise UserError(f"obs_mean and obs_var in {file} must be finite numbers, and no variance negative.")
    return [torch.from_numpy(array.astype(np.float64)).flatten() for array in arrays]


def _of_layout(weights: dict[str, Tensor], file: Path) -> tuple[Callable[[Tensor], Any], list[int]]:
    """The function that weights in the layout of a course are of, and the widths of its layers.

    That is PPO's `actor_mean`, linear layers with tanh between them, and `actor_logstd`; or DDPG's actor, `fc1`, `fc2`
    and `fc_mu` with ReLU between them, then tanh, `action_scale` and `action_bias`.
    """
    found = sorted(int(match[1]) for name in weights if (match := re.fullmatch(r"actor_mean\.(\d+)\.weight", name)))
    names = [f"actor_mean.{number}" for number in found] or ["fc1", "fc2", "fc_mu"]
    needed = {f"{name}.bias" for name in names} | (set() if found else {"action_scale", "action_bias"})
    if found != list(range(0, 2 * len(found), 2)) or not needed <= weights.keys():
        raise UserError(
            f"{file} has another layout than the courses' agents: name the class or the function that makes yours,"
            " agent=Agent in Python, --agent module:Agent on the command line."
        )
    layers = [(weights[f"{name}.weight"].float(), weights[f"{name}.bias"].float()) for name in names]
    widths = [layers[0][0].shape[-1], *(len(bias) for _, bias in layers)]
    shapes = [tuple(weight.shape) for weight, _ in layers]
    if shapes != [(after, before) for before, after in pairwise(widths)]:
        raise UserError(f"{file} has layers that do not fit each other: {', '.join(map(str, shapes))}.")

    def forward(x: Tensor) -> Any:
        for number, layer in enumerate(layers):
            x = x if number == 0 else x.tanh() if found else x.relu()
            x = nn.functional.linear(x, *layer)
        if not found:
            return x.tanh() * weights["action_scale"].flatten() + weights["action_bias"].flatten()
        log_std = weights.get("actor_logstd")
        return x if log_std is None else torch.distributions.Normal(x, log_std.flatten().exp())

    return forward, widths


def _filled(agent: Any, weights: dict[str, Tensor], spec: Spec, file: Path) -> nn.Module:
    """The user's agent with these weights. Raises `UserError` where it cannot be made, or has other sizes."""
    agent = named.find_callable(agent) if isinstance(agent, str) else agent
    one, action = observation_space(spec), action_space(spec.action)
    spaces = {"single_observation_space": one, "single_action_space": action, "num_envs": 1}
    envs = SimpleNamespace(**spaces, observation_space=batch_space(one, 1), action_space=batch_space(action, 1))
    try:
        made = copy.deepcopy(agent) if isinstance(agent, nn.Module) else agent(*[envs] * named.takes(agent, 1))
        own = made.state_dict()
    except Exception as error:
        raise UserError(
            f"agent cannot be made with the environments or without arguments: {error}; give a function that makes it,"
            " such as agent=lambda envs: Agent(43, 4)."
        ) from error
    if differs := difference(weights, own):
        raise UserError(f"{file} does not fit {type(made).__name__}: {differs}; {observed(spec)}.")
    made.load_state_dict(weights)
    return made.cpu()


def _remedy(size: int, spec: Spec) -> str:
    """The argument of a drone that gives it observations of this size, where there is one."""
    points = next((part.size // 3 for part in spec.observation_parts if part.name == "local_samples"), 0)
    more, rest = divmod(size - spec.observation_size, 3)
    fits = points and not rest and points + more > 0
    return f"; --env-args '{{\"n_samples\": {points + more}}}' fits" if fits else ""


METHODS = ("act", "predict", "get_action", "select_actions", "select_action")
METHODS += ("action_and_value", "get_action_and_value")
"""what libraries and courses call the method from observations to actions"""


def find(policy: Any, *, checkpoint: str | int | None = None, trust: bool = False) -> Any:
    """The policy that a name or a path stands for: of a run, of the user's own, or the path of a file of weights.

    Raises `UserError` as `load`, and for what cannot act.
    """
    if isinstance(policy, str | PathLike) and not hub.is_address(policy):
        name, path = str(policy), at_home(policy)
        if path.suffix in FILES and not path.is_dir():
            return path
        if re.fullmatch(r"[\w.]+:[\w.]+(\(.*\))?", name) and not path.exists():
            policy = named.find_callable(name)() if name.endswith(")") else named.find(name)
    if isinstance(policy, str | PathLike | TrainedRun | TrainedPolicy):
        return load(Path(policy) if isinstance(policy, PathLike) else policy, checkpoint=checkpoint, trust=trust)
    if checkpoint is not None:
        raise UserError(f"Of a run a checkpoint can be chosen, and not of {shown(policy)}.")
    function_of(policy)
    return policy


def function_of(policy: Any, deterministic: bool = True) -> partial[Any]:
    """The method of a known name that a policy acts by, or itself; it is told `deterministic` where it takes that.

    Raises `UserError` where it has neither.
    """
    if isinstance(policy, type):
        raise UserError(f"{policy.__name__} is a class: give an object of it, with the weights that are to act.")
    if isinstance(policy, Policy):
        raise UserError(
            "This is the module of a policy, whose actions are in [-1, 1]: give the policy itself, as load returns it."
        )
    found = (getattr(policy, name, None) for name in METHODS)
    # Modules and classes are parts of a policy, as `self.act = nn.ReLU()` is.
    function = next((one for one in found if callable(one) and not isinstance(one, nn.Module | type)), policy)
    if not callable(function):
        what = f"a run, a function, a torch module, or an object with {', '.join(METHODS[:-1])} or {METHODS[-1]}"
        raise UserError(f"A policy is {what}; not {shown(policy)}.")
    if not named.takes(function, 1):
        raise UserError(f"A policy that is a function takes one observation; {shown(policy)} does not.")
    with suppress(ValueError):  # a function that is not written in Python
        if "deterministic" in signature(function).parameters:
            return partial(function, deterministic=deterministic)
    return partial(function)


class Agent:
    """A policy of a user's own, as a function of flat observations to the actions that `VecEnv.step` takes.

    Observations are given as the environment returns them, else flat; as arrays, else as tensors; in float32, else in
    float64; one by one, else as a batch: in the first of these ways that is answered with actions. What has a network
    gets a batch first, and a module tensors of its own dtype, on its own device.

    Args:
        policy: as `find` returns it.
        spec: of the environment.
        seen: observations [T, N, O] one after the other, by which it is found out how the policy is called, and whether
            it remembers.
        deterministic: passed on where it is taken; of a distribution the mode, else a sample.
        normalized: whether its actions are in [-1, 1] between the bounds, or else in the environment's units.
    """

    def __init__(self, policy: Any, spec: Spec, seen: np.ndarray, deterministic: bool, normalized: bool) -> None:
        self.normalized, self.remembers = normalized, False
        self._policy, self._spec, self._deterministic = policy, spec, deterministic
        self._space: Any = action_space(spec.action)
        self._function = function_of(policy, deterministic)
        self._mask = ""
        """the argument in which the policy takes an action mask; empty where it takes none"""
        with suppress(ValueError):  # a function that is not written in Python
            self._mask = next((name for name in MASKS if name in signature(self._function).parameters), "")
        self._look(seen)

    def __call__(self, obs: Tensor) -> Deterministic:
        """The action at each flat observation, [N, O] or more. Raises `UserError` for what is no action."""
        action = self._answers(obs.numpy())
        if self.normalized and isinstance(self._spec.action, Box):
            return Deterministic(torch.from_numpy(action.reshape(len(obs), -1).astype(np.float32)))
        return Deterministic(torch.from_numpy(normalized_action(action, self._spec.action)))

    def act(self, obs: Any, action_mask: Any = None) -> np.ndarray:
        """The action for `env.step` at one observation, as the environment returns it."""
        flat, _ = read_observation(self._spec, obs)
        if self._spec.action.mask_size:
            flat = np.concatenate([flat, read_mask(action_mask, self._spec, flat).astype(flat.dtype)], axis=-1)
        return physical_action(self(torch.from_numpy(flat)).mode().numpy(), self._spec.action)[0]

    def _answers(self, flat: np.ndarray) -> np.ndarray:
        """The actions at flat observations [B, …], in the shape of the space; masks are given where asked for."""
        rows, count, masks = self._form(flat), len(flat), flat[:, self._spec.observation_size :].astype(bool)
        told = {self._mask: masks} if self._mask and masks.size else {}
        if self._batched:
            return self._answer(rows, (count,), told)
        return np.stack([self._answer(row_of(rows, i), (), row_of(told, i)) for i in range(count)])

    def _look(self, seen: np.ndarray) -> None:
        """Find out how the policy is called.

        A batch has a size that is in no shape of the spaces, so what has that size is an answer to a batch. What has no
        network gets one at a time first: a batch might spoil what it remembers. Batches are given where each row has
        the answer that it has alone.
        """
        parts, network = self._spec.observation_parts, bool(_modules(self._policy))
        sizes = {self._spec.observation_size, len(parts), getattr(self._space, "n", 0), *self._space.shape}
        sizes |= {length for part in parts for length in part.own_shape + part.shape}
        size = next(number for number in range(3, 1000, 2) if number not in sizes)
        flat, failures = seen.reshape(-1, seen.shape[-1]), list[UserError]()
        batches = flat[np.linspace(0, len(flat) - 1, -(-ROWS // size) * size).astype(int)].reshape(
            -1, size, *flat.shape[1:]
        )
        for form, batched in product(self._forms(), (network, not network)):
            self._form, self._batched = form, batched
            before = None if network else _memory(self._policy)
            if self._try(batches[0], failures) is None:
                continue
            changed = before != (before and _memory(self._policy))
            self.remembers = changed or self._depends_on_order(seen if batched else flat[:ROWS, None])
            if not self.remembers and (network or isinstance(self._spec.action, Box)):
                self._batched = all(map(self._takes_batch, batches))
            return
        answered = [error for error in failures if not error.__cause__]
        raise min(answered or failures, key=lambda error: isinstance(error.__cause__, TypeError))

    def _depends_on_order(self, seen: np.ndarray) -> bool:
        """Whether observations [T, N, O] that are given in another order have other answers, or none."""
        first, other = [self._try(rows, []) for rows in seen], dict[int, np.ndarray | None]()
        for i in np.random.default_rng(0).permutation(len(seen)):
            other[i] = self._try(seen[i], [])
        pairs = ((one, other[i]) for i, one in enumerate(first))
        return any(one is None or again is None or not np.array_equal(one, again) for one, again in pairs)

    def _takes_batch(self, some: np.ndarray) -> bool:
        """Whether a batch is answered, and each row of it as it is alone, where that is answered."""
        self._batched = True
        together = self._try(some, [])
        self._batched = False
        alone = self._try(some, [])
        if together is None or alone is None:
            return alone is None
        return np.allclose(together, alone, rtol=1e-3, atol=1e-5)

    def _try(self, flat: np.ndarray, failures: list[UserError]) -> np.ndarray | None:
        seed_globals(0)  # what is drawn at random is not what a policy remembers
        try:
            return self._answers(flat)
        except UserError as error:
            failures.append(error)
            return None

    def _forms(self) -> Iterator[Callable[[np.ndarray], Any]]:
        """The ways in which flat observations [B, O] can be given."""
        kinds: list[Any] = [np.float32, np.float64, torch.zeros(0), torch.zeros(0, dtype=torch.float64)]
        tensors = (each for one in _modules(self._policy) for each in (*one.parameters(), *one.buffers()))
        if (like := next((tensor for tensor in tensors if tensor.is_floating_point()), None)) is not None:
            kinds.insert(0 if isinstance(self._policy, nn.Module) else len(kinds), like)
        own = partial(unflatten_observation, self._spec.observation_parts)
        for layout, kind in product((own, lambda flat: flat[:, : self._spec.observation_size]), kinds):
            yield lambda flat, layout=layout, kind=kind: _copied(layout(flat), kind)

    def _answer(self, rows: Any, leads: tuple[int, ...], told: dict[str, Any]) -> np.ndarray:
        """The actions at observations [*leads, …], float64. Raises `UserError` with what the policy raised."""
        try:
            with torch.set_grad_enabled(not isinstance(self._policy, nn.Module)):  # a function may plan by gradients
                returned = self._function(rows, **told)
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)[1:]
            own = [frame for frame in frames if "site-packages" not in frame.filename]
            where = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
            what = str(error).strip().splitlines() or [""]
            said = f"The policy raised {type(error).__name__}{where}: {what[0]}"
            raise UserError(f"{said}; {observed(self._spec)}.") from error
        named_predict = getattr(self._function.func, "__name__", "") == "predict"
        if named_predict and isinstance(returned, tuple) and returned[1:] != (None,):
            raise UserError("predict returns a state too: policies that are to be given it again cannot be played.")
        return self._read(returned, leads)

    def _read(self, returned: Any, leads: tuple[int, ...]) -> np.ndarray:
        """Actions [*leads, …] in the shape of their space, float64. Raises `UserError` for what is none."""
        kind, shape, value, why = self._spec.action, (*leads, *self._space.shape), returned, ""
        if isinstance(value, torch.distributions.Distribution):
            value = value.mode if self._deterministic else value.sample()
            value = value + kind.start if isinstance(kind, Discrete) else value
        array = as_array(value.double() if isinstance(value, Tensor) and value.is_floating_point() else value)
        numbers = array.dtype.kind == "f" and not np.isnan(array).any()
        if isinstance(kind, Discrete) and numbers and _alike(array.shape, (*leads, kind.n)):
            if not self._deterministic:
                raise UserError(
                    "The policy returns a number for each action, from which none is drawn: return the action."
                )
            array = array.reshape(*leads, kind.n).argmax(-1) + kind.start  # of logits, probabilities and Q alike
        if array.dtype.kind in "biuf":
            array = array.astype(np.float64)
            flattened = (*leads, self._space.shape and np.prod(self._space.shape))
            if not np.isfinite(array).all():
                why = f", with a number that is {array[~np.isfinite(array)][0]}"
            elif _alike(array.shape, shape) or array.shape == flattened:
                array = array.reshape(shape)
                if isinstance(kind, Box) or self._are_choices(array):
                    return array
        if isinstance(returned, tuple) and len(returned) > 1:  # beside the action log-probability, value, state
            return self._read(returned[0], leads)
        many = f" for {leads[0]} observations" if leads else ""
        space = shown_space(self._space)
        raise UserError(f"{self._spec.env_id} takes actions of {space}, not {kind_of(value)}{why}{many}.")

    def _are_choices(self, array: np.ndarray) -> bool:
        """Whether these are whole numbers of the space."""
        kind, start = self._spec.action, getattr(self._space, "start", 0)
        count = self._space.nvec if isinstance(kind, MultiDiscrete) else kind.n if isinstance(kind, Discrete) else 2
        return bool(((array == np.rint(array)) & (array >= start) & (array < start + count)).all())


def _modules(policy: Any) -> list[nn.Module]:
    """The torch modules that a policy is, whose method it is, or that it holds."""
    holder = getattr(policy, "__self__", policy)
    return [part for part in (holder, *getattr(holder, "__dict__", {}).values()) if isinstance(part, nn.Module)]


def _memory(policy: Any) -> bytes:
    """The pickled attributes of an object or a method's, and a function's closure; empty where pickle refuses."""
    cells = getattr(policy, "__closure__", None) or ()
    try:
        return pickle.dumps((vars(getattr(policy, "__self__", policy)), [cell.cell_contents for cell in cells]))
    except Exception:  # of any kind, since what it holds may be anything
        return b""


def _alike(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    """Whether two shapes are the same but for axes of length one."""
    return [n for n in shape if n != 1] == [n for n in wanted if n != 1]


def _copied(rows: Any, like: Any) -> Any:
    """Observations as arrays, or as tensors on the device of `like`; real numbers are of its type."""
    if isinstance(rows, dict):
        return {name: _copied(part, like) for name, part in rows.items()}
    if isinstance(rows, tuple):
        return tuple(_copied(part, like) for part in rows)
    if not isinstance(like, Tensor):
        return rows.astype(like if rows.dtype.kind == "f" else rows.dtype)
    tensor = torch.tensor(rows, device=like.device)
    return tensor.to(like.dtype) if tensor.is_floating_point() else tensor


class _Normalized(nn.Module):
    """An agent behind the normalizer of its observations, (x − mean) / √(var + 10⁻⁸), as Gymnasium's wrapper has it."""

    def __init__(self, agent: Any, moments: list[Tensor], deterministic: bool) -> None:
        super().__init__()
        self._agent, self._moments, self._function = agent, moments, function_of(agent, deterministic)

    def forward(self, obs: Tensor) -> Any:
        """The agent's answer to flat observations [B, O], after normalization."""
        if self._moments:
            obs = ((obs - self._moments[0]) / (self._moments[1] + 1e-8).sqrt()).to(obs.dtype)
        return self._function(obs)


@contextmanager
def playing(
    policy: Any, vec: VecEnv, seed: int, agent: Any, normalized: bool | None, deterministic: bool
) -> Iterator[Agent]:
    """A policy of the user's own, ready to play in `vec`: modules do not train, and the global generators are seeded.

    Afterwards everything is as it was. The actions of a file are taken as normalized, or in the environment's units, as
    `normalized` says; by default as they are worth more in a few episodes, and a line says so.
    """
    file, said = isinstance(policy, Path), ""
    if file:
        made, moments, scales, said = read_weights(policy, vec.spec, agent)
        normalized = False if scales and normalized is None else normalized
        policy = _Normalized(made, moments, deterministic)
    modes = {module: module.training for one in _modules(policy) for module in one.modules()}
    try:
        with globals_undisturbed():
            for module in modes:
                module.training = False
            player = Agent(policy, vec.spec, _first_observations(vec, seed), deterministic, bool(normalized))
            if file:
                say(f"{said}; {_choose_units(player, vec, seed, normalized)}.")
            seed_globals(seed)
            yield player
    finally:
        for module, mode in modes.items():
            module.training = mode


def _first_observations(vec: VecEnv, seed: int) -> np.ndarray:
    """The first observations from a seed, [T, N, O], of random play; of what may be a robot, the first alone."""
    seed %= 2**32  # of JAX it must be one of these
    rows, drawn = [vec.restart(seed).numpy()], torch.Generator().manual_seed(seed)
    for _ in range(0 if vec.backend.once else LOOKS):
        vec.step(random_action(vec.spec, vec.obs, drawn))
        rows.append(vec.obs.numpy())
    return np.stack(rows)


def _choose_units(player: Agent, vec: VecEnv, seed: int, normalized: bool | None) -> str:
    """Take actions as normalized or as they are, by what a few episodes are worth if it is not said; in words."""
    words, box, why = ("in the environment's units", "normalized to [-1, 1]"), vec.spec.action, ""
    if normalized is None and isinstance(box, Box) and np.isfinite(box.low + box.high).all():
        if {*box.low, *box.high} == {-1.0, 1.0}:
            return "actions are in [-1, 1]"
        worth = {}
        for player.normalized in (False, True):
            worth[player.normalized] = evaluate(player, vec, min(vec.num_envs, 16), seed).mean_return
        player.normalized = worth[True] > worth[False]
        why = f", worth {worth[player.normalized]:.1f} and not {worth[not player.normalized]:.1f} a flight or episode;"
        why += " normalized_actions (--[no-]normalized-actions) says it"
    names = ", ".join(quantity.name for quantity in vec.backend.interface.action)
    return f"actions are {f'{names}, ' * bool(names)}{words[player.normalized]}{why}"
