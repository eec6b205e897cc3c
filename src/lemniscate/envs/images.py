"""Images of bytes: recognized by their shape, with channels first or last, and stacked or not."""

import math

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from lemniscate.spec import ObservationPart

IMAGE_CHANNELS = 16
"""an image has at most so many channels, and a stack of images at most so many images"""


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
