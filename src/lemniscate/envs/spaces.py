"""What an environment says of itself, read and checked: its spaces as records; masks; observations given by hand."""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import reduce
from operator import getitem
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torch import Generator, Tensor

from lemniscate.envs.backend import Summary
from lemniscate.envs.conversion import SUCCESS, flatten_observation, row_of
from lemniscate.envs.returned import MASKS, as_array, flat_mask, kind_of, mask_in, shown_space
from lemniscate.errors import UserError, shown
from lemniscate.spec import Action, Box, Discrete, MultiBinary, MultiDiscrete, ObservationPart, Spec

IMAGE_CHANNELS = 16
"""an image has at most so many channels, and a stack of images at most so many images"""

MOST_NUMBERS = 1_000_000
"""of an observation, of which a whole number of n choices is n, and of an action's choices"""

UNBOUNDED, UNBOUNDED_WHOLE = 1e30, 2**31 - 1
"""a bound of actions from which on there is none: libraries write the largest number of a type for infinity"""

WIDE, LARGE = ("float64", "longdouble", "int32", "uint32", "int64", "uint64"), 1e4
"""types of numbers that float32 cannot hold all of, and the size from which on it loses what may matter"""

SUMMARIES = tuple(Summary(f"{name}_at_end", name, "last") for name in SUCCESS)


def observation_parts(space: gym.Space, env_id: str) -> tuple[ObservationPart, ...]:
    """The parts of the flat observation, in order.

    A Box of any shape and dtype is flattened in C order, as float32; so is a MultiBinary. An image of bytes, alone or
    in a Dict, is brought to height × width × channels. Each number of a Discrete or MultiDiscrete becomes one-hot. A
    Dict is laid out in the order of its own keys (Gymnasium sorts them), a Tuple in its order.

    Raises `UserError` for anything else, for no numbers at all, and for a one-hot vector that no network could take.
    """
    parts = tuple(part for part in _parts(space, env_id, ()) if part.size)
    if not parts:
        raise UserError(f"{env_id} observes nothing: its observation_space, {shown_space(space)}, has no numbers.")
    for part in parts:
        if part.nvec and part.size > MOST_NUMBERS:
            raise UserError(
                f"{env_id} observes {shown_space(space)}, whose {part.size:,} choices are each an input of the network;"
                f" at most {MOST_NUMBERS:,} can be. Observe such a number as a Box, or its digits as a MultiDiscrete."
            )
    return parts


def _parts(space: gym.Space, env_id: str, path: tuple[str | int, ...]) -> tuple[ObservationPart, ...]:
    if is_image(space):
        own = tuple(map(int, space.shape or ()))
        axes = _image_axes(own)
        height, width, *channels = (own[axis] for axis in axes)
        shape = (height, width, math.prod(channels))
        layout: dict[str, Any] = {} if own == shape else {"own_shape": own, "axes": axes}
        return (ObservationPart(path, shape, **layout, image=True),)
    if isinstance(space, spaces.Box | spaces.MultiBinary):
        return (ObservationPart(path, tuple(map(int, space.shape))),)
    if isinstance(space, spaces.Discrete):
        return (ObservationPart(path, (), (int(space.n),), (int(space.start),)),)
    if isinstance(space, spaces.MultiDiscrete):
        return (ObservationPart(path, tuple(space.shape), _whole(space.nvec), _whole(space.start)),)
    if isinstance(space, spaces.Dict | spaces.Tuple):
        named = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        named = [(key.item() if isinstance(key, np.generic) else key, part) for key, part in named]
        if odd := [key for key, _ in named if type(key) not in (str, int)]:  # of another type none would be stored
            raise UserError(f"{env_id} observes a Dict with the key {shown(odd[0])}; keys must be texts.")
        inside = [_parts(part, env_id, (*path, name)) for name, part in named]
        return tuple(part for parts in inside for part in parts)
    raise UserError(
        f"{env_id} observes a {type(space).__name__}, whose size is not fixed; what a network can look at is Box,"
        " Discrete, MultiDiscrete, MultiBinary, and Dict and Tuple of these."
    )


def is_image(space: gym.Space) -> bool:
    """Whether it is of images of bytes, or of stacks of images, for a convolutional network; a grey one is [H, W]."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        return False
    whole_range = len(space.shape) > 2 or (space.low.max(initial=0) == 0 and space.high.min(initial=255) == 255)
    return whole_range and bool(_image_axes(space.shape))


def _image_axes(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The order of an image's axes that puts height and width first, then the stack if there is one, then channels."""
    if len(shape) == 4 and shape[0] <= IMAGE_CHANNELS:
        inner = tuple(axis + 1 for axis in _image_axes(shape[1:]))
        return (*inner[:2], 0, *inner[2:]) if inner else ()
    if len(shape) == 2 and min(shape) > IMAGE_CHANNELS:
        return (0, 1)
    if len(shape) != 3 or min(shape[0], shape[2]) > IMAGE_CHANNELS:
        return ()
    return (0, 1, 2) if shape[2] <= shape[0] else (1, 2, 0)


def action_kind(space: gym.Space, env_id: str) -> Action:
    """The action space as a record. Raises `UserError` for what no policy here can act in."""
    choices = int(np.sum(getattr(space, "nvec", getattr(space, "n", 1)), dtype=np.int64))
    if choices > MOST_NUMBERS:
        raise UserError(
            f"{env_id} acts by {shown_space(space)}, whose {choices:,} choices are each an output of the network; at"
            f" most {MOST_NUMBERS:,} can be. Act by a Box, or by the digits of such a number as a MultiDiscrete."
        )
    if 0 in (space.shape or ()):
        raise UserError(f"{env_id} has no actions: its action_space is {shown_space(space)}.")
    if isinstance(space, spaces.Discrete):
        return Discrete(int(space.n), int(space.start), dtype=np.dtype(space.dtype).name)
    if isinstance(space, spaces.MultiDiscrete):
        kind = np.dtype(space.dtype).name
        return MultiDiscrete(_whole(space.nvec), _whole(space.start), tuple(space.shape), dtype=kind)
    if isinstance(space, spaces.MultiBinary):
        return MultiBinary(int(np.prod(space.shape)), tuple(map(int, space.shape)))
    if isinstance(space, spaces.Box):
        most = UNBOUNDED if np.issubdtype(space.dtype, np.floating) else UNBOUNDED_WHOLE
        low, high = (
            tuple(math.copysign(math.inf, x) if abs(x) >= most else x for x in map(float, np.ravel(bound)))
            for bound in (space.low, space.high)
        )
        return Box(low, high, tuple(map(int, space.shape)), space.dtype.name)
    raise UserError(
        f"{env_id} takes {shown_space(space)} actions; what can be acted in is Discrete, MultiDiscrete, MultiBinary and"
        " Box."
    )


def _whole(numbers: np.ndarray) -> tuple[int, ...]:
    return tuple(map(int, np.ravel(numbers)))


def random_action(spec: Spec, obs: Tensor, generator: Generator) -> Tensor:
    """One action for each of the observations [N, O + n], as `VecEnv.step` takes them.

    Uniform in [-1, 1]^A for a Box, over the choices of a Discrete, and over those of each component of a MultiDiscrete
    or MultiBinary; where there is a mask in `obs`, over those that it permits.
    """
    action, drawn = spec.action, {"generator": generator, "device": obs.device}
    num_envs = len(obs)
    if isinstance(action, Box):
        return 2 * torch.rand(num_envs, action.size, **drawn) - 1
    if isinstance(action, MultiBinary):
        return torch.randint(2, (num_envs, action.n), **drawn)
    if isinstance(action, Discrete):
        allowed = obs[:, -action.n :] if action.masked else torch.ones(num_envs, action.n, device=obs.device)
        return torch.multinomial(allowed.float(), 1, generator=generator)[:, 0]
    if action.masked:
        permitted = obs[:, -action.mask_size :].float().split(action.nvec, dim=-1)
        return torch.cat([torch.multinomial(part, 1, generator=generator) for part in permitted], dim=1)
    return torch.stack([torch.randint(n, (num_envs,), **drawn) for n in action.nvec], dim=1)


def notices(spec: Spec) -> list[str]:
    """Sentences on spaces that can be learned in, and may not be as they were meant."""
    found, action = list[str](), spec.action
    for part in spec.observation_parts:
        if not part.image and len(part.shape) > 1 and min(sorted(part.shape)[-2:]) > IMAGE_CHANNELS:
            found.append(
                f"The array {part.name} {part.shape} becomes {part.size:,} numbers without their places; if it is an"
                " image, return uint8 of height × width × channels, or with the channels first, for a convolutional"
                " network."
            )
    if isinstance(action, Box) and not all(map(math.isfinite, (*action.low, *action.high))):
        found.append(
            f"Some actions of {spec.env_id} have no bound, so a policy begins around zero, or one unit from the only"
            " bound; give the Box a finite low and high where there are any."
        )
    return found


class LostDigits:
    """A look at the first observations of 64 bits, and at whole numbers: what float32 takes from them."""

    STEPS, ENVS = 200, 8

    def __init__(self, spec: Spec) -> None:
        self._spec, self._rows = spec, list[np.ndarray]()

    def add(self, raw: Any) -> bool:
        """A batch of observations, as the environment returned it; returns whether that was the last to look at."""
        own = [np.asarray(reduce(getitem, part.path, raw)) for part in self._spec.observation_parts if not part.nvec]
        flat = [x.reshape(len(x), -1)[: self.ENVS].astype(np.float64) for x in own if x.dtype.name in WIDE]
        self._rows += [np.concatenate(flat, axis=1)] if flat else []
        return not flat or len(self._rows) == self.STEPS

    def notices(self) -> list[str]:
        """A sentence on the number that loses most, if half of the different values of one become equal."""
        rows = np.concatenate(self._rows) if self._rows else np.zeros((1, 0))
        columns = [(len(np.unique(x)), len(np.unique(x.astype(np.float32))), float(np.abs(x).max())) for x in rows.T]
        lost = [(before / left, before, left, most) for before, left, most in columns if most >= LARGE and before > 4]
        ratio, before, left, most = max(lost, default=(1, 0, 0, 0))
        if ratio < 2:
            return []
        return [
            f"{self._spec.env_id} observes numbers up to {most:.3g}, too large for the digits of float32: {before}"
            f" different values became {left}. Subtract what is constant in them, in the environment or in a wrapper."
        ]


class ActionMasks:
    """The present action mask [n] of each of N environments, which is the last that was given."""

    def __init__(self, spec: Spec, num_envs: int) -> None:
        self._spec: Any = spec
        self._masks = np.ones((num_envs, spec.action.mask_size), dtype=bool)
        self._given, self._known = np.zeros(num_envs, dtype=bool), set[bool]()
        """[N], whether the newest info had one; and whether those of steps have had one"""

    def append_to(
        self, flat: np.ndarray, obs: Any, info: Mapping[str, Any], numbers: np.ndarray | slice = slice(None)
    ) -> np.ndarray:
        """[N, O] to [N, O + n]: with the masks after it, brought up to date from the observation or the info.

        With `numbers` [M] the rows are of these environments alone. Raises `UserError` for a mask of another size.
        """
        name, mask = mask_in(obs, info)
        masks, given = self._masks[numbers].copy(), np.zeros(len(flat), dtype=bool)
        if name or mask is not None:
            given = np.asarray(info.get(f"_{name}", ~given))
            for row in np.flatnonzero(given):
                masks[row] = self.read_mask(None if mask is None else row_of(mask, int(row)), int(row))
        self._masks[numbers], self._given[numbers] = masks, given
        return np.concatenate([flat, masks.astype(flat.dtype)], axis=-1)

    def require_alike(self, inside: np.ndarray) -> None:
        """Raise `UserError` where of the steps `inside` [N] of episodes, the newest and those before, some had no mask.

        Where none has one, that of the reset holds for the whole episode.
        """
        self._known.update(self._given[inside].tolist())
        if len(self._known) > 1:
            raise UserError(
                f"{self._spec.env_id} gives an action mask in some steps and none in others: give one with each step(),"
                " of ones where all is permitted."
            )

    def read_mask(self, mask: Any, row: int) -> np.ndarray:
        """The mask that environment `row` gave as [n] bool. Raises `UserError` for another size."""
        try:
            return flat_mask(mask, self._spec.action)
        except ValueError as error:
            raise UserError(f"Environment {row} of {self._spec.env_id} has an action mask {error}.") from None

    def require_choice(self, obs: np.ndarray, acting: np.ndarray) -> None:
        """Raise `UserError` where a mask in `obs` [N, O + n] permits nothing to an environment that is `acting` [N].

        After the end of an episode nothing may be left to choose from.
        """
        wrong = acting & ~_permits(obs, self._spec.action)
        if wrong.any():
            name, number = self._spec.env_id, int(np.argmax(wrong))
            raise UserError(f"{name} rules out every action of environment {number}: its action_mask is all zero.")


def _permits(masks: np.ndarray, action: Discrete | MultiDiscrete) -> np.ndarray:
    """[B] bool: the mask at the end of each row [B, …] permits a choice in every component."""
    counts = action.nvec if isinstance(action, MultiDiscrete) else (action.n,)
    parts = np.split(masks[:, masks.shape[1] - action.mask_size :], np.cumsum(counts)[:-1], axis=1)
    return np.all([part.any(axis=1) for part in parts], axis=0)


def masked(action: Action, obs: Any, info: Mapping[str, Any]) -> Action:
    """The record of actions, masked if a first observation, or the info beside it, has an action mask."""
    can = isinstance(action, Discrete | MultiDiscrete) and mask_in(obs, info)[1] is not None
    return replace(action, masked=True) if can else action


def late_mask(spec: Spec) -> UserError:
    """The sentence on an action mask that cannot be followed, since the first observation came without one."""
    remedy = "give one with reset() too, of ones where all is permitted."
    if not isinstance(spec.action, Discrete | MultiDiscrete):
        remedy = "masks are for Discrete and MultiDiscrete actions."
    return UserError(f"{spec.env_id} gives an action mask in step() that reset() did not give: {remedy}")


def read_mask(mask: Any, spec: Spec, flat: np.ndarray) -> np.ndarray:
    """The masks [B, n] for observations [B, O]: of `info["action_mask"]`, for one observation or B of them.

    With None, that in the observation, if it has one; else all is permitted. Raises `UserError` for another size, or a
    mask that permits nothing.
    """
    batch, size = len(flat), spec.action.mask_size
    if mask is None:
        mask = _mask_in_flat(spec, flat)
    array = as_array(mask)
    several = array.ndim > 1 and array.shape == (batch, size)
    try:
        rows = np.stack([flat_mask(row, spec.action) for row in (array if several else [mask])])
    except ValueError as error:
        raise UserError(f"{spec.env_id} has action masks of {size} numbers; this is one {error}.") from None
    if isinstance(spec.action, Discrete | MultiDiscrete) and not _permits(rows, spec.action).all():
        raise UserError(f"This action_mask of {spec.env_id} permits nothing.")
    return np.broadcast_to(rows, (batch, size))


def _mask_in_flat(spec: Spec, flat: np.ndarray) -> np.ndarray:
    """The masks [B, n] that stand in the flat observations themselves; of ones where they have none."""
    ends = np.cumsum([part.size for part in spec.observation_parts])
    columns = [
        flat[:, end - part.size : end]
        for part, end in zip(spec.observation_parts, ends, strict=True)
        if part.path[:1] and part.path[0] in MASKS
    ]
    return np.concatenate(columns, axis=-1) if columns else np.ones((len(flat), spec.action.mask_size))


def read_observation(spec: Spec, obs: Any) -> tuple[np.ndarray, bool]:
    """The flat observations [B, O] of one observation or a batch, and whether it was a batch.

    Args:
        spec: of the environment.
        obs: an array, a number, or a dictionary or tuple of these; or the flat observation [O] or [B, O].

    Raises:
        UserError: another shape than the environment's, or a number that is not finite; for an image, numbers that are
            not whole or not from 0 to 255.
    """
    parts = spec.observation_parts
    try:
        array = None if isinstance(obs, dict | tuple) else np.asarray(obs)
        if np.ma.is_masked(obs):
            raise TypeError("some of its numbers are masked")
        if array is not None and array.dtype.kind in "cSU":
            raise TypeError(f"its numbers are {'complex' if array.dtype.kind == 'c' else 'texts'}")
        if array is not None and _is_flat(spec, array):
            parts = (ObservationPart((), (spec.observation_size,), image=spec.image),)
        batched = _is_batch(parts, obs)
        with np.errstate(over="ignore"):  # to infinity, which is said below
            flat = flatten_observation(parts, obs, image=spec.image)
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise _unreadable(spec, obs, error) from None
    if not np.isfinite(flat).all():
        number = flat[~np.isfinite(flat)][0]
        raise UserError(f"This observation of {spec.env_id} has a number that is {number}; all must be finite.")
    return flat, batched


def _require_bytes(obs: np.ndarray) -> None:
    """`ValueError` unless the numbers of an image fit into bytes; a cast would make black of what is divided by 255."""
    right = "; those of an image are whole, from 0 to 255"
    if not np.issubdtype(obs.dtype, np.integer):
        raise ValueError(f"its numbers are {obs.dtype}{right}")
    if obs.size and (obs.min() < 0 or obs.max() > 255):
        raise ValueError(f"its numbers are from {obs.min()} to {obs.max()}{right}")


def _is_flat(spec: Spec, obs: np.ndarray) -> bool:
    """Whether it is [O] or [B, O], laid out as policies see it, and not as the environment returns it."""
    first = spec.observation_parts[0]
    counted = bool(first.nvec) and np.issubdtype(obs.dtype, np.integer)  # numbers that are yet to become one-hot
    right_size = obs.ndim in (1, 2) and obs.shape[-1] == spec.observation_size
    return right_size and obs.shape != first.shape and not counted


def _is_batch(parts: tuple[ObservationPart, ...], obs: Any) -> bool:
    """Whether each part has one dimension more than the environment gives it; `ValueError` for any other shape."""
    sizes: set[tuple[int, ...]] = set()
    for part in parts:
        given, own = np.asarray(reduce(getitem, part.path, obs)), part.own_shape or part.shape
        extra = given.ndim - len(own)
        if extra not in (0, 1) or given.shape[extra:] != own:
            raise ValueError(f"{part.name} has the shape {given.shape}")
        if part.image:
            _require_bytes(given)
        sizes.add(given.shape[:extra])
    if len(sizes) > 1:
        raise ValueError(f"its parts are batches of different sizes, {sizes}")
    return sizes != {()}


def _unreadable(spec: Spec, obs: Any, error: Exception) -> UserError:
    shapes = ", ".join(f"{part.name} {part.own_shape or part.shape}" for part in spec.observation_parts)
    if isinstance(obs, tuple) and len(obs) > 1 and isinstance(obs[-1], dict):
        reason = "it is what `reset` or `step` returned, of which it is the first part"
    elif (
        isinstance(error, IndexError | TypeError)
        and spec.observation_parts[0].path
        and not isinstance(obs, dict | tuple)
    ):
        reason = f"it is {kind_of(obs)}, and its parts are to be in a dictionary or a tuple"
    else:
        reason = f"no {error} in it" if isinstance(error, KeyError) else str(error)
    return UserError(f"{spec.env_id} observes {shapes}, or a batch of these; this cannot be read: {reason}.")
