"""Gymnasium's spaces as records: observations flattened, images recognized, actions scaled and drawn at random."""

import math
from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torch import Generator, Tensor

from lemniscate.errors import UserError
from lemniscate.spec import Action, Box, Discrete, MultiBinary, MultiDiscrete, ObservationPart, Spec

IMAGE_CHANNELS = 16
"""an image has at most so many channels, and a stack of images at most so many images"""


def observation_parts(space: gym.Space, env_id: str, path: tuple[str | int, ...] = ()) -> tuple[ObservationPart, ...]:
    """The parts of the flat observation, in order.

    A Box of any shape and dtype is flattened in C order, as float32; so is a MultiBinary. An image of bytes is brought
    to height × width × channels. Each number of a Discrete or MultiDiscrete becomes one-hot. A Dict is laid out in the
    order of its own keys (Gymnasium sorts them), a Tuple in its order. Raises `UserError` for anything else.
    """
    if not path and is_image(space):
        return (image_part(tuple(map(int, space.shape or ()))),)
    if isinstance(space, spaces.Box | spaces.MultiBinary):
        return (ObservationPart(path, tuple(map(int, space.shape))),)
    if isinstance(space, spaces.Discrete):
        return (ObservationPart(path, (), (int(space.n),), (int(space.start),)),)
    if isinstance(space, spaces.MultiDiscrete):
        return (ObservationPart(path, tuple(space.shape), _whole(space.nvec), _whole(space.start)),)
    if isinstance(space, spaces.Dict):
        inside = [observation_parts(part, env_id, (*path, name)) for name, part in space.spaces.items()]
        return tuple(part for parts in inside for part in parts)
    if isinstance(space, spaces.Tuple):
        inside = [observation_parts(part, env_id, (*path, i)) for i, part in enumerate(space.spaces)]
        return tuple(part for parts in inside for part in parts)
    raise UserError(
        f"{env_id} observes a {type(space).__name__}, whose size is not fixed; what a network can look at is Box,"
        " Discrete, MultiDiscrete, MultiBinary, and Dict and Tuple of these."
    )


def flatten_observation(parts: tuple[ObservationPart, ...], obs: Any, *, image: bool = False) -> np.ndarray:
    """A batch of raw observations as [N, O]: float32, or the bytes of an image."""
    pieces = [_flatten(part, follow(part.path, obs), image) for part in parts]
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=-1)


def follow(path: tuple[str | int, ...], obs: Any) -> Any:
    """The piece of an observation that a part's path leads to."""
    for step in path:
        obs = obs[step]
    return obs


def row_of(batch: Any, row: int) -> Any:
    """One observation out of a batch of them, which may be a dictionary, a tuple or an array."""
    if isinstance(batch, dict):
        return {name: row_of(part, row) for name, part in batch.items()}
    return tuple(row_of(part, row) for part in batch) if isinstance(batch, tuple) else batch[row]


def _flatten(part: ObservationPart, obs: Any, image: bool) -> np.ndarray:
    if part.nvec:
        numbers = np.asarray(obs).reshape(-1, len(part.nvec)) - np.array(part.start)
        if (numbers < 0).any() or (numbers >= np.array(part.nvec)).any():
            raise ValueError(f"{part.name} is {obs}, which is not in its space")
        hot = np.zeros((len(numbers), part.size), dtype=np.float32)
        columns = numbers + np.cumsum((0, *part.nvec[:-1]))
        hot[np.arange(len(numbers))[:, None], columns] = 1
        return hot
    numbers = np.asarray(obs, dtype=np.uint8 if image else np.float32)
    if part.axes:
        numbers = numbers.reshape(-1, *part.own_shape).transpose(0, *(axis + 1 for axis in part.axes))
    return numbers.reshape(-1, part.size)


def is_image(space: gym.Space) -> bool:
    """Whether observations are images of bytes, or stacks of images: they stay bytes, for a convolutional network."""
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and bool(_image_axes(space.shape))


def _image_axes(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The order of an image's axes that puts height and width first, then the stack if there is one, then channels."""
    if len(shape) == 4 and shape[0] <= IMAGE_CHANNELS:
        inner = tuple(axis + 1 for axis in _image_axes(shape[1:]))
        return (*inner[:2], 0, *inner[2:]) if inner else ()
    if len(shape) != 3 or min(shape[0], shape[2]) > IMAGE_CHANNELS:
        return ()
    return (0, 1, 2) if shape[2] <= shape[0] else (1, 2, 0)


def image_part(own: tuple[int, ...]) -> ObservationPart:
    """The part of an observation that is an image of the shape `own`, laid out height × width × channels."""
    axes = _image_axes(own)
    height, width, *channels = (own[axis] for axis in axes)
    shape = (height, width, math.prod(channels))
    return ObservationPart((), shape) if own == shape else ObservationPart((), shape, own_shape=own, axes=axes)


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


def scale_action(action: np.ndarray, box: Box) -> np.ndarray:
    """Actions of a policy to physical units, [N, A], in the dtype of the space; what lies outside is clipped.

        a_phys = clip(low + ½ (a + 1) (high − low), low, high)

    With one infinite bound, −1 is the finite one and the unit stays: low + 1 + a, or high − 1 + a. With two, a is not
    changed.
    """
    low, high, middle, half = scale_of(box)
    return np.minimum(np.maximum(middle + half * action, low), high)


@lru_cache
def scale_of(box: Box) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """low, high, middle and half of the width of each coordinate, [A] each, as `scale_action` takes them."""
    low, high = np.array(box.low, dtype=box.dtype), np.array(box.high, dtype=box.dtype)
    below, above = np.isfinite(low), np.isfinite(high)
    with np.errstate(invalid="ignore"):  # ∞ − ∞, of which nothing is taken
        cases = [(below & above, 0.5 * low + 0.5 * high), (below & ~above, low + 1), (~below & above, high - 1)]
        half = np.where(below & above, 0.5 * high - 0.5 * low, 1).astype(box.dtype)
    middle = np.select(*zip(*cases, strict=True), default=0).astype(box.dtype)
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
        action = _require_below(np.array(kind.nvec), action) + np.array(kind.start)
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
