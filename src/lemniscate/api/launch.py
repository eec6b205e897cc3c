"""One run in several processes: those of this machine, started by torch's elastic launcher, or those of a cluster."""

import logging
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lemniscate.api.results import report_on
from lemniscate.api.stored import TrainedRun, load
from lemniscate.cluster.connection import Cluster
from lemniscate.errors import RankError, UserError, shown
from lemniscate.hub.trust import signed
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import CONFIG, create_directory
from lemniscate.run.stopping import Stopped
from lemniscate.system.watchdog import OWNED
from lemniscate.system.world import World

SECONDS_TO_END = 10
"""that the processes have to end by themselves, once one has ended or the launcher was asked to stop"""


def launch_run(
    path: Path,
    algorithm: str,
    config: RunConfig,
    processes: int,
    track: object,
    callbacks: Any,
    report: bool,
    progress: bool,
) -> float:
    """Train in several processes of this machine: each resumes the run, which begins here if it is new.

    Returns the seconds that it took. Raises as `launch`, and `UserError` for what another process could not import.
    """
    if (path / CONFIG).exists() or config.shards > 1:
        World(config.shards, size=processes).divide(config.shards)
    names = require_importable(config, track, callbacks)
    _begin(path, algorithm, config, processes)
    options = [*(["--track", str(track)] if track else []), *(["--callbacks", *names] if names else [])]
    options += ["--report"] * report + ["--trust"] + ["--quiet"] * (not progress)
    began = time.monotonic()
    launch(["resume", str(path), *options], processes)
    return time.monotonic() - began


def train_there(
    path: Path,
    algorithm: str,
    config: RunConfig,
    cluster: Cluster,
    track: object,
    callbacks: Any,
    report: bool,
    progress: bool,
) -> TrainedRun:
    """Train on a cluster, or go on there; the run is evaluated and drawn here. Raises as `launch_run`."""
    from lemniscate.cluster.connection import connected
    from lemniscate.cluster.job import train_on_ray

    options = {"track": track, "callbacks": require_importable(config, track, callbacks), "progress": progress}
    options["trust"] = True  # its code was named here, or vouched for
    began = time.monotonic()
    with connected(cluster):  # before the directory is made: a cluster that does not answer leaves nothing
        workers = cluster.workers or 1
        config = _begin(path, algorithm, config, workers)
        train_on_ray(path, algorithm, config, workers, cluster.storage, "lemniscate.api.resumed:resume", options)
    seconds = time.monotonic() - began
    trained = TrainedRun(path, load(path, trust=True), seconds)
    if report or track is not None:
        report_on(trained)
    return trained


def _begin(path: Path, algorithm: str, config: RunConfig, processes: int) -> RunConfig:
    """Create the directory of a new run, with a shard for each process; returns the Config of the run."""
    if not (path / CONFIG).exists():
        config = config.replace(shards=max(config.shards, processes))
        create_directory(path, CONFIG, signed({"algorithm": algorithm, "config": config.to_json()}))
    return config


def require_importable(config: RunConfig, track: object, callbacks: Any) -> list[str]:
    """The names of the callbacks. Raises `UserError` for what another process could not import."""
    names = list(callbacks) if isinstance(callbacks, list | tuple) else [callbacks] if callbacks else []
    for name in (config.env, *config.wrappers, getattr(config, "network", ""), track or "", *names):
        if not isinstance(name, str) or "<" in name or name.startswith("__main__:"):
            raise UserError(f"Each process has to import it: put {shown(name)} into a module, and name it.")
    return names


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
