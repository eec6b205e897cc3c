"""`manifest.json`: what every number of an exported policy means, and where it is from."""

import hashlib
import importlib.metadata
import math
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lemniscate import algos
from lemniscate.api.policy import TrainedPolicy
from lemniscate.envs.backend import Interface, Quantity
from lemniscate.exporting.deployed import safe_action, safe_sentence
from lemniscate.exporting.operations import Program
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, ObservationPart, Spec

FORMAT = 1
LICENCE = (
    "The policy is its owner's. What lemniscate adds to it in policy.c and policy.h is under the MIT licence;"
    " crazyflie/policy_controller.c, where it is, under the GPL, version 3."
)


def manifest(
    policy: TrainedPolicy, program: Program, interface: Interface, obs: np.ndarray, files: Mapping[str, bytes]
) -> dict[str, Any]:
    """The record of an export.

    Args:
        policy: the exported policy.
        program: its translation.
        interface: of its environment.
        obs: observations of its episodes, [R, O]; their range is that of each observation's entry.
        files: the content of the other files, for their sha256.
    """
    action = policy.spec.action
    seen = zip(obs.min(0).tolist(), obs.max(0).tolist(), strict=True)
    return {
        "export": FORMAT,
        "title": title(policy),
        "environment": policy.spec.env_id,
        "env_kwargs": dict(policy.config.env_kwargs),
        "algorithm": algorithm(policy),
        "step": policy.step,
        "seed": policy.config.seed,
        "lemniscate": version(),
        "commit": commit(),
        "control_period_s": interface.period,
        "delay_s": interface.delay,
        "history": interface.history,
        "dynamics": interface.dynamics,
        "vehicle": interface.vehicle,
        "products": "bfloat16 between hidden layers, as in training" if program.is_rounded else "float32",
        "deterministic": True,
        "observations": [
            {"index": i, **vars(quantity), "range": list(ends)}
            for i, (quantity, ends) in enumerate(zip(observed(policy.spec, interface), seen, strict=True))
        ],
        "actions": [
            {"index": i, **vars(quantity), "range": ends}
            for i, (quantity, ends) in enumerate(zip(acted(action, interface), ranges(action), strict=True))
        ],
        "safe_action": safe_action(action).tolist(),
        "safe_action_is": f"where an observation is not finite, policy.c writes {safe_sentence(action)}, and returns 1",
        "licence": LICENCE,
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
    }


def version() -> str:
    """The version of lemniscate that is installed; "unknown" where its source runs without being installed."""
    try:
        return importlib.metadata.version("lemniscate")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


@cache
def commit() -> str | None:
    """The commit of lemniscate's source, where it runs from its repository."""
    folder = Path(__file__).parent
    try:
        # the first command fails where lemniscate is installed into the directory of another repository
        for command in (["ls-files", "--error-unmatch", "__init__.py"], ["rev-parse", "HEAD"]):
            done = subprocess.run(["git", *command], cwd=folder, capture_output=True, text=True, timeout=10, check=True)
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def title(policy: TrainedPolicy) -> str:
    """The environment, algorithm, seed and step of a policy, in a line."""
    return f"A policy for {policy.spec.env_id}: {algorithm(policy)}, seed {policy.config.seed}, step {policy.step:,}."


def algorithm(policy: TrainedPolicy) -> str:
    """The name of the algorithm that trained a policy."""
    return algos.name_of(sys.modules[type(policy.config).__module__])


def observed(spec: Spec, interface: Interface) -> list[Quantity]:
    """The quantities of the whole observation; where the environment says nothing, the names of its parts."""
    found: list[Quantity] = []
    for part in spec.observation_parts:
        known = interface.parts.get(part.name, ())
        found += known if len(known) == part.size else map(Quantity, _names(part))
    if isinstance(spec.action, Discrete) and spec.action.masked:
        found += [Quantity(f"action_mask[{i}]") for i in range(spec.action.n)]
    return found


def _names(part: ObservationPart) -> list[str]:
    if part.nvec:  # one-hot
        places = [f"[{i}]" if len(part.nvec) > 1 else "" for i in range(len(part.nvec))]
        columns = zip(places, part.start, part.nvec, strict=True)
        return [f"{part.name}{place}={first + i}" for place, first, n in columns for i in range(n)]
    return [part.name] if part.size == 1 else [f"{part.name}[{i}]" for i in range(part.size)]


def acted(action: Action, interface: Interface) -> list[Quantity]:
    """The quantities of the action."""
    size = len(ranges(action))
    if len(interface.action) == size:
        return list(interface.action)
    return [Quantity("action" if size == 1 else f"action[{i}]") for i in range(size)]


def ranges(action: Action) -> list[list[float | None]]:
    """The lowest and the highest number of each coordinate; None where there is none."""
    if isinstance(action, Box):
        ends = zip(action.low, action.high, strict=True)
        return [[end if math.isfinite(end) else None for end in pair] for pair in ends]
    if isinstance(action, Discrete):
        return [[action.start, action.start + action.n - 1]]
    if isinstance(action, MultiDiscrete):
        return [[first, first + n - 1] for first, n in zip(action.start, action.nvec, strict=True)]
    return [[0, 1]] * action.n
