"""Gymnasium's spaces, read once into records; images recognized; actions drawn at random."""

import math

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
