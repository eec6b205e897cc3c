"""The run directory: its creation, its config, its lock, and the checkpoints in it."""

import json
import shutil
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from lemniscate.console import say
from lemniscate.errors import UserError, resume_line
from lemniscate.run import checkpoint
from lemniscate.run.config import RunConfig
from lemniscate.run.state import TrainState
from lemniscate.spec import Spec

UNFINISHED = "config.json.tmp"
SWEEP = "sweep.json"
"""the file that the directory of a sweep has in the place of a `config.json`"""


def require_absent(path: Path) -> None:
    """Raise `UserError` if a run directory exists already; one whose creation failed half-way does not count."""
    if path.exists() and (not path.is_dir() or set(path.iterdir()) - {path / UNFINISHED}):
        raise UserError(f"{path} exists already; go on with it ({resume_line(path)}) or choose another --run.")


def create_directory(path: Path, name: str, record: dict[str, Any]) -> None:
    """Create a directory with the one file `name` that says what it is. Raises `UserError` if it exists already."""
    require_absent(path)
    temporary = path / UNFINISHED
    try:
        path.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(record, indent=1) + "\n")
        temporary.replace(path / name)
    except OSError as error:
        raise UserError(f"{path} cannot be created: {error.strerror}.") from error


def read_config(path: Path) -> tuple[str, dict[str, Any]]:
    """The algorithm's name and the config of a run directory. Raises `UserError` if it is not one."""
    if (path / SWEEP).exists():
        runs = sorted(file.parent for file in path.glob("*/config.json"))
        raise UserError(f"{path} is a sweep: name one of its runs, such as {runs[0] if runs else path / '…'}.")
    try:
        record = json.loads((path / "config.json").read_text())
        return record["algorithm"], dict(record["config"])
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path} is not a run directory: it holds no config.json that can be read.") from None


def is_finished(path: Path) -> bool:
    """Whether a run has taken all its steps, and its last checkpoint is whole."""
    _, config = read_config(path)
    steps = checkpoint.list_steps(path / "checkpoints")
    return steps[-1:] >= [config["total_steps"]] and checkpoint.is_whole(path / "checkpoints" / f"step-{steps[-1]}")


def find_checkpoint(path: Path) -> checkpoint.Checkpoint:
    """A checkpoint, named by its own directory or by that of its run, of which it is the newest whole one.

    Raises:
        UserError: neither a run nor a checkpoint; a run without a whole checkpoint; a damaged checkpoint.
    """
    if (path / "manifest.json").exists():
        return checkpoint.read(path)
    read_config(path)
    found = _newest(path, planned_only=False)
    if found is None:
        raise UserError(f"{path} has no checkpoint that can be read yet.")
    return found


def _newest(path: Path, planned_only: bool) -> checkpoint.Checkpoint | None:
    for step in reversed(checkpoint.list_steps(path / "checkpoints")):
        try:
            found = checkpoint.read(path / "checkpoints" / f"step-{step}")
        except checkpoint.DamagedCheckpointError as error:
            say(f"{error} Taking the one before.")
            continue
        if found.record["planned"] or not planned_only:
            return found
    return None


class Saver:
    """Saves the state of a run into its directory, and restores it from there. One process at a time may do so."""

    def __init__(self, path: Path, algorithm: str, config: RunConfig, spec: Spec) -> None:
        self.path = path
        self.exists = (path / "config.json").exists()
        """whether the run directory was there before this process"""
        self._config, self._checkpoints = config, path / "checkpoints"
        self._identity = {"algorithm": algorithm, "config": config.to_json()}
        self._record = {**self._identity, "spec": checkpoint.spec_to_json(spec)}
        self._lock = FileLock(path / ".lock", timeout=0)
        self.last_planned = 0
        """the step that `resume` would go on from"""

    def open(self) -> None:
        """Create the directory if it is new, and lock it. Raises `UserError` if another process trains in it."""
        if not self.exists:
            create_directory(self.path, "config.json", self._identity)
        try:
            self._lock.acquire()
        except Timeout:
            raise UserError(f"{self.path} is being trained by another process.") from None

    def restore(self, state: TrainState) -> bool:
        """Restore the newest whole planned checkpoint, if there is one, and delete those after it.

        Checkpoints beyond the one restored are damaged or unplanned; the run will write them again.
        """
        found = _newest(self.path, planned_only=True)
        steps = checkpoint.list_steps(self._checkpoints)
        if found:
            found.restore(state)
            self.last_planned = state.step
        elif steps:
            say(f"{self.path} has no planned checkpoint to go on from; it begins again at step 0.")
        for step in steps:
            if step > state.step:
                shutil.rmtree(self._checkpoints / f"step-{step}")
        return found is not None

    def save(self, state: TrainState, planned: bool) -> None:
        """Write a checkpoint. A full disk costs this checkpoint; neither the run nor the checkpoints before it."""
        # An unplanned checkpoint is kept beside the planned ones, never in the place of one.
        keep = self._config.keep_checkpoints + (not planned)
        try:
            checkpoint.write(self._checkpoints, state, state.step, {**self._record, "planned": planned}, keep)
            self.last_planned = state.step if planned else self.last_planned
        except OSError as error:
            say(f"The checkpoint at step {state.step:,} could not be written: {error}.")

    def close(self) -> None:
        """Unlock the directory."""
        self._lock.release()
