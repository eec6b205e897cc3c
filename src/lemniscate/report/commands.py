"""The command lines that train and evaluate a run again, from what its directory holds."""

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lemniscate import algos
from lemniscate.errors import UserError
from lemniscate.run.config import flag


def default_fields(algorithm: str) -> dict[str, Any]:
    """The default of each field of an algorithm, as `config.json` would hold it; empty if there is no such module."""
    try:
        return algos.find(algorithm).Config().to_json()
    except UserError:
        return {}


def changed_fields(algorithm: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a run that are not at their defaults; all, if these are not known."""
    defaults = default_fields(algorithm)
    return {name: value for name, value in config.items() if name not in defaults or defaults[name] != value}


def train(algorithm: str, config: Mapping[str, Any], *, seeds: str | None = None) -> str:
    """The command that trains a run of this Config; with `seeds`, such as "1,2,3", a sweep of it."""
    words = ["lemniscate", "train", algorithm, "--preset", "default", "--env", str(config.get("env"))]
    changed = {name: value for name, value in changed_fields(algorithm, config).items() if name not in ("env", "seed")}
    words += ["--seeds", seeds] if seeds else ["--seed", str(config.get("seed"))]
    for name, value in {"total_steps": config.get("total_steps"), **changed}.items():
        words += _option(name, value)
    return shlex.join(words)


def evaluate(run: Path, episodes: int, seed: int) -> str:
    """The command that evaluates a run's newest policy."""
    return shlex.join(["lemniscate", "evaluate", str(run), "--episodes", str(episodes), "--seed", str(seed)])


def _option(name: str, value: Any) -> list[str]:
    """The words of one field on the command line."""
    if isinstance(value, bool):
        return [flag(name) if value else flag(name).replace("--", "--no-", 1)]
    if isinstance(value, list):
        return [flag(name), *map(str, value or ["none"])]
    if isinstance(value, dict):
        return [flag(name), json.dumps(value)]
    return [flag(name), "none" if value is None else str(value)]
