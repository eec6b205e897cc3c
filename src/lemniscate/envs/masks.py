"""Masks of the actions that are valid, which some environments give in `info["action_mask"]`."""

from typing import Any

import numpy as np

from lemniscate.errors import UserError


class ActionMasks:
    """The present mask of each of N environments with n actions; all are valid where none was given."""

    def __init__(self, env_id: str, num_envs: int, n: int) -> None:
        self._env_id = env_id
        self._masks = np.ones((num_envs, n), dtype=bool)

    def append_to(self, flat: np.ndarray, info: dict[str, Any]) -> np.ndarray:
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
