"""How a run is trained besides its Config: loggers, callbacks, and the processes that share the work."""

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from lemniscate.api.policy import TrainedPolicy
from lemniscate.errors import RankError, UserError, is_installed, missing_extra, shown, unknown_name
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import CONFIG, create_directory
from lemniscate.run.loggers import TRACKERS, JsonLines, LoggerClass, TensorBoard
from lemniscate.run.run import Observer
from lemniscate.run.state import TrainState
from lemniscate.run.stopping import Stopped
from lemniscate.spec import Spec
from lemniscate.system import named
from lemniscate.system.machine import require_linux
from lemniscate.system.watchdog import OWNED
from lemniscate.system.world import World

Callback = Callable[[int, Mapping[str, float], TrainedPolicy], object]
"""(step, metrics, policy) of a logged line; a true result stops the run"""


class StopAt:
    """Stops a run at its first logged line at or after so many steps; `resume` goes on with it.

    Args:
        steps: if they are planned checkpoints, nothing is computed again when the run goes on.
    """

    def __init__(self, steps: int) -> None:
        self.steps = steps

    def __call__(self, step: int, _metrics: Mapping[str, float], _policy: TrainedPolicy) -> bool:
        """Whether the run has come so far."""
        return step >= self.steps


class PolicySnapshot(TrainedPolicy):
    """The policy of a run at the line that a callback is shown. Its weights are copied when it is first used.

    A callback may keep a policy that it has used. One that it has not used raises `UserError` later.
    """

    def __init__(self, copy_networks: Callable[[], Any], spec: Spec, config: RunConfig, step: int) -> None:
        self.spec, self.config, self.step = spec, config, step
        self._copy_networks = copy_networks

    @cached_property
    def networks(self) -> Any:
        """The copy."""
        return self._copy_networks().eval()

    def __getstate__(self) -> dict[str, Any]:  # of a copy: a function of this process cannot be pickled
        return {**vars(self), "networks": self.networks, "_copy_networks": _too_late}

    def expire(self) -> None:
        """Refuse to copy the weights from now on: the run goes on to change them."""
        self._copy_networks = _too_late


def call_callbacks(
    functions: Sequence[Callback],
    copy_networks: Callable[[TrainState], Any],
    spec: Spec,
    config: RunConfig,
    attend: Callable[[int, Mapping[str, float]], None] | None,
) -> Observer:
    """The function that a run calls after each logged line: every callback in turn, each with a policy of its own.

    Args:
        functions: the callbacks.
        copy_networks: networks on the CPU that share nothing with those of the state.
        spec: of the policy.
        config: of the run.
        attend: called before them with the step and the metrics of each line that has signals.
    """

    def observe(lines: Sequence[tuple[int, Mapping[str, float]]], state: TrainState) -> bool:
        stop = False
        for step, metrics in lines:
            if attend and "reward/largest" in metrics:
                attend(step, metrics)
        for (step, metrics), function in product(lines, functions):
            policy = PolicySnapshot(lambda: copy_networks(state), spec, config, step)
            said = function(step, MappingProxyType(dict(metrics)), policy)
            if not isinstance(said, bool | np.bool_ | None):
                raise UserError(
                    f"A callback returns True to stop, or False or None; {function} returned {shown(said)}."
                )
            stop = bool(said) or stop
            policy.expire()
        return stop

    return observe


def _too_late() -> Any:
    raise UserError("This policy was not used while its callback ran, and the run has changed since; use it there.")


if TYPE_CHECKING:
    from lemniscate.cluster.connection import Cluster

SECONDS_TO_END = 10
"""that the processes have to end by themselves, once one has ended or the launcher was asked to stop"""


@dataclass(frozen=True)
class RunOptions:
    """The arguments of `train` and `resume` that are not saved with the run, which describes them; made at the door."""

    track: str | LoggerClass | None = None
    callbacks: Callback | str | Sequence[Callback | str] = ()
    report: bool = False
    progress: bool = True
    processes: int = 1
    cluster: str | None = None
    workers: int | None = None
    storage: str | None = None

    def find_cluster(self) -> "Cluster | None":
        """The cluster that is named, if one is. Raises `UserError` where there is none, or no Ray."""
        if self.cluster is None and self.workers is None and self.storage is None:
            return None
        from lemniscate.cluster.connection import find_cluster

        return find_cluster(self.cluster, self.workers, self.storage)

    @property
    def reports(self) -> bool:
        """Whether the final policy is evaluated and drawn: a tracker gets the pictures."""
        return self.report or self.track is not None

    def loggers(self) -> tuple[LoggerClass, ...]:
        """The local loggers, and the tracker. Raises `UserError` if it does not exist or is not installed."""
        track = self.track
        if track is None:
            return JsonLines, TensorBoard
        if isinstance(track, str) and ":" not in track:
            if track not in TRACKERS:
                raise unknown_name("tracker", track, TRACKERS)
            extra, track = TRACKERS[track]
            if not is_installed(extra):
                raise missing_extra(extra, extra)
        if not (isinstance(track, str) or callable(track)):
            raise UserError(f"track must be a logger's name or class, not {shown(track)}.")
        return JsonLines, TensorBoard, named.find(track) if isinstance(track, str) else track

    def functions(self) -> list[Callback]:
        """The callbacks themselves. Raises `UserError` for one that cannot be found or called."""
        functions = [_by_name(one) if isinstance(one, str) else one for one in self._several()]
        for function in functions:
            if not named.takes(function, 3):
                raise UserError(f"A callback must be a function of (step, metrics, policy), not {shown(function)}.")
        return functions

    def names(self) -> list[str]:
        """The names of the callbacks. Raises `UserError` where another process could not import one, or the tracker."""
        names = list(self._several())
        _require_importable(self.track or "", *names)
        return names

    def words(self) -> list[str]:
        """The options of `lemniscate resume` that say the same to another process. Raises as `names`."""
        names = self.names()
        words = [*(["--track", str(self.track)] if self.track else []), *(["--callbacks", *names] if names else [])]
        return words + ["--report"] * self.report + ["--quiet"] * (not self.progress)

    def _several(self) -> Sequence[Any]:
        if isinstance(self.callbacks, list | tuple):
            return self.callbacks
        return [self.callbacks] if self.callbacks else []


def require_importable(config: RunConfig) -> None:
    """Raise `UserError` for an object that a Config names and that another process could not import."""
    _require_importable(config.env, *config.wrappers, getattr(config, "network", ""), config.curriculum or "")


def _require_importable(*names: Any) -> None:
    for name in names:
        if not isinstance(name, str) or "<" in name or name.startswith("__main__:"):
            raise UserError(f"Each process has to import it: put {shown(name)} into a module, and name it.")


def _by_name(name: str) -> Any:
    """The function `module:function`, or an object of `module:Class(key=value, …)`. Raises `UserError`."""
    found = named.find_callable(name)
    made = found.func if isinstance(found, partial) else found
    if not isinstance(made, type):
        return found
    try:
        return found()
    except TypeError as error:
        raise UserError(f"{name} cannot be made; give its arguments as module:Class(key=value, …): {error}.") from error


def train_in_processes(path: Path, algorithm: str, config: RunConfig, options: RunOptions) -> None:
    """Train in several processes of this machine: each resumes the run, which begins here if it is new.

    A new run has a shard for each process, unless its Config has more. Raises as `launch`.
    """
    require_linux("Training in several processes", "one process, with --threads")
    if (path / CONFIG).exists() or config.shards > 1:
        World(config.shards, size=options.processes).divide(config.shards)
    words = options.words()
    if not (path / CONFIG).exists():
        config = config.replace(shards=max(config.shards, options.processes))
        create_directory(path, CONFIG, {"algorithm": algorithm, "config": config.to_json()})
    launch(["resume", str(path), *words], options.processes)


def launch(words: Sequence[str], processes: int) -> None:
    """Run `lemniscate WORDS` in so many processes, and wait for all of them; they say themselves what there is to say.

    Raises:
        Stopped: they were asked to stop, and have saved the run.
        RankError: one of them failed; empty unless all were killed.
    """
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    logging.disable(logging.ERROR)
    config = LaunchConfig(
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
    os.environ[OWNED] = f"/proc/{os.getpid()}/fd/{reading}"
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    try:
        elastic_launch(config, sys.executable)("-m", "lemniscate", *words)
    except SignalException as stopped:
        raise Stopped("", stopped.sigval) from None
    except ChildFailedError as failed:
        codes = {rank: failure.exitcode for rank, failure in failed.failures.items()}
        for signum in (signal.SIGINT, signal.SIGTERM):
            if 128 + signum in codes.values():
                raise Stopped("", signum) from None
        killed = len(codes) == processes and all(code == -signal.SIGKILL for code in codes.values())
        raise RankError("All processes of the run were killed." if killed else "") from None
    finally:
        logging.disable(logging.NOTSET)
        del os.environ[OWNED]
        os.close(writing)
        os.close(reading)
