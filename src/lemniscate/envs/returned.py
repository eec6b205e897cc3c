"""What `reset` and `step` of an environment return, checked: each fault is a sentence that says where it is written."""

import math
import traceback
from collections.abc import Iterator, Mapping
from contextlib import suppress
from inspect import signature
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv, VectorWrapper
from torch import Tensor

from lemniscate.errors import UserError, WorkerError, shown
from lemniscate.spec import Action, Discrete, MultiDiscrete
from lemniscate.system.console import say

MASKS = ("action_mask", "action_masks", "legal_action_mask")
"""what environments call their action mask in `info`, as a key of a Dict observation, or as a method"""

EXPLAINED = (TypeError, ValueError, SystemExit, OSError)
"""what an environment raises that is said in other words: see `ReturnedValues.explained`"""

MOST_LETTERS = 500
"""of what an exception says"""

VALUES = {"reset": "2 values, (observation, info)", "step": "5 values, (obs, reward, terminated, truncated, info)"}


class ReturnedValues:
    """The values that `reset` and `step` return, checked; where they are not as they must be, a `UserError` says so.

    `space` is that of one observation; `lead` is () for one environment, (N,) for a vector environment of N.
    """

    def __init__(self, env: Any, space: gym.Space, lead: tuple[int, ...] = ()) -> None:
        self._env, self._space, self._lead = env, space, lead

    def read_reset(self, returned: Any) -> tuple[Any, dict[str, Any]]:
        """The observation, in the types of its space, and the info."""
        obs, info = self._several("reset", returned, 2)
        return self._observation("reset", obs), self._info("reset", info)

    def read_step(self, returned: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """The observation, in the types of its space; the reward, the flags and the info."""
        obs, reward, terminated, truncated, info = self._several("step", returned, 5)
        reward = self._numbers("reward", reward, float)
        terminated, truncated = self._numbers("terminated", terminated), self._numbers("truncated", truncated)
        return self._observation("step", obs), reward, terminated, truncated, self._info("step", info)

    def explained(self, method: str, error: BaseException) -> BaseException:
        """The sentence where a wrapper of Gymnasium could not unpack what `method` returned, or it ended the program.

        Also where a pipe or a file of the environment's failed, which is not one of ours. Else the error itself.
        """
        if isinstance(error, OSError):
            said = WorkerError(f"{author(self._env, method)} raised {told_with_place(error)}.")
            said.__cause__ = error
            return said
        if isinstance(error, SystemExit):
            code = "" if error.code is None else shown(error.code)
            return self.wrong(method, f"called sys.exit({code}), which would end the whole program")
        frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__) if frame.f_code.co_name != "__iter__"]
        said_of_unpacking = any(words in str(error) for words in ("unpack", "iteration over a 0-d"))
        if not said_of_unpacking or not frames[-1].f_globals["__name__"].startswith("gymnasium."):
            return error
        return UserError(f"{author(self._env, method)} must return {VALUES[method]}: {error}.")

    def wrong(self, method: str, what: str) -> UserError:
        """The sentence on a method: its name, where it is written, and `what` it did."""
        return UserError(f"{author(self._env, method)} {what}.")

    def _several(self, method: str, returned: Any, count: int) -> Any:
        if not isinstance(returned, tuple) or len(returned) != count:
            what = f"{len(returned)} values" if isinstance(returned, tuple) else kind_of(returned)
            raise self.wrong(method, f"returned {what}; it must return {VALUES[method]}")
        return returned

    def _observation(self, method: str, obs: Any) -> Any:
        try:
            return fitted(self._space, obs, self._lead)
        except ValueError as error:
            raise self.wrong(method, f"returned an observation {error}") from None

    def _info(self, method: str, info: Any) -> dict[str, Any]:
        if not isinstance(info, dict):
            raise self.wrong(method, f"returned {kind_of(info)} as info; it must be a dictionary, such as {{}}")
        return info

    def _numbers(self, name: str, value: Any, kind: type = bool) -> Any:
        """A number or a flag of one environment, or a new array [N] of them."""
        if type(value) is kind and not self._lead:
            return value
        array = as_array(value)
        fits = array.dtype.kind in "biuf" and (array.shape == self._lead or (array.size == 1 and not self._lead))
        if not fits or (kind is bool and not ((array == 0) | (array == 1)).all()):
            wanted = "a number" if kind is float else "True or False"
            each = " for each environment" if self._lead else ""
            raise self.wrong("step", f"returned {kind_of(value)} as {name}; it must be {wanted}{each}")
        return array.astype(kind) if self._lead else kind(array.item())


class CheckedVector(VectorWrapper):
    """A vector environment whose returns are checked. Raises `UserError` as `require_form`."""

    def __init__(self, env: VectorEnv) -> None:
        require_form(env, ("single_observation_space", "single_action_space"))
        super().__init__(env)
        self._returns = ReturnedValues(env, env.single_observation_space, (env.num_envs,))

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Gymnasium's."""
        try:
            return self._returns.read_reset(self.env.reset(seed=seed, options=options))
        except (SystemExit, OSError) as error:
            said = self._returns.explained("reset", error)
            raise said from said.__cause__

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Gymnasium's."""
        try:
            return self._returns.read_step(self.env.step(actions))
        except (SystemExit, OSError) as error:
            said = self._returns.explained("step", error)
            raise said from said.__cause__

    def close(self, **kwargs: Any) -> None:
        """Gymnasium's. An exception in it is said, and costs nothing that was learned."""
        close_or_say(self.env, **kwargs)


def close_or_say(env: Any, **kwargs: Any) -> None:
    """Close an environment; what it raises, or that it would end the program, is said."""
    try:
        env.close(**kwargs)
    except (Exception, SystemExit) as error:
        say(f"{author(env, 'close')} raised {type(error).__name__}: {error}")


def told_with_place(error: BaseException) -> str:
    """The words of an error, and the place where it was raised."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{words_of(error)} ({Path(place.filename).name}, line {place.lineno})"


def words_of(error: BaseException) -> str:
    """The kind of an error, and the beginning of what it says."""
    said = ""
    with suppress(Exception):  # it may fail to say anything
        said = " ".join(str(error).split())
    said = f"{said[:MOST_LETTERS]}…" if len(said) > MOST_LETTERS else said.rstrip(".")
    return f"{type(error).__name__}: {said}" if said else type(error).__name__


def require_form(env: Any, names: tuple[str, str]) -> None:
    """Raise `UserError` for an environment that lacks one of these spaces, or whose reset takes no seed or options."""
    kind = type(env.unwrapped).__name__
    for name in names:
        space, why = None, ""
        try:
            space = getattr(env, name)
        except AttributeError as error:
            why = "" if f"'{name}'" in str(error) else f", as {error}"  # it may be a property of its own
        if space is None:
            raise UserError(f"{kind} has no {name}{why}: set self.{name} in its __init__, such as a Box.")
        if not isinstance(space, gym.Space):
            raise UserError(f"{name} of {kind} is {shown(space)}, and must be a space of gymnasium, such as a Box.")
    for layer in layers(env):
        if not _takes_options(layer.reset):
            right = "reset(self, *, seed=None, options=None)"
            raise UserError(f"{place(layer, 'reset')} takes no seed or no options; it must be {right}.")


def _takes_options(reset: Any) -> bool:
    """Whether a method takes a seed and options by their names; what has no signature to read may."""
    try:
        taken = signature(reset).parameters.values()
    except (ValueError, TypeError):
        return True
    named = {one.name for one in taken if one.kind is not one.POSITIONAL_ONLY}
    return named >= {"seed", "options"} or any(one.kind is one.VAR_KEYWORD for one in taken)


def layers(env: Any) -> Iterator[Any]:
    """An environment, and what is inside of it if it is a wrapper, the outermost first."""
    while env is not None:
        yield env
        env = env.env if isinstance(env, gym.Wrapper | VectorWrapper) else None


def author(env: Any, method: str) -> str:
    """The method of the outermost layer whose class is not Gymnasium's."""
    inside = list(layers(env))
    own = (layer for layer in inside if not getattr(type(layer), method).__module__.startswith("gymnasium."))
    return place(next(own, inside[-1]), method)


def place(layer: Any, method: str) -> str:
    """The name of a method, and where it is written."""
    function = getattr(type(layer), method)
    code = getattr(function, "__code__", None)
    line = f" ({Path(code.co_filename).name}, line {code.co_firstlineno})" if code else ""
    return f"{'.'.join(function.__qualname__.split('.')[-2:])}(){line}"


def kind_of(value: Any) -> str:
    """A value in a sentence: an array by its shape and type, a number as it is, others by their type."""
    if np.ma.is_masked(value):
        return f"a masked array of shape {value.shape}, some of whose numbers are masked"
    if hasattr(value, "dtype") and getattr(value, "shape", ()):
        return f"an array of shape {tuple(value.shape)} and type {value.dtype}"
    return shown(value)


def as_array(value: Any) -> np.ndarray:
    """The array that a value stands for; one of objects for lists of different lengths, masked numbers and the like."""
    with suppress(ValueError, TypeError, RuntimeError):
        if not np.ma.is_masked(value):
            return np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
    return np.full((), None, dtype=object)


def fitted(space: gym.Space, obs: Any, lead: tuple[int, ...] = (), where: str = "") -> Any:
    """An observation in the types of its space. Raises `ValueError`, with the rest of a sentence, where it is none."""
    if isinstance(space, spaces.Dict):
        keys = ", ".join(map(str, space.spaces))
        if not isinstance(obs, Mapping):
            raise ValueError(f"that is {kind_of(obs)}{where}; its space is a Dict with the keys {keys}")
        if lacking := [key for key in space.spaces if key not in obs]:
            raise ValueError(f"without {lacking[0]}{where}; its space is a Dict with the keys {keys}")
        if beside := [name for name in MASKS if name in obs and name not in space.spaces]:
            raise ValueError(f"with {beside[0]}{where}, which is not in its space, a Dict with the keys {keys}")
        return {key: fitted(part, obs[key], lead, f"{where} in {key}") for key, part in space.items()}
    if isinstance(space, spaces.Tuple):
        if not isinstance(obs, tuple | list) or len(obs) != len(space):
            raise ValueError(f"that is {kind_of(obs)}{where}; its space is a Tuple of {len(space)}")
        return tuple(fitted(part, obs[i], lead, f"{where} in part {i}") for i, part in enumerate(space))
    return _fitted_array(space, obs, (*lead, *(space.shape or ())), where)


def _fitted_array(space: gym.Space, obs: Any, shape: tuple[int, ...], where: str) -> Any:
    counted = isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)
    if not counted and type(obs) is np.ndarray and obs.dtype == space.dtype and obs.shape == shape:
        return obs.copy()  # several environments may write into one array
    array, kind = as_array(obs), np.dtype(space.dtype)
    if array.dtype.kind not in "biuf" or array.shape != shape:
        said = f"of shape {array.shape}" if array.dtype.kind in "biuf" else f"that is {kind_of(obs)}"
        raise ValueError(f"{said}{where}; its space is {shown_space(space)}, of shape {space.shape}")
    with np.errstate(invalid="ignore"):  # a NaN as a whole number, which the next line finds
        fitted = array.astype(kind)
    if kind.kind in "iub" and not np.array_equal(fitted, array):
        raise ValueError(f"of type {array.dtype}{where}, whose numbers are not all of type {kind}, as its space says")
    if counted:
        count = 2 if isinstance(space, spaces.MultiBinary) else getattr(space, "nvec", getattr(space, "n", 0))
        start = np.asarray(getattr(space, "start", 0), dtype=np.int64)
        outside = fitted[(fitted < start) | (fitted >= start + count)]  # a small type may not hold the first beyond it
        if outside.size:
            raise ValueError(f"with {outside.flat[0]}{where}, which is not in its space, {shown_space(space)}")
    return fitted if fitted.shape else fitted[()]


def shown_space(space: gym.Space) -> str:
    """A space in a sentence."""
    return " ".join(str(space).split())


def mask_in(obs: Any, info: Mapping[str, Any]) -> tuple[str, Any]:
    """The name of an action mask in `info`, or "" of one in the observation, and the mask; ("", None) where none is."""
    for name in MASKS:
        if name in info:
            return name, info[name]
        if isinstance(obs, Mapping) and name in obs:
            return "", obs[name]
    return "", None


def flat_mask(mask: Any, action: gym.Space | Action) -> np.ndarray:
    """An action mask as one row, [n] bool; of a MultiDiscrete, those of its components one after the other.

    None permits everything. Raises `ValueError`, with the rest of a sentence, for another size, and for actions that
    are no choices.
    """
    if not isinstance(action, spaces.Discrete | spaces.MultiDiscrete | Discrete | MultiDiscrete):
        raise ValueError("that cannot be followed: masks are for Discrete and MultiDiscrete actions")
    choices = np.sum(action.n if isinstance(action, spaces.Discrete | Discrete) else action.nvec)
    row = np.ones(choices) if mask is None else _row(mask)
    if len(row) != choices or not ((row == 0) | (row == 1)).all():
        raise ValueError(f"of {len(row)} numbers, {shown(row.tolist())}; it must have {choices}, of 1 and 0")
    return row.astype(bool)


def _row(mask: Any) -> np.ndarray:
    """Nested tuples and lists of arrays as one row."""
    if isinstance(mask, tuple | list) and len(mask):
        return np.concatenate([_row(part) for part in mask])
    return np.ravel(mask)


def scalars(info: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Every number in `info`, an array of one too, and those of its dictionaries, by "outer/inner"."""
    for key, value in info.items():
        if isinstance(value, float | np.floating):
            yield f"{prefix}{key}", float(value)
        elif isinstance(value, Mapping):
            yield from scalars(value, f"{prefix}{key}/")
        elif isinstance(value, int) or (hasattr(value, "__array__") and math.prod(getattr(value, "shape", (0,))) == 1):
            array = as_array(value)
            if array.dtype.kind in "biuf":
                yield f"{prefix}{key}", float(array.item())
