"""Measures that environments give in `info`."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.backend import Summary

STANDARD = ("is_success", "success")
"""what robotics environments call their success: 1 or 0, or True and False"""

SUMMARIES = tuple(Summary(f"{name}_at_end", name, "last") for name in STANDARD)


def measures_of(metadata: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of an environment's measures: the standard ones, and those that its `metadata["measures"]` lists."""
    return tuple(dict.fromkeys((*STANDARD, *metadata.get("measures", ()))))


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
