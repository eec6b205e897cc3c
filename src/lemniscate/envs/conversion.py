"""What passes between a policy and environments at every step: what these return, checked, and the actions."""

import math
import traceback
from collections.abc import Iterator, Mapping
from functools import lru_cache, reduce
from inspect import signature
from operator import getitem
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from lemniscate.errors import UserError, shown
from lemniscate.spec import Action, Box, Discrete, MultiBinary, MultiDiscrete, ObservationPart
from lemniscate.system.console import say

MASKS = ("action_mask", "action_masks", "legal_action_mask")
"""what environments call their action mask: in `info`, as a key of a Dict observation, or as a method"""

SUCCESS = ("is_success", "success")
"""what robotics environments call their success: 1 or 0, or True and False"""

APART = {*MASKS, "final_info", "final_obs", "env_id", "players", "elapsed_step"}
"""entries of the info of a vector environment that measure nothing"""

VALUES = {"reset": "2 values, (observation, info)", "step": "5 values, (obs, reward, terminated, truncated, info)"}


class Returns:
    """The values that `reset` and `step` return, checked; where they are not as they must be, a `UserError` says so.

    Args:
        env: one environment, or a vector environment.
        space: of one observation.
        lead: () for one environment, (N,) for a vector of N.
    """

    def __init__(self, env: Any, space: gym.Space, lead: tuple[int, ...] = ()) -> None:
        self._env, self._space, self._lead = env, space, lead

    def of_reset(self, returned: Any) -> tuple[Any, dict[str, Any]]:
        """The observation, in the types of its space, and the info."""
        obs, info = self._several("reset", returned, 2)
        return self._observation("reset", obs), self._info("reset", info)

    def of_step(self, returned: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """The observation, in the types of its space; the reward, the flags and the info."""
        obs, reward, terminated, truncated, info = self._several("step", returned, 5)
        if self._lead or type(reward) is not float:
            reward = self._numbers("reward", reward, float)
        if self._lead or type(terminated) is not bool:
            terminated = self._numbers("terminated", terminated, bool)
        if self._lead or type(truncated) is not bool:
            truncated = self._numbers("truncated", truncated, bool)
        return self._observation("step", obs), reward, terminated, truncated, self._info("step", info)

    def wrong(self, method: str, what: str) -> UserError:
        """The sentence on a method: its name, where it is written, and `what` it did."""
        return UserError(f"{_author(self._env, method)} {what}.")

    def _several(self, method: str, returned: Any, count: int) -> Any:
        if not isinstance(returned, tuple) or len(returned) != count:
            what = f"{len(returned)} values" if isinstance(returned, tuple) else kind_of(returned)
            raise self.wrong(method, f"returned {what}; it must return {VALUES[method]}")
        return returned

    def _observation(self, method: str, obs: Any) -> Any:
        try:
            return _fitted(self._space, obs, self._lead)
        except ValueError as error:
            raise self.wrong(method, f"returned an observation {error}") from None

    def _info(self, method: str, info: Any) -> dict[str, Any]:
        if not isinstance(info, dict):
            raise self.wrong(method, f"returned {kind_of(info)} as info; it must be a dictionary, such as {{}}")
        return info

    def _numbers(self, name: str, value: Any, kind: type) -> Any:
        """A number or a flag of one environment, or a new array [N] of them."""
        array = as_array(value)
        fits = array.dtype.kind in "biuf" and (array.shape == self._lead or (array.size == 1 and not self._lead))
        if not fits or (kind is bool and not ((array == 0) | (array == 1)).all()):
            wanted = "a number" if kind is float else "True or False"
            each = " for each environment" if self._lead else ""
            raise self.wrong("step", f"returned {kind_of(value)} as {name}; it must be {wanted}{each}")
        return array.astype(kind) if self._lead else kind(array.item())


class SingleEnv(gym.Wrapper):
    """One environment whose returns are checked, and whose `info` has numbers and the action mask alone.

    Those of nested dictionaries are named "outer/inner". The mask is a row in `info["action_mask"]`, wherever it stood.

    Raises:
        UserError: an environment without spaces, or whose reset takes no seed or no options.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        for name in ("observation_space", "action_space"):
            if not isinstance(getattr(env, name, None), gym.Space):
                kind = type(env.unwrapped).__name__
                raise UserError(f"{kind} has no {name}: set self.{name} in its __init__, such as a Box.")
        for layer in _layers(env):
            taken = signature(layer.reset).parameters
            if not taken.keys() >= {"seed", "options"} and all(
                one.kind is not one.VAR_KEYWORD for one in taken.values()
            ):
                right = "reset(self, *, seed=None, options=None)"
                raise UserError(f"{_place(layer, 'reset')} takes no seed or no options; it must be {right}.")
        self._returns = Returns(env, env.observation_space)
        asked = [env.get_wrapper_attr(name) for name in MASKS if env.has_wrapper_attr(name)]
        self._ask = next(filter(callable, asked), None)
        seen = env.observation_space
        self._masked = bool(self._ask or (isinstance(seen, spaces.Dict) and seen.spaces.keys() & set(MASKS)))
        self._declared = measures_of(env.metadata or {})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Gymnasium's."""
        try:
            returned = self.env.reset(seed=seed, options=options)
        except (TypeError, ValueError) as error:
            raise self._in_wrapper("reset", error) from error.__cause__
        obs, info = self._returns.of_reset(returned)
        return obs, self._told("reset", obs, info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Gymnasium's."""
        try:
            returned = self.env.step(action)
        except (TypeError, ValueError) as error:
            raise self._in_wrapper("step", error) from error.__cause__
        obs, *rest, info = self._returns.of_step(returned)
        return obs, *rest, self._told("step", obs, info)

    def close(self) -> None:
        """Gymnasium's. An exception in it is said, and costs nothing that was learned."""
        try:
            self.env.close()
        except Exception as error:
            say(f"{_author(self.env, 'close')} raised {type(error).__name__}: {error}")

    def _in_wrapper(self, method: str, error: Exception) -> Exception:
        """The sentence where a wrapper of Gymnasium could not unpack what `method` returned; else the error itself."""
        *_, last = traceback.walk_tb(error.__traceback__)
        if "unpack" not in str(error) or not last[0].f_globals["__name__"].startswith("gymnasium."):
            return error
        return UserError(f"{_author(self.env, method)} must return {VALUES[method]}: {error}.")

    def _told(self, method: str, obs: Any, info: dict[str, Any]) -> dict[str, Any]:
        if not info and not self._masked:
            return info
        numbers: dict[str, Any] = dict(_scalars(info))
        for name in self._declared:
            if info.get(name) is not None and name not in numbers:
                what = f"returned {kind_of(info[name])} as info[{name!r}]; a measure is a number"
                raise self._returns.wrong(method, what)
        _, mask = mask_in(obs, info)
        mask = self._ask() if mask is None and self._ask else mask
        if mask is not None:
            try:
                numbers["action_mask"] = flat_mask(mask, self.action_space)
            except ValueError as error:
                raise self._returns.wrong(method, f"comes with an action mask {error}") from None
        return numbers


def _layers(env: Any) -> Iterator[Any]:
    """An environment, and what is inside of it if it is a wrapper, the outermost first."""
    while env is not None:
        yield env
        env = vars(env).get("env")


def _author(env: Any, method: str) -> str:
    """The method of the outermost layer whose class is not Gymnasium's."""
    layers = list(_layers(env))
    own = (layer for layer in layers if not getattr(type(layer), method).__module__.startswith("gymnasium."))
    return _place(next(own, layers[-1]), method)


def _place(layer: Any, method: str) -> str:
    """The name of a method, and where it is written."""
    function = getattr(type(layer), method)
    code = getattr(function, "__code__", None)
    place = f" ({Path(code.co_filename).name}, line {code.co_firstlineno})" if code else ""
    return f"{'.'.join(function.__qualname__.split('.')[-2:])}(){place}"


def kind_of(value: Any) -> str:
    """A value in a sentence: an array by its shape and type, a number as it is, others by their type."""
    if hasattr(value, "dtype") and getattr(value, "shape", ()):
        return f"an array of shape {tuple(value.shape)} and type {value.dtype}"
    return shown(value)


def as_array(value: Any) -> np.ndarray:
    """As an array; of objects where it cannot be one, such as lists of different lengths, or a number is masked."""
    if np.ma.is_masked(value):
        return np.full((), None, dtype=object)
    try:
        return np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
    except (ValueError, TypeError, RuntimeError):
        return np.full((), None, dtype=object)


def _fitted(space: gym.Space, obs: Any, lead: tuple[int, ...], where: str = "") -> Any:
    """An observation in the types of its space. Raises `ValueError`, with the rest of a sentence, where it is none."""
    if isinstance(space, spaces.Dict):
        keys = ", ".join(map(str, space.spaces))
        if not isinstance(obs, Mapping):
            raise ValueError(f"that is {kind_of(obs)}{where}; its space is a Dict with the keys {keys}")
        if lacking := [key for key in space.spaces if key not in obs]:
            raise ValueError(f"without {lacking[0]}{where}; its space is a Dict with the keys {keys}")
        if beside := [name for name in MASKS if name in obs and name not in space.spaces]:
            raise ValueError(f"with {beside[0]}{where}, which is not in its space, a Dict with the keys {keys}")
        return {key: _fitted(part, obs[key], lead, f"{where} in {key}") for key, part in space.items()}
    if isinstance(space, spaces.Tuple):
        if not isinstance(obs, tuple | list) or len(obs) != len(space):
            raise ValueError(f"that is {kind_of(obs)}{where}; its space is a Tuple of {len(space)}")
        return tuple(_fitted(part, obs[i], lead, f"{where} in part {i}") for i, part in enumerate(space))
    return _fitted_array(space, obs, (*lead, *(space.shape or ())), where)


def _fitted_array(space: gym.Space, obs: Any, shape: tuple[int, ...], where: str) -> Any:
    counted = isinstance(space, spaces.Discrete | spaces.MultiDiscrete)
    if not counted and type(obs) is np.ndarray and obs.dtype == space.dtype and obs.shape == shape:
        return obs
    array, kind = as_array(obs), np.dtype(space.dtype)
    if array.dtype.kind not in "biuf" or array.shape != shape:
        said = f"of shape {array.shape}" if array.dtype.kind in "biuf" else f"that is {kind_of(obs)}"
        raise ValueError(f"{said}{where}; its space is {shown_space(space)}, of shape {space.shape}")
    with np.errstate(invalid="ignore"):  # a NaN as a whole number, which the next line finds
        fitted = array.astype(kind)
    if kind.kind in "iub" and not np.array_equal(fitted, array):
        raise ValueError(f"of type {array.dtype}{where}, whose numbers are not all of type {kind}, as its space says")
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        count, start = getattr(space, "nvec", getattr(space, "n", 0)), np.asarray(space.start, dtype=np.int64)
        outside = fitted[(fitted < start) | (fitted >= start + count)]  # a small type may not hold the first beyond it
        if outside.size:
            raise ValueError(f"with {outside.flat[0]}{where}, which is not in its space, {shown_space(space)}")
    return fitted if fitted.shape else fitted[()]


def shown_space(space: gym.Space) -> str:
    """A space in a sentence."""
    return " ".join(str(space).split())


def mask_in(obs: Any, info: Mapping[str, Any]) -> tuple[str, Any]:
    """The action mask of an environment, and its name in `info`; ("", None) where there is none."""
    for name in MASKS:
        if name in info:
            return name, info[name]
        if isinstance(obs, Mapping) and name in obs:
            return "", obs[name]
    return "", None


def flat_mask(mask: Any, action: gym.Space | Action) -> np.ndarray:
    """An action mask as one row, [n] bool; of a MultiDiscrete, those of its components one after the other.

    Raises `ValueError`, with the rest of a sentence, for another size, and for actions that are no choices.
    """
    counts = getattr(action, "nvec", None)
    counts = np.ravel(getattr(action, "n", 0) if counts is None else counts)
    if not isinstance(action, spaces.Discrete | spaces.MultiDiscrete | Discrete | MultiDiscrete):
        raise ValueError("; masks are for Discrete and MultiDiscrete actions")
    row = _row(mask)
    if len(row) != counts.sum():
        raise ValueError(f"of {len(row)} numbers; it must have {counts.sum()}, of 1 and 0")
    return row.astype(bool)


def _row(mask: Any) -> np.ndarray:
    """Nested tuples and lists of arrays as one row."""
    if isinstance(mask, tuple | list) and len(mask):
        return np.concatenate([_row(part) for part in mask])
    return np.ravel(mask)


def _scalars(info: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Every number in `info`, an array of one too, and those of its dictionaries, by "outer/inner"."""
    for key, value in info.items():
        if isinstance(value, float):
            yield f"{prefix}{key}", float(value)
        elif isinstance(value, Mapping):
            yield from _scalars(value, f"{prefix}{key}/")
        elif isinstance(value, int) or (hasattr(value, "__array__") and math.prod(getattr(value, "shape", (0,))) == 1):
            array = as_array(value)
            if array.dtype.kind in "biuf":
                yield f"{prefix}{key}", float(array.item())


def measures_of(metadata: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of an environment's measures: its success, and those that its `metadata["measures"]` lists."""
    named = metadata.get("measures", ()) if isinstance(metadata, Mapping) else ()
    return tuple(dict.fromkeys((*SUCCESS, *([named] if isinstance(named, str) else named))))


def measured(
    info: Mapping[str, Any], declared: tuple[str, ...], num_envs: int, device: torch.device, prefix: str = ""
) -> dict[str, Tensor]:
    """The numbers [N] float32 in the info of a vector environment; NaN where an environment gave none.

    Measures, `declared`, have their names; the others "info/" before it. `info[name]` counts where `info["_" + name]`
    is True. Where an environment was reset in the same step, its true info is in `info["final_info"]`.
    """
    found: dict[str, Tensor] = {}
    for source in (info, info.get("final_info", {})):
        for key, values in source.items():
            if key in APART or key[:1] == "_":
                continue
            if isinstance(values, Mapping):
                found |= measured(values, declared, num_envs, device, f"{prefix}{key}/")
                continue
            array = np.asarray(values)
            if array.dtype.kind not in "biuf" or array.size != num_envs:
                if key in declared:
                    raise UserError(f"info[{key!r}] is {kind_of(array)}; a measure is a number for each environment.")
                continue
            numbers = torch.from_numpy(array.reshape(num_envs).astype(np.float32)).to(device)
            name, given = key if key in declared else f"info/{prefix}{key}", source.get(f"_{key}")
            if given is not None and not given.all():
                before = found.get(name, torch.full((num_envs,), torch.nan, device=device))
                numbers = torch.where(torch.from_numpy(np.asarray(given)).to(device), numbers, before)
            found[name] = numbers
    return found


def flatten_observation(parts: tuple[ObservationPart, ...], obs: Any, *, image: bool = False) -> np.ndarray:
    """A batch of raw observations as [N, O]: float32, or the bytes of an image."""
    pieces = []
    for part in parts:
        own = reduce(getitem, part.path, obs)
        if part.nvec:
            own = _one_hot(part, own)
        numbers = np.asarray(own, dtype=np.uint8 if image else np.float32)
        if part.axes:
            numbers = numbers.reshape(-1, *part.own_shape).transpose(0, *(axis + 1 for axis in part.axes))
        pieces.append(numbers.reshape(-1, part.size))
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=-1)


def _one_hot(part: ObservationPart, obs: Any) -> np.ndarray:
    """A batch of whole numbers, each as a one-hot vector. Raises `ValueError` for one that is not in its space."""
    whole = np.asarray(obs).astype(np.int64, casting="same_kind")  # of uint64 and int64 NumPy makes float64
    numbers = whole.reshape(-1, len(part.nvec)) - np.array(part.start)
    if (numbers < 0).any() or (numbers >= np.array(part.nvec)).any():
        raise ValueError(f"{part.name} is {obs}, which is not in its space")
    hot = np.zeros((len(numbers), part.size), dtype=np.float32)
    columns = numbers + np.cumsum((0, *part.nvec[:-1]))
    hot[np.arange(len(numbers))[:, None], columns] = 1
    return hot


def row_of(batch: Any, row: int) -> Any:
    """One observation out of a batch of them, which may be a dictionary, a tuple or an array."""
    if isinstance(batch, dict):
        return {name: row_of(part, row) for name, part in batch.items()}
    return tuple(row_of(part, row) for part in batch) if isinstance(batch, tuple) else batch[row]


def scale_action(action: np.ndarray, box: Box) -> np.ndarray:
    """Actions of a policy to physical units, [N, A], in the dtype of the space; what lies outside is clipped.

        a_phys = clip(low + ½ (a + 1) (high − low), low, high)

    With one infinite bound, −1 is the finite one and the unit stays: low + 1 + a, or high − 1 + a. With two, a is not
    changed. Whole numbers are those nearest.
    """
    low, high, middle, half = scale_of(box)
    physical = np.minimum(np.maximum(middle + half * action, low), high)
    return (physical if box.dtype.startswith("float") else np.rint(physical)).astype(box.dtype, copy=False)


@lru_cache
def scale_of(box: Box) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """low, high, middle and half of the width of each coordinate, [A] each, as `scale_action` takes them."""
    kind = box.dtype if box.dtype.startswith("float") else "float64"
    low, high = np.array(box.low, dtype=kind), np.array(box.high, dtype=kind)
    below, above = np.isfinite(low), np.isfinite(high)
    with np.errstate(invalid="ignore"):  # ∞ − ∞, of which nothing is taken
        cases = [(below & above, 0.5 * low + 0.5 * high), (below & ~above, low + 1), (~below & above, high - 1)]
        half = np.where(below & above, 0.5 * high - 0.5 * low, 1).astype(kind)
    middle = np.select(*zip(*cases, strict=True), default=0).astype(kind)
    return low, high, middle, half


def _require_below(counts: int | np.ndarray, action: np.ndarray) -> np.ndarray:
    """The int64 actions themselves. Raises `UserError` unless each is from 0 to below its count."""
    wrong = action.view(np.uint64) >= counts  # without its sign, a negative number is a large one
    if wrong.any():
        raise UserError(f"Actions must be whole numbers from 0 to below {counts}, not {action[wrong][0]}.")
    return action


def physical_action(action: np.ndarray, kind: Action) -> np.ndarray:
    """Actions of a policy in the units and the shape of the environment, as `env.step` takes them, [N, …]."""
    if isinstance(kind, Box):
        action = scale_action(action, kind)
    elif isinstance(kind, Discrete):
        return _require_below(kind.n, action) + kind.start
    elif isinstance(kind, MultiDiscrete):
        action = (_require_below(np.array(kind.nvec), action) + np.array(kind.start)).astype(kind.dtype)
    else:
        _require_below(2, action)
    return action if kind.shape is None else action.reshape(-1, *kind.shape)


def normalized_action(action: np.ndarray, kind: Action) -> np.ndarray:
    """The inverse of `physical_action`: actions [N, …] of an environment, as a policy gives them."""
    if isinstance(kind, Discrete):
        return (action - kind.start).astype(np.int64)
    flat = action.reshape(len(action), -1)
    if isinstance(kind, MultiBinary):
        return flat.astype(np.int64)
    if isinstance(kind, MultiDiscrete):
        return (flat - np.array(kind.start)).astype(np.int64)
    _, _, middle, half = scale_of(kind)
    return ((flat - middle) / np.where(half > 0, half, 1)).astype(np.float32)
