"""The places of a set of runs: the directory of a sweep, and the processes of this machine that train its runs.

    sweep.json        of a sweep: the seeds, and the Config of each algorithm
    ppo-1/, sac-1/…   its runs; one that has not begun has only a `config.json`, and is resumed from step 0

Each process resumes one run directory, whether its run has begun or not, and ends with the process that started it.
The tasks of a cluster are places too: see `lemniscate.cluster.tasks`.
"""

import os
import re
import signal
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lemniscate.envs.registry import file_name
from lemniscate.errors import UserError
from lemniscate.run.directory import CONFIG, SWEEP, create_directory, read_record
from lemniscate.system.files import (
    DamagedFileError,
    is_whole,
    open_log,
    open_regular,
    parsing,
    read_json,
    write_json,
)
from lemniscate.system.machine import cores
from lemniscate.system.watchdog import OWNED

LOG = "log.txt"
"""standard output and error of a run, in its directory"""


@dataclass(frozen=True)
class Sweep:
    """A sweep of several algorithms times several seeds; the Config of each algorithm is without its seed."""

    path: Path
    seeds: list[int]
    configs: dict[str, dict[str, Any]]

    @property
    def runs(self) -> dict[Path, dict[str, Any]]:
        """The run directories and the content of their `config.json`, ordered by seed, then by algorithm."""
        return {
            self.path / file_name(f"{algorithm}-{seed}"): {"algorithm": algorithm, "config": {**config, "seed": seed}}
            for seed in self.seeds
            for algorithm, config in self.configs.items()
        }

    def create(self) -> None:
        """Write `sweep.json` into a new directory. Raises `UserError` if the directory exists already."""
        create_directory(self.path, SWEEP, {"seeds": self.seeds, "configs": self.configs})

    def create_runs(self) -> None:
        """Create the run directories that do not exist yet, and a `config.json` that is lost or damaged."""
        for path, record in self.runs.items():
            if not path.is_dir():
                create_directory(path, CONFIG, record)
            elif not is_whole(path / CONFIG):
                with suppress(UserError):  # of its newest checkpoint, in which the run may have been extended
                    record = read_record(path)
                write_json(path / CONFIG, record)


def is_sweep(path: Path) -> bool:
    """Whether a directory is that of a sweep."""
    return (path / SWEEP).exists()


def read_sweep(path: Path) -> Sweep:
    """The sweep in a directory. Raises `UserError` if there is none."""
    try:
        record = read_json(path / SWEEP)
    except DamagedFileError as error:
        reason = f": {error}" if (path / SWEEP).exists() else f": it holds no {SWEEP} that can be read."
        raise UserError(f"{path} is not a sweep{reason}") from None
    with parsing(path / SWEEP):
        sweep = Sweep(path, [int(seed) for seed in record["seeds"]], dict(record["configs"]))
        if unsafe := [name for name in sweep.configs if not re.fullmatch(r"[\w.:-]*\w", name) or ".." in name]:
            raise ValueError(f"{unsafe[0]!r} is no name of an algorithm")
        return sweep


def at_once(threads: int) -> int:
    """The number of runs, each of so many threads, that fit on the cores that this process may use; at least one."""
    return max(1, cores() // threads)


class Places(ABC):
    """Places at which runs are trained, `count` at a time."""

    def __init__(self) -> None:
        self._running: dict[Path, Any] = {}
        """what trains each of the runs"""

    @property
    @abstractmethod
    def count(self) -> int:
        """The number of runs at a time."""

    @property
    def running(self) -> list[Path]:
        """The runs that are being trained."""
        return list(self._running)

    @property
    def free(self) -> bool:
        """Whether another run fits."""
        return len(self._running) < self.count

    @abstractmethod
    def start(self, run: Path, options: Sequence[str]) -> None:
        """Begin to train a run: `lemniscate resume` with these options."""

    def ended(self) -> dict[Path, int]:
        """The exit codes of the runs that have ended since the last look."""
        codes = {run: code for run in list(self._running) if (code := self._code_of(run)) is not None}
        for run in codes:
            self._release(self._running.pop(run))
        return codes

    def stop(self, runs: Sequence[Path] | None = None) -> None:
        """Ask these runs, or all, to save and stop; asked twice, they do not wait for the end of their update."""
        for run, trainer in self._running.items():
            if runs is None or run in runs:
                self._ask_to_stop(trainer)

    def close(self) -> None:
        """Stop all runs, and wait for them."""
        self.stop()
        while self._running:
            self.ended()
            time.sleep(0.1)

    @abstractmethod
    def _code_of(self, run: Path) -> int | None:
        """The exit code of a run; None if it goes on."""

    @abstractmethod
    def _ask_to_stop(self, trainer: Any) -> None: ...

    @abstractmethod
    def _release(self, trainer: Any) -> None: ...


class Processes(Places):
    """Processes of this machine, each of so many threads, as many at a time as have cores."""

    def __init__(self, threads: int) -> None:
        super().__init__()
        self._threads = threads

    @property
    def count(self) -> int:
        """The number of runs that the cores of this machine serve."""
        return at_once(self._threads)

    def start(self, run: Path, options: Sequence[str]) -> None:
        """Start a process in a session of its own, so that Ctrl-C at the terminal reaches only this process.

        Each run then gets the signal from here, once. Its standard input is a pipe that closes when this process ends,
        however it ends; then the run ends, too.
        """
        command = [sys.executable, "-m", "lemniscate", "resume", str(run), *options]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), OWNED: "/dev/stdin"}
        with open_log(run / LOG) as log:
            self._running[run] = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
            )

    def _code_of(self, run: Path) -> int | None:
        return self._running[run].poll()

    def _ask_to_stop(self, trainer: subprocess.Popen) -> None:
        trainer.terminate()

    def _release(self, trainer: subprocess.Popen) -> None:
        if trainer.stdin:
            trainer.stdin.close()


def failure_of(run: Path, code: int) -> str:
    """The signal that ended a process, or else the last line that it wrote."""
    if code < 0 or code in (129, 130, 143):
        why = ", as the system does where memory has run out" if code == -9 else ""
        return f"{signal.strsignal(-code if code < 0 else code - 128)}{why}."
    with open_regular(run / LOG) as log:
        written = log.read().decode(errors="replace").split("\n")
    return next((line for line in reversed(written) if line.strip()), f"Exit code {code}.")
