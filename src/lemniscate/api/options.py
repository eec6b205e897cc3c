"""How a run is trained besides its Config: loggers, callbacks by name, and the processes that share the work."""

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from lemniscate.api.callbacks import Callback
from lemniscate.errors import RankError, UserError, is_installed, missing_extra, shown, unknown_name
from lemniscate.run.config import Count, RunConfig, checked
from lemniscate.run.directory import CONFIG, create_directory
from lemniscate.run.loggers import TRACKERS, JsonLines, LoggerClass, TensorBoard, require_logger
from lemniscate.run.stopping import Stopped
from lemniscate.system import named
from lemniscate.system.machine import require_linux
from lemniscate.system.watchdog import OWNED
from lemniscate.system.world import World

SECONDS_TO_END = 10
"""that the processes have to end by themselves, once one has ended or the launcher was asked to stop"""

CAUGHT = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name)]
"""the signals that torch's launcher catches"""


class RunOptions:
    """The arguments of `train` and `resume` that are not saved with the run; both make these first, which checks them.

    Raises `UserError` for a tracker, a callback or a cluster that is not there, or what is none.
    """

    def __init__(
        self,
        track: str | LoggerClass | None = None,
        callbacks: Callback | str | Sequence[Callback | str] = (),
        report: bool = False,
        progress: bool = True,
        processes: int = 1,
        cluster: str | None = None,
        workers: int | None = None,
        storage: str | None = None,
    ) -> None:
        self.track, self.processes = track, checked("processes", processes, Count)
        self.report, self.progress = checked("report", report, bool), checked("progress", progress, bool)
        self.cluster: Any = None
        if not (cluster is workers is storage is None):
            from lemniscate.cluster.connection import find_cluster

            self.cluster = find_cluster(cluster, workers, storage)
        self.loggers = (JsonLines, TensorBoard, *([] if track is None else [_tracker(track)]))
        several: Any = callbacks if isinstance(callbacks, list | tuple) else [callbacks] if callbacks else []
        several = [callbacks] if callable(callbacks) else several  # also one that is a list, or is empty
        self._names = list(several)
        self.callbacks: list[Callback] = [_by_name(one) if isinstance(one, str) else one for one in several]
        for function in self.callbacks:
            if not named.takes(function, 3):
                raise UserError(f"A callback must be a function of (step, metrics, policy), not {shown(function)}.")

    @property
    def reports(self) -> bool:
        """Whether the final policy is evaluated and drawn: a tracker gets the pictures."""
        return self.report or self.track is not None

    def shared(self) -> dict[str, Any]:
        """The arguments for other processes. Raises `UserError` where a callback or the tracker cannot be imported."""
        require_importable(self.track or "", *self._names)
        return {"track": self.track, "callbacks": self._names, "progress": self.progress}

    def words(self) -> list[str]:
        """The options of `lemniscate resume` that say the same to another process. Raises as `shared`."""
        self.shared()
        words = ["--track", str(self.track)] * bool(self.track) + ["--report"] * self.report
        return words + ["--quiet"] * (not self.progress) + (["--callbacks", *self._names] if self._names else [])


def own_names(config: RunConfig) -> list[Any]:
    """The values of a Config that may name an object of the user's."""
    own = config.env, config.backend or "", getattr(config, "network", ""), config.curriculum or ""
    return [*own, *config.wrappers]


def require_importable(*names: Any) -> None:
    """Raise `UserError` for the name of an object that another process could not import."""
    for name in names:
        if not isinstance(name, str) or "<" in name or name.startswith("__main__:"):
            raise UserError(f"Each process has to import it: put {shown(name)} into a module, and name it.")


def _tracker(track: str | LoggerClass) -> LoggerClass:
    """The class of a tracker. Raises `UserError` if it does not exist or is not installed."""
    if isinstance(track, str) and ":" not in track:
        if track not in TRACKERS:
            raise unknown_name("tracker", track, TRACKERS)
        extra, track = TRACKERS[track]
        if not is_installed(extra):
            raise missing_extra(extra, extra)
    if not (isinstance(track, str) or callable(track)):
        raise UserError(f"track must be a logger's name or class, not {shown(track)}.")
    found = named.find(track) if isinstance(track, str) else track
    if not named.takes(found, 3):
        raise UserError(f"track must be made as Class(path, config, step), which {shown(found)} cannot be.")
    return require_logger(found) if isinstance(found, type) else found


def _by_name(name: str) -> Any:
    """The function `module:function`, or an object of `module:Class(key=value, …)`. Raises `UserError`."""
    found = named.find_callable(name)
    if not isinstance(found.func if isinstance(found, partial) else found, type):
        return found
    try:
        return found()
    except TypeError as error:
        raise UserError(f"{name} cannot be made; give its arguments as module:Class(key=value, …): {error}.") from error


@contextmanager
def _undone() -> Iterator[None]:
    """Afterwards, signals, the environment's variables and logging are as before, which torch's launcher changes."""
    handlers = [(signum, signal.getsignal(signum)) for signum in CAUGHT]
    variables, disabled = dict(os.environ), logging.root.manager.disable
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for signum, handler in handlers:
                if handler is not None:  # one that is not Python's
                    signal.signal(signum, handler)
        for name in os.environ.keys() - variables.keys():
            del os.environ[name]
        os.environ.update(variables)
        logging.disable(disabled)


def train_in_processes(path: Path, algorithm: str, config: RunConfig, options: RunOptions) -> None:
    """Train in several processes of this machine, and wait: each resumes the run, which begins here if it is new.

    A new run has a shard for each process, unless its Config has more. They say themselves what there is to say.

    Raises:
        Stopped: they were asked to stop, and have saved the run.
        RankError: one of them failed; empty unless all were killed.
    """
    require_linux("Training in several processes", "one process, with --threads")
    processes, words = options.processes, ["resume", str(path), *options.words()]
    if (path / CONFIG).exists() or config.shards > 1:
        World(config.shards, size=processes)  # refuses a number that does not divide them
    if not (path / CONFIG).exists():
        config = config.replace(shards=max(config.shards, processes))
        create_directory(path, CONFIG, {"algorithm": algorithm, "config": config.to_json()})
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    launched = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=processes,
        run_id=f"lemniscate-{os.getpid()}-{time.time_ns()}",
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        local_addr="localhost",
        max_restarts=0,
        shutdown_timeout=SECONDS_TO_END,
    )
    reading, writing = os.pipe()  # closed when this process ends, however it ends; then they end, too
    try:
        with _undone():
            logging.disable(logging.ERROR)
            os.environ[OWNED] = f"/proc/{os.getpid()}/fd/{reading}"
            os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
            elastic_launch(launched, sys.executable)("-m", "lemniscate", *words)
    except SignalException as stopped:
        raise Stopped("", stopped.sigval) from None
    except ChildFailedError as failed:
        codes = {rank: failure.exitcode for rank, failure in failed.failures.items()}
        rank, first = failed.get_first_failure()
        stopped = [signum for signum in (signal.SIGINT, signal.SIGTERM) if 128 + signum in codes.values()]
        if first.exitcode == -signal.SIGKILL and stopped:  # the others were asked to stop for that
            why = "killed, as the system does where memory has run out"
            raise RankError(f"Process {rank} of the run was {why}.") from None
        if stopped:
            raise Stopped("", stopped[0]) from None
        killed = len(codes) == processes and all(code == -signal.SIGKILL for code in codes.values())
        raise RankError("All processes of the run were killed." if killed else "") from None
    finally:
        os.close(writing)
        os.close(reading)
