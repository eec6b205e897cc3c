"""The training of a set of runs, side by side: what a sweep and a search share."""

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from filelock import FileLock, Timeout

from lemniscate.cluster.connection import Cluster
from lemniscate.errors import UserError, resume_line
from lemniscate.run.directory import LOCK
from lemniscate.run.places import Places, Processes
from lemniscate.run.stopping import Stopped, stop_signals_to

POLL_SECONDS = 0.3
"""seconds between two looks at the processes"""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """The directory of a set, for this process alone. Raises `UserError` if another one trains its runs."""
    try:
        with FileLock(path / LOCK, timeout=0):
            yield
    except Timeout:
        raise UserError(f"{path} is being trained by another process.") from None


def places_on(cluster: Cluster | None, configs: Iterable[Mapping[str, Any]]) -> Places:
    """The places of a cluster, or of this machine, for runs of such Configs."""
    configs = list(configs)
    threads = max(config["threads"] for config in configs)
    if cluster is None:
        return Processes(threads)
    from lemniscate.cluster.tasks import RayTasks

    return RayTasks(cluster, threads, gpu=any(config["device"].startswith("cuda") for config in configs))


class SetOfRuns(ABC):
    """Runs that are trained at the places of a machine or of a cluster; asked to stop, all of them save themselves.

    Args:
        path: the directory of the set.
        configs: of its runs.
        cluster: where they are trained; None for this machine.
    """

    def __init__(self, path: Path, configs: Iterable[Mapping[str, Any]], cluster: Cluster | None) -> None:
        self.path = path
        self._places = places_on(cluster, configs)
        self._stop_signal, self._told = 0, False
        """the signal that asked to stop, if one has; whether this was said"""

    @abstractmethod
    def _begin_runs(self) -> bool:
        """Start runs while there is room; returns whether anything is left that has not ended or not begun."""

    @abstractmethod
    def _run_ended(self, run: Path, code: int) -> None:
        """Take note of the end of a run."""

    @abstractmethod
    def _is_finished(self) -> bool:
        """Whether nothing is left to be done."""

    @abstractmethod
    def _say(self, text: str) -> None:
        """Say a line, if progress is shown."""

    def _train_all(self) -> None:
        """Train the runs to their ends. Raises `Stopped` after a signal."""
        try:
            with stop_signals_to(self._stop):
                while (not self._stop_signal and self._begin_runs()) or self._places.running:
                    time.sleep(POLL_SECONDS)
                    self._look()
        finally:
            self._places.close()
        if self._stop_signal and not self._is_finished():
            again = resume_line(self.path)
            raise Stopped(f"Stopped; the runs that had begun are saved. Go on with: {again}", self._stop_signal)

    @property
    def _has_room(self) -> bool:
        """Whether another run may be started now."""
        return self._places.free and not self._stop_signal

    def _start(self, run: Path, options: Sequence[str]) -> None:
        self._places.start(run, options)
        if self._stop_signal:  # the signal came while the process was started, before it was among those to be stopped
            self._places.stop([run])

    def _look(self) -> None:
        """Take note of the runs that have ended since the last look."""
        if self._stop_signal and not self._told:  # said here: a handler may interrupt another line
            self._told = True
            self._say("Stopping: each run ends its update and saves itself.")
        for run, code in self._places.ended().items():
            self._run_ended(run, code)

    def _stop(self, signum: int = 0, _frame: FrameType | None = None) -> None:
        """Ask every process to save and stop; asked twice, it does not wait for the end of its update."""
        self._stop_signal = self._stop_signal or signum
        self._places.stop()
