"""What an environment says and returns, read and checked: its spaces as records, observations, masks and measures."""

import math
from collections.abc import Mapping
from functools import reduce
from operator import getitem
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torch import Generator, Tensor

from lemniscate.envs.backend import Summary
from lemniscate.envs.conversion import flatten_observation
from lemniscate.errors import UserError
from lemniscate.spec import Action, Box, Discrete, MultiBinary, MultiDiscrete, ObservationPart, Spec

IMAGE_CHANNELS = 16
"""an image has at most so many channels, and a stack of images at most so many images"""

SUCCESS = ("is_success", "success")
"""what robotics environments call their success: 1 or 0, or True and False"""

SUMMARIES = tuple(Summary(f"{name}_at_end", name, "last") for name in SUCCESS)


def observation_parts(space: gym.Space, env_id: str, path: tuple[str | int, ...] = ()) -> tuple[ObservationPart, ...]:
    """The parts of the flat observation, in order.

    A Box of any shape and dtype is flattened in C order, as float32; so is a MultiBinary. An image of bytes, alone or
    in a Dict, is brought to height × width × channels. Each number of a Discrete or MultiDiscrete becomes one-hot. A
    Dict is laid out in the order of its own keys (Gymnasium sorts them), a Tuple in its order. Raises `UserError` for
    anything else.
    """
    if is_image(space):
        return (image_part(path, tuple(map(int, space.shape or ()))),)
    if isinstance(space, spaces.Box | spaces.MultiBinary):
        return (ObservationPart(path, tuple(map(int, space.shape))),)
    if isinstance(space, spaces.Discrete):
        return (ObservationPart(path, (), (int(space.n),), (int(space.start),)),)
    if isinstance(space, spaces.MultiDiscrete):
        return (ObservationPart(path, tuple(space.shape), _whole(space.nvec), _whole(space.start)),)
    if isinstance(space, spaces.Dict | spaces.Tuple):
        named = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        inside = [observation_parts(part, env_id, (*path, name)) for name, part in named]
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


def image_part(path: tuple[str | int, ...], own: tuple[int, ...]) -> ObservationPart:
    """The part of an observation that is an image of the shape `own`, laid out height × width × channels."""
    axes = _image_axes(own)
    height, width, *channels = (own[axis] for axis in axes)
    shape = (height, width, math.prod(channels))
    layout: dict[str, Any] = {} if own == shape else {"own_shape": own, "axes": axes}
    return ObservationPart(path, shape, **layout, image=True)


def action_kind(space: gym.Space, env_id: str) -> Action:
    """The action space as a record. Raises `UserError` for what no policy here can act in."""
    if isinstance(space, spaces.Discrete):
        return Discrete(int(space.n), int(space.start))
    if isinstance(space, spaces.MultiDiscrete):
        return MultiDiscrete(_whole(space.nvec), _whole(space.start), tuple(space.shape))
    if isinstance(space, spaces.MultiBinary):
        return MultiBinary(int(np.prod(space.shape)), tuple(map(int, space.shape)))
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating):
        low, high = (tuple(map(float, np.ravel(bound))) for bound in (space.low, space.high))
        return Box(low, high, tuple(map(int, space.shape)), space.dtype.name)
    raise UserError(
        f"{env_id} takes {space} actions; what can be acted in is Discrete, MultiDiscrete, MultiBinary and a Box of"
        " floating-point numbers."
    )


def _whole(numbers: np.ndarray) -> tuple[int, ...]:
    return tuple(map(int, np.ravel(numbers)))


def random_action(spec: Spec, obs: Tensor, generator: Generator) -> Tensor:
    """One action for each of the observations [N, O + n], as `VecEnv.step` takes them.

    Uniform in [-1, 1]^A for a Box, over the n choices of a Discrete (those that the mask in `obs` allows), and over the
    choices of each component of a MultiDiscrete or MultiBinary.
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
    return torch.stack([torch.randint(n, (num_envs,), **drawn) for n in action.nvec], dim=1)


def measures_of(metadata: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of an environment's measures: its success, and those that its `metadata["measures"]` lists."""
    return tuple(dict.fromkeys((*SUCCESS, *metadata.get("measures", ()))))


def measured(info: Mapping[str, Any], names: tuple[str, ...], num_envs: int, device: torch.device) -> dict[str, Tensor]:
    """The measures [N] float32 in the info of a vector environment; NaN where an environment gave none.

    `info[name]` counts where `info["_" + name]` is True. Where an environment was reset in the same step, its true
    info is in `info["final_info"]`.
    """
    found: dict[str, Tensor] = {}
    for source in (info, info.get("final_info", {})):
        for name in names:
            if name in source:
                values = np.asarray(source[name], dtype=np.float32)
                given = torch.from_numpy(source.get(f"_{name}", np.ones(num_envs, dtype=bool))).to(device)
                before = found.get(name, torch.full((num_envs,), torch.nan, device=device))
                found[name] = torch.where(given, torch.from_numpy(values).to(device), before)
    return found


class ActionMasks:
    """The present action mask of each of N environments with n actions; all are valid where none was given."""

    def __init__(self, env_id: str, num_envs: int, n: int) -> None:
        self._env_id = env_id
        self._masks = np.ones((num_envs, n), dtype=bool)

    def append_to(self, flat: np.ndarray, info: Mapping[str, Any]) -> np.ndarray:
        """[N, O] to [N, O + n]: with the masks after it, brought up to date from `info`.

        Raises `UserError` where an environment rules out every action.
        """
        if "action_mask" in info:
            self._masks = self._masks.copy()
            for row in np.flatnonzero(info.get("_action_mask", np.ones(len(flat), dtype=bool))):
                self._masks[row] = info["action_mask"][row]
            if not self._masks.any(axis=1).all():
                number = int(np.argmin(self._masks.any(axis=1)))
                raise UserError(
                    f"{self._env_id} rules out every action of environment {number}: its action_mask is all zero."
                )
        return np.concatenate([flat, self._masks.astype(flat.dtype)], axis=-1)


def read_mask(mask: Any, batch: int, n: int) -> np.ndarray:
    """The action masks [B, n] of `info["action_mask"]`, [n] or [B, n]; None permits every action.

    Raises:
        UserError: another shape, or a row that permits nothing.
    """
    mask = np.ones(n) if mask is None else np.asarray(mask)
    if mask.shape not in ((n,), (batch, n)) or not mask.any(-1).all():
        wrong = "permits nothing" if mask.shape[-1:] == (n,) else f"has the shape {mask.shape}"
        raise UserError(f"An action_mask is ({n},) or a batch, ({batch}, {n}), of 1 and 0; this one {wrong}.")
    return np.broadcast_to(mask, (batch, n))


def read_observation(spec: Spec, obs: Any) -> tuple[np.ndarray, bool]:
    """The flat observations [B, O] of one observation or a batch, and whether it was a batch.

    Args:
        spec: of the environment.
        obs: an array, a number, or a dictionary or tuple of these; or the flat observation [O] or [B, O].

    Raises:
        UserError: another shape than the environment's, or a number that is not finite; for an image, numbers that are
            not whole or not from 0 to 255.
    """
    try:
        if not isinstance(obs, dict | tuple) and _is_flat(spec, np.asarray(obs)):
            if spec.image:
                _require_bytes(np.asarray(obs))
            flat = np.asarray(obs, dtype=np.uint8 if spec.image else np.float32)
            flat, batched = flat.reshape(-1, spec.observation_size), flat.ndim == 2
        else:
            batched = _is_batch(spec, obs)
            for part in spec.observation_parts:
                if part.image:
                    _require_bytes(np.asarray(reduce(getitem, part.path, cast(Any, obs))))
            flat = flatten_observation(spec.observation_parts, obs, image=spec.image)
    except (KeyError, IndexError, TypeError, ValueError) as error:
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


def _is_batch(spec: Spec, obs: Any) -> bool:
    """Whether each part has one dimension more than the environment gives it; `ValueError` for any other shape."""
    sizes: set[tuple[int, ...]] = set()
    for part in spec.observation_parts:
        shape, own = np.shape(reduce(getitem, part.path, obs)), part.own_shape or part.shape
        extra = len(shape) - len(own)
        if extra not in (0, 1) or shape[extra:] != own:
            raise ValueError(f"{part.name} has the shape {shape}")
        sizes.add(shape[:extra])
    if len(sizes) > 1:
        raise ValueError(f"its parts are batches of different sizes, {sizes}")
    return sizes != {()}


def _unreadable(spec: Spec, obs: Any, error: Exception) -> UserError:
    shapes = ", ".join(f"{part.name} {part.own_shape or part.shape}" for part in spec.observation_parts)
    if isinstance(obs, tuple) and len(obs) > 1 and isinstance(obs[-1], dict):
        reason = "it is what `reset` or `step` returned, of which it is the first part"
    else:
        reason = f"no {error} in it" if isinstance(error, KeyError) else str(error)
    return UserError(f"{spec.env_id} observes {shapes}, or a batch of these; this cannot be read: {reason}.")
