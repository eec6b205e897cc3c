"""Several processes of one run on this machine, by torch's elastic launcher, as `torchrun` starts them."""

import logging
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from lemniscate.errors import RankError
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import CONFIG, create_directory
from lemniscate.run.stopping import Stopped
from lemniscate.system.watchdog import OWNED
from lemniscate.system.world import World

SECONDS_TO_END = 10
"""that the processes have to end by themselves, once one has ended or the launcher was asked to stop"""


def launch_run(path: Path, algorithm: str, config: RunConfig, processes: int, words: Sequence[str]) -> float:
    """Train in several processes of this machine: each resumes the run, which begins here if it is new.

    Args:
        path: the run directory.
        algorithm: by name.
        config: of the run; a new one has a shard for each process, unless more are asked for.
        processes: how many.
        words: options of `lemniscate resume`.

    Returns the seconds that it took. Raises as `launch`.
    """
    if (path / CONFIG).exists() or config.shards > 1:
        World(config.shards, size=processes).divide(config.shards)
    if not (path / CONFIG).exists():
        config = config.replace(shards=max(config.shards, processes))
        create_directory(path, CONFIG, {"algorithm": algorithm, "config": config.to_json()})
    began = time.monotonic()
    launch(["resume", str(path), *words], processes)
    return time.monotonic() - began


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
