"""The verb that continues a run."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lemniscate import algos
from lemniscate.api.callbacks import Callback, find_callbacks
from lemniscate.api.launch import launch_run, train_there
from lemniscate.api.policy import TrainedPolicy
from lemniscate.api.results import report_on
from lemniscate.api.stored import TrainedRun, load, own_code_of, path_of
from lemniscate.api.training import loggers_with, name_in_config, together, train_here
from lemniscate.cluster.connection import find_cluster
from lemniscate.hub.trust import is_signed, require_trusted
from lemniscate.run.directory import is_finished, read_record
from lemniscate.run.loggers import LoggerClass
from lemniscate.system.console import say
from lemniscate.system.files import parsing


def resume(
    run: str | Path | TrainedRun | TrainedPolicy,
    *,
    env: str | Callable[..., Any] | None = None,
    wrappers: Sequence[str | Callable[..., Any]] | None = None,
    network: str | Callable[..., Any] | None = None,
    track: str | LoggerClass | None = None,
    callbacks: Callback | str | Sequence[Callback | str] = (),
    report: bool = False,
    progress: bool = True,
    processes: int = 1,
    cluster: str | None = None,
    workers: int | None = None,
    storage: str | None = None,
    trust: bool = False,
) -> TrainedRun:
    """Resume an interrupted run from its newest whole planned checkpoint, and train it to its end.

    A run that is finished stays as it is; with `report` it is evaluated and drawn again.

    Args:
        run: its directory, or what `train` returned.
        env: only of a run that began with an object that no file holds, such as a lambda: the same object again.
        wrappers: the same.
        network: the same.
        track: as in `train`, and the following; none of them is saved with the run.
        callbacks: functions that see each logged line.
        report: evaluate the final policy, and draw it.
        progress: the live line on standard error.
        processes: of this machine; any number that divides the run's `shards`, whatever it began with.
        cluster: as in `train`: go on there, from what its storage has, or else this directory.
        workers: as many as divide the run's `shards`; others stand by.
        storage: the same as when the run began there.
        trust: import the code that the run names as `module:name` also if the run is not of this user and machine.

    Raises:
        UserError: no run directory, or one that another process trains in or another version wrote; an object that no
            file holds and that was not passed again; a tracker or a callback that is not there.
        NonFiniteError: an observation, a reward or a loss is NaN or infinite; the last checkpoint is as it was.
        WorkerError: the process of an environment died.
        Stopped: Ctrl-C or SIGTERM, when the run has saved itself.
    """
    path = path_of(run)
    again = {"env": env, "wrappers": wrappers, "network": network}
    given = {name: name_in_config(value) for name, value in again.items() if value is not None}
    there = find_cluster(cluster, workers, storage)
    with together() as world:
        record = world.from_first(read_record(path) if world.is_first else {})
        with parsing(path):
            algorithm, fields = record["algorithm"], record["config"]
            code = own_code_of({"algorithm": algorithm, "config": {**fields, **given}})
            require_trusted(path, code, trusted=trust or world.from_first(is_signed(record)))
        config = algos.find(algorithm).Config.from_json(fields).replace(**given)
        world.divide(config.shards)
        loggers, functions = loggers_with(track), find_callbacks(callbacks) if callbacks else []
        if world.from_first(world.is_first and is_finished(path)):
            return _finished(path, report and world.is_first, progress and world.is_first, trust)
        if there is not None:
            return train_there(path, algorithm, config, there, track, callbacks, report, progress)
        if processes > 1 and world.size == 1:
            launched = launch_run(path, algorithm, config, processes, track, callbacks, report, progress)
            return TrainedRun(path, load(path, trust=True), launched)
        return train_here(world, path, algorithm, config, loggers, functions, report or track is not None, progress)


def _finished(path: Path, report: bool, progress: bool, trust: bool) -> TrainedRun:
    """A run that has taken all its steps, as it is; with `report` it is evaluated and drawn again."""
    run = TrainedRun(path, load(path, trust=trust), 0.0)
    if progress:
        say(f"{path} is finished, at step {run.policy.step:,}: there is nothing to resume.")
    if report:
        report_on(run)
    return run
