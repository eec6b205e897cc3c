"""What happens at every step: observations flattened for a policy, its actions in the units of the environment."""

from functools import lru_cache, reduce
from operator import getitem
from typing import Any

import numpy as np

from lemniscate.errors import UserError
from lemniscate.spec import Action, Box, Discrete, MultiBinary, MultiDiscrete, ObservationPart


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
    numbers = np.asarray(obs).reshape(-1, len(part.nvec)) - np.array(part.start)
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
