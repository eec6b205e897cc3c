"""What passes between a policy and environments at every step: returns, checked and laid out, and actions."""

from collections.abc import Iterator, Mapping
from functools import lru_cache, reduce
from operator import getitem
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from lemniscate.envs.returned import (
    EXPLAINED,
    MASKS,
    ReturnedValues,
    as_array,
    close_or_say,
    flat_mask,
    kind_of,
    layers,
    mask_in,
    require_form,
    scalars,
    shown_space,
)
from lemniscate.errors import UserError
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, ObservationPart

SUCCESS = ("is_success", "success")
"""what robotics environments call their success: 1 or 0, or True and False"""

APART = {*MASKS, "final_info", "final_obs", "env_id", "players", "elapsed_step"}
"""entries of the info of a vector environment that measure nothing"""


class SingleEnv(gym.Wrapper):
    """One environment whose returns are checked, and whose `info` has numbers and the action mask alone.

    Those of nested dictionaries are named "outer/inner". The mask is a row in `info["action_mask"]`, wherever it stood.

    Raises:
        UserError: an environment without spaces, or whose reset takes no seed or no options.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        require_form(env, ("observation_space", "action_space"))
        self._returns = ReturnedValues(env, env.observation_space)
        self._ask = _mask_of(env)
        seen, self._acts, self._declared = env.observation_space, env.action_space, measures_of(env.metadata)
        self._masked = bool(self._ask or (isinstance(seen, spaces.Dict) and seen.spaces.keys() & set(MASKS)))
        self._shape = seen.shape if isinstance(seen, spaces.Box) else None
        self._dtype = seen.dtype

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Gymnasium's."""
        try:
            # Gymnasium's vectors leave {} of the options by which they reset some of their environments.
            returned: Any = self.env.reset(seed=seed, options=options or None)
        except EXPLAINED as error:
            said = self._returns.explained("reset", error)
            raise said from said.__cause__
        now = self.env.action_space
        if now is not self._acts and now != self._acts:
            was = f"it was {shown_space(self._acts)}, and must stay what __init__ set"
            raise self._returns.wrong("reset", f"made action_space {shown_space(now)}; {was}")
        two = type(returned) is tuple and len(returned) == 2
        usual = two and self._is_usual(returned[0], 0.0, False, False, returned[1])
        obs, info = returned if usual else self._returns.read_reset(returned)
        obs = obs.copy() if usual else obs  # several environments may write into one array
        return obs, self._reduced("reset", obs, info) if info or self._masked else info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Gymnasium's."""
        try:
            returned: Any = self.env.step(action)
        except EXPLAINED as error:
            said = self._returns.explained("step", error)
            raise said from said.__cause__
        usual = type(returned) is tuple and len(returned) == 5 and self._is_usual(*returned)
        obs, reward, terminated, truncated, info = returned if usual else self._returns.read_step(returned)
        obs = obs.copy() if usual else obs  # as in reset
        info = self._reduced("step", obs, info) if info or self._masked else info
        return obs, reward, terminated, truncated, info

    def _is_usual(self, obs: Any, reward: Any, terminated: Any, truncated: Any, info: Any) -> bool:
        """Whether each is of its type already, as mostly: this is asked at every step, and `read_step` is slower."""
        if type(obs) is not np.ndarray or obs.shape != self._shape or obs.dtype != self._dtype:
            return False
        flags = type(terminated) is bool and type(truncated) is bool
        return flags and isinstance(reward, float) and type(info) is dict

    def judge_goals(self, achieved: np.ndarray, desired: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The reward [B] of having achieved goals where others were desired, [B, G] each; whether an episode ends [B].

        Asked row by row, as `step` asks. Without `compute_terminated` no goal ends an episode. There is no info.
        """
        answers = np.zeros((2, len(achieved)), dtype=np.float32)
        for row, name, kind in zip(answers, ("compute_reward", "compute_terminated"), (float, bool), strict=True):
            if self.has_wrapper_attr(name):
                judge = self.get_wrapper_attr(name)
                goals = self._goals("achieved_goal", achieved), self._goals("desired_goal", desired)
                row[:] = [_judged(name, judge, kind, *pair) for pair in zip(*goals, strict=True)]
            elif name == "compute_reward":
                kind = type(self.unwrapped).__name__
                raise UserError(
                    f"{kind} has no compute_reward(achieved_goal, desired_goal, info), by which goals are judged."
                )
        return answers[0], answers[1].astype(bool)

    def _goals(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Goals [B, G] in the shape and the type of their space; new ones, into which a judge may write."""
        space: Any = self.observation_space
        kind, shape = np.dtype(space[name].dtype), space[name].shape
        return (np.rint(rows) if kind.kind in "iu" else rows).astype(kind).reshape(-1, *shape)

    def close(self) -> None:
        """Gymnasium's. An exception in it is said, and costs nothing that was learned."""
        close_or_say(self.env)

    def _reduced(self, method: str, obs: Any, info: dict[str, Any]) -> dict[str, Any]:
        numbers: dict[str, Any] = dict(scalars(info))
        for name in self._declared:
            if info.get(name) is not None and name not in numbers:
                what = f"returned {kind_of(info[name])} as info[{name!r}]; a measure is a number"
                raise self._returns.wrong(method, what)
        if not self._masked and info.keys().isdisjoint(MASKS):
            return numbers
        name, mask = mask_in(obs, info)
        if mask is None and self._ask:
            name, mask = MASKS[0], self._read_mask(*self._ask)
        if mask is not None or (name and isinstance(self.action_space, spaces.Discrete | spaces.MultiDiscrete)):
            try:
                numbers["action_mask"] = flat_mask(mask, self.action_space)
            except ValueError as error:
                raise self._returns.wrong(method, f"comes with an action mask {error}") from None
        return numbers

    def _read_mask(self, layer: Any, name: str) -> Any:
        """The mask that a method or an attribute of a layer gives."""
        try:
            mask = getattr(layer, name)
            return mask() if callable(mask) else mask
        except Exception as error:
            said = f"asked for the action mask without arguments, raised {type(error).__name__}: {error}"
            raise UserError(f"{type(layer).__name__}.{name}, {said}") from error


def _mask_of(env: gym.Env) -> tuple[Any, str] | None:
    """The outermost layer of an environment that has an action mask, as a method, a property or an array; its name."""
    for name in MASKS:
        for layer in layers(env):
            found = getattr(type(layer), name, None)  # before `reset` a property may have nothing to say
            found = found if isinstance(found, property) else getattr(layer, name, None)
            if callable(found) or isinstance(found, property | np.ndarray | list | tuple):
                return layer, name
    return None


def measures_of(metadata: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of an environment's measures: its success, and those that its `metadata["measures"]` lists."""
    named = metadata.get("measures", ()) if isinstance(metadata, Mapping) else ()
    return tuple(dict.fromkeys((*SUCCESS, *([named] if isinstance(named, str) else named))))


def measured(
    info: Mapping[str, Any], declared: tuple[str, ...], num_envs: int, device: torch.device
) -> dict[str, Tensor]:
    """The numbers [N] float32 in the info of a vector environment; NaN where an environment gave none.

    Measures, `declared`, have their names; the others "info/" before it. `info[name]` counts where `info["_" + name]`
    is True; what a dictionary holds, where its own mask is, or else that of the dictionary. Where an environment was
    reset in the same step, its true info is in `info["final_info"]`.
    """
    found: dict[str, Tensor] = {}
    final = info.get("final_info")  # of what is no vector environment it may be anything
    sources = [(info, None), *([(final, info.get("_final_info"))] if isinstance(final, Mapping) else [])]
    for source, outer in sources:
        for key, values, given in _columns(source, outer=outer):
            if values.dtype.kind not in "biuf" or values.size != num_envs:
                if key in declared:
                    raise UserError(f"info[{key!r}] is {kind_of(values)}; a measure is a number for each environment.")
                continue
            numbers = torch.from_numpy(values.reshape(num_envs).astype(np.float32)).to(device)
            name = key if key in declared else f"info/{key}"
            mask = as_array(given)
            if mask.shape == (num_envs,) and mask.dtype == bool and not mask.all():
                before = found.get(name, torch.full((num_envs,), torch.nan, device=device))
                numbers = torch.where(torch.from_numpy(mask).to(device), numbers, before)
            found[name] = numbers
    return found


def _judged(name: str, judge: Any, kind: type, achieved: np.ndarray, desired: np.ndarray) -> float:
    """The answer of a judge of one goal. Raises `UserError` where it raises, or its answer is not of this kind."""
    call = f"{name}(achieved_goal, desired_goal, {{}})"
    try:
        answer = judge(achieved, desired, {})
    except Exception as error:  # one for batches may raise anything
        said = f"{type(error).__name__}: {error}"
        raise UserError(f"{call}, of one goal each, raised {said}.") from error
    array = as_array(answer)
    if array.dtype.kind not in "biuf" or array.size != 1 or (kind is bool and array.item() not in (0, 1)):
        wanted = "a number" if kind is float else "True or False"
        raise UserError(f"{call}, of one goal each, returned {kind_of(answer)}; it must be {wanted}.")
    return float(array.item())


def _columns(info: Mapping[str, Any], prefix: str = "", outer: Any = None) -> Iterator[tuple[str, np.ndarray, Any]]:
    """(name, values, where they count) of each entry that may be a number, those of dictionaries by "outer/inner"."""
    for key, values in info.items():
        if key in APART or key[:1] == "_":
            continue
        given = info.get(f"_{key}", outer)
        if isinstance(values, Mapping):
            yield from _columns(values, f"{prefix}{key}/", given)
        else:
            yield f"{prefix}{key}", np.asarray(values), given


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


def unflatten_observation(parts: tuple[ObservationPart, ...], flat: np.ndarray) -> Any:
    """The inverse of `flatten_observation`, of [N, O] or more; what is neither an image nor counted stays float32."""
    found: dict[Any, Any] = {}
    ends = np.cumsum([part.size for part in parts])
    for part, own in zip(parts, np.split(flat, ends, axis=1), strict=False):  # behind the last may be an action mask
        if part.nvec:
            digits = np.split(own, np.cumsum(part.nvec)[:-1], axis=1)
            own = np.stack([digit.argmax(axis=1) for digit in digits], axis=1) + np.array(part.start)
        own = own.reshape(len(flat), *([part.own_shape[axis] for axis in part.axes] or part.shape))
        own = own.transpose(0, *(np.argsort(part.axes) + 1)) if part.axes else own
        *outer, last = ("", *part.path)
        inside = reduce(lambda tree, key: tree.setdefault(key, {}), outer, found)
        inside[last] = own.astype(np.uint8) if part.image else own
    return _with_tuples(found[""])


def _with_tuples(tree: Any) -> Any:
    """Nested dictionaries, those that are numbered as tuples."""
    if not isinstance(tree, dict):
        return tree
    inside = {key: _with_tuples(value) for key, value in tree.items()}
    return tuple(inside.values()) if list(inside) == list(range(len(inside))) else inside


def _one_hot(part: ObservationPart, obs: Any) -> np.ndarray:
    """A batch of whole numbers, each as a one-hot vector. Raises `ValueError` for one that is not in its space."""
    array = np.asarray(obs)
    if array.dtype.kind == "f" and (array == np.rint(array)).all():
        array = array.astype(np.int64)
    whole = array.astype(np.int64, casting="same_kind")  # of uint64 and int64 NumPy makes float64
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
        return (_require_below(kind.n, action) + kind.start).astype(kind.dtype, copy=False)
    elif isinstance(kind, MultiDiscrete):
        action = (_require_below(np.array(kind.nvec), action) + np.array(kind.start)).astype(kind.dtype)
    else:
        action = _require_below(2, action).astype(np.int8)  # the only type of a MultiBinary
    return action if kind.shape is None else action.reshape(-1, *kind.shape)


def normalized_action(action: np.ndarray, kind: Action) -> np.ndarray:
    """The inverse of `physical_action`: actions [N, …] of an environment, as a policy gives them."""
    flat = action if isinstance(kind, Discrete) else action.reshape(len(action), -1)
    if isinstance(kind, Box):
        _, _, middle, half = scale_of(kind)
        return ((flat - middle) / np.where(half > 0, half, 1)).astype(np.float32)
    return (flat - np.array(getattr(kind, "start", 0))).astype(np.int64)
