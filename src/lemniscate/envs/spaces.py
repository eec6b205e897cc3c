"""Gymnasium spaces, read once into records; observations flattened, actions scaled."""

from functools import lru_cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from lemniscate.errors import UserError
from lemniscate.types import Action, Box, Discrete, MultiBinary, MultiDiscrete, Part

IMAGE_CHANNELS = 16
"""a uint8 array of three dimensions with at most so many channels in its last one is an image"""


def observation_layout(space: gym.Space, env_id: str, path: tuple[str | int, ...] = ()) -> tuple[Part, ...]:
    """The parts of the flat observation, in order.

    A Box of any shape and dtype is flattened in C order, as float32; so is a MultiBinary. Each number of a Discrete or
    MultiDiscrete becomes one-hot. A Dict is laid out in the order of its own keys (Gymnasium sorts them), a Tuple in
    its order. Raises `UserError` for anything else.
    """
    if isinstance(space, spaces.Box | spaces.MultiBinary):
        return (Part(path, tuple(map(int, space.shape))),)
    if isinstance(space, spaces.Discrete):
        return (Part(path, (), (int(space.n),), (int(space.start),)),)
    if isinstance(space, spaces.MultiDiscrete):
        return (Part(path, tuple(space.shape), _whole(space.nvec), _whole(space.start)),)
    if isinstance(space, spaces.Dict):
        inside = [observation_layout(part, env_id, (*path, name)) for name, part in space.spaces.items()]
        return tuple(part for parts in inside for part in parts)
    if isinstance(space, spaces.Tuple):
        inside = [observation_layout(part, env_id, (*path, i)) for i, part in enumerate(space.spaces)]
        return tuple(part for parts in inside for part in parts)
    raise UserError(
        f"{env_id} observes a {type(space).__name__}, whose size is not fixed; what a network can look at is Box,"
        " Discrete, MultiDiscrete, MultiBinary, and Dict and Tuple of these."
    )


def is_image(space: gym.Space) -> bool:
    """Whether observations are bytes, height × width × channels: those stay bytes, for a convolutional network."""
    shape = space.shape or ()
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(shape) == 3 and shape[2] <= IMAGE_CHANNELS


def flatten_observation(layout: tuple[Part, ...], obs: Any, *, image: bool = False) -> np.ndarray:
    """A batch of raw observations as [N, O]: float32, or the bytes of an image."""
    pieces = [_flatten(part, _follow(part.path, obs), image) for part in layout]
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces, axis=-1)


def _follow(path: tuple[str | int, ...], obs: Any) -> Any:
    for step in path:
        obs = obs[step]
    return obs


def _flatten(part: Part, obs: Any, image: bool) -> np.ndarray:
    if part.nvec:
        numbers = np.asarray(obs).reshape(-1, len(part.nvec)) - np.array(part.start)
        hot = [np.eye(n, dtype=np.float32)[numbers[:, k]] for k, n in enumerate(part.nvec)]
        return np.concatenate(hot, axis=-1)
    return np.asarray(obs, dtype=np.uint8 if image else np.float32).reshape(-1, part.size)


def action_kind(space: gym.Space, env_id: str) -> Action:
    """The action space as a record. Raises `UserError` for what no policy here can act in."""
    if isinstance(space, spaces.Discrete):
        return Discrete(int(space.n), int(space.start))
    if isinstance(space, spaces.MultiDiscrete):
        return MultiDiscrete(_whole(space.nvec), _whole(space.start), tuple(space.shape))
    if isinstance(space, spaces.MultiBinary):
        return MultiBinary(int(np.prod(space.shape)), tuple(map(int, space.shape)))
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating):
        low, high = (tuple(map(float, np.ravel(np.float32(bound)))) for bound in (space.low, space.high))
        return Box(low, high, tuple(map(int, space.shape)))
    raise UserError(
        f"{env_id} takes {space} actions; what can be acted in is Discrete, MultiDiscrete, MultiBinary and a Box of"
        " floating-point numbers."
    )


def _whole(numbers: np.ndarray) -> tuple[int, ...]:
    return tuple(map(int, np.ravel(numbers)))


def scale_action(action: np.ndarray, box: Box) -> np.ndarray:
    """Actions in [-1, 1]^A to physical units, [N, A]; what lies outside is clipped.

        a_phys = low + ½ (clip(a, −1, 1) + 1) (high − low)

    A coordinate with an infinite bound is not scaled, only clipped to its bounds.
    """
    floor, ceiling, base, half = _scale(box)
    return base + half * np.minimum(np.maximum(action, floor), ceiling)


@lru_cache
def _scale(box: Box) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    low, high = np.array(box.low, dtype=np.float32), np.array(box.high, dtype=np.float32)
    finite = np.isfinite(low) & np.isfinite(high)
    low_or_0, high_or_0 = np.where(finite, low, 0), np.where(finite, high, 0)
    half = np.where(finite, 0.5 * high_or_0 - 0.5 * low_or_0, 1)
    return np.where(finite, -1, low), np.where(finite, 1, high), 0.5 * (low_or_0 + high_or_0), half


def physical_action(action: np.ndarray, kind: Action) -> np.ndarray:
    """What a policy chose, as `env.step` wants it: in the environment's own units and shape, [N, …]."""
    if isinstance(kind, Discrete):
        return action + kind.start
    if isinstance(kind, Box):
        action = scale_action(action, kind)
    elif isinstance(kind, MultiDiscrete):
        action = action + np.array(kind.start)
    return action if kind.shape is None else action.reshape(-1, *kind.shape)
