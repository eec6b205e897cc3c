"""The places at which the runs of a set are trained: processes of this machine, one for each run.

Each process resumes one run directory, whether its run has begun or not, and ends with the process that started it.
The tasks of a cluster are places too: see `lemniscate.cluster.tasks`.
"""

import os
import signal
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lemniscate.system.files import open_log, open_regular
from lemniscate.system.watchdog import OWNED

LOG = "log.txt"
"""standard output and error of a run, in its directory"""


def at_once(threads: int) -> int:
    """The number of runs, each of so many threads, that fit on the cores that this process may use; at least one."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // threads)


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

    @abstractmethod
    def ended(self) -> dict[Path, int]:
        """The exit codes of the runs that have ended since the last look."""

    @abstractmethod
    def stop(self, runs: Sequence[Path] | None = None) -> None:
        """Ask these runs, or all, to save and stop; asked twice, they do not wait for the end of their update."""

    @abstractmethod
    def close(self) -> None:
        """Stop all runs, and wait for them."""


class Processes(Places):
    """Processes of this machine, as many at a time as have cores.

    Args:
        threads: of each run.
    """

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

    def ended(self) -> dict[Path, int]:
        """The exit codes of the processes that have ended since the last look."""
        codes = {run: code for run, process in self._running.items() if (code := process.poll()) is not None}
        for run in codes:
            _close_input(self._running.pop(run))
        return codes

    def stop(self, runs: Sequence[Path] | None = None) -> None:
        """Ask these processes, or all, to save and stop; asked twice, they do not wait for the end of their update."""
        for run, process in self._running.items():
            if runs is None or run in runs:
                process.terminate()

    def close(self) -> None:
        """Stop all, and wait for them."""
        self.stop()
        for process in self._running.values():
            process.wait()
            _close_input(process)


def _close_input(process: subprocess.Popen) -> None:
    if process.stdin:
        process.stdin.close()


def failure_of(run: Path, code: int) -> str:
    """The signal that ended a process, or else the last line that it wrote."""
    if code < 0 or code in (129, 130, 143):
        why = ", as the system does where memory has run out" if code == -signal.SIGKILL else ""
        return f"{signal.strsignal(-code if code < 0 else code - 128)}{why}."
    with open_regular(run / LOG) as log:
        written = log.read().decode(errors="replace").split("\n")
    return next((line for line in reversed(written) if line.strip()), f"Exit code {code}.")
