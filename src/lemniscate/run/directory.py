"""The run directory: how it begins, what it says of itself, and the checkpoint to go on from."""

import json
import sys
from pathlib import Path
from typing import Any

from lemniscate.errors import UserError
from lemniscate.run import checkpoint

UNFINISHED = "config.json.tmp"
SET = "sweep.json"
"""what a set of runs has in the place of a `config.json`"""


def require_absent(path: Path) -> None:
    """Raise `UserError` if a run directory exists already, but for the beginning of one that could not be written."""
    if path.exists() and (not path.is_dir() or set(path.iterdir()) - {path / UNFINISHED}):
        raise UserError(f"{path} exists already; go on with it (lemniscate resume {path}) or choose another --run.")


def create_directory(path: Path, name: str, record: dict[str, Any]) -> None:
    """Make a directory with the one file that says what it is. Raises `UserError` if there is something already."""
    require_absent(path)
    temporary = path / UNFINISHED
    try:
        path.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(record, indent=1) + "\n")
        temporary.replace(path / name)
    except OSError as error:
        raise UserError(f"{path} cannot be made: {error.strerror}.") from error


def read_config(path: Path) -> tuple[str, dict[str, Any]]:
    """The algorithm's name and its config, from a run directory. Raises `UserError` if it is none."""
    if (path / SET).exists():
        runs = sorted(file.parent for file in path.glob("*/config.json"))
        raise UserError(f"{path} is a set of runs: name one of them, such as {runs[0] if runs else path / '…'}.")
    try:
        record = json.loads((path / "config.json").read_text())
        return record["algorithm"], record["config"]
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path} is not a run directory: it holds no config.json that can be read.") from None


def is_finished(path: Path) -> bool:
    """Whether a run has taken all its steps, and the checkpoint of its end is there and whole."""
    _, config = read_config(path)
    steps = checkpoint.list_steps(path / "checkpoints")
    return steps[-1:] >= [config["total_steps"]] and checkpoint.is_whole(path / "checkpoints" / f"step-{steps[-1]}")


def newest_resumable(path: Path) -> checkpoint.Checkpoint | None:
    """The newest planned checkpoint of a run that is whole; damaged ones are named on standard error."""
    return _newest(path, planned_only=True)


def newest(path: Path) -> checkpoint.Checkpoint | None:
    """The newest whole checkpoint of a run, a stopped run's last one included."""
    return _newest(path, planned_only=False)


def _newest(path: Path, planned_only: bool) -> checkpoint.Checkpoint | None:
    for step in reversed(checkpoint.list_steps(path / "checkpoints")):
        try:
            found = checkpoint.read(path / "checkpoints" / f"step-{step}")
        except checkpoint.DamagedCheckpointError as error:
            print(f"{error} Taking the one before.", file=sys.stderr)
            continue
        if found.record["planned"] or not planned_only:
            return found
    return None
