"""What environments give in `info`: the masks of valid actions, and measures beside the reward."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.backend import Summary
from lemniscate.errors import UserError

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
