"""What an environment returns, read and checked: observations, action masks, measures beside the reward."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.backend import Summary
from lemniscate.envs.conversion import flatten_observation, follow
from lemniscate.errors import UserError
from lemniscate.spec import Spec

SUCCESS = ("is_success", "success")
"""what robotics environments call their success: 1 or 0, or True and False"""

SUMMARIES = tuple(Summary(f"{name}_at_end", name, "last") for name in SUCCESS)


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
        if spec.image:
            _require_bytes(np.asarray(obs))
        if not isinstance(obs, dict | tuple) and _is_flat(spec, np.asarray(obs)):
            flat = np.asarray(obs, dtype=np.uint8 if spec.image else np.float32)
            flat, batched = flat.reshape(-1, spec.observation_size), flat.ndim == 2
        else:
            batched = _is_batch(spec, obs)
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
        shape, own = np.shape(follow(part.path, obs)), part.own_shape or part.shape
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
