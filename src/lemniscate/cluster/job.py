"""A run as a job of Ray Train: Ray places the processes and replaces those that die; the program is the same.

Each worker resumes the run in a folder of its own machine. Every planned checkpoint goes with its run directory into
the job's storage, which all machines reach; whoever replaces a worker, or all of them, begins with the newest there.
"""

# pyright: reportMissingImports=false
# Ray is an extra that no check of types needs.

import os
import signal
import socket
import tempfile
import threading
import time
import traceback
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from shutil import copytree, rmtree
from types import FrameType
from typing import Any

from lemniscate.cluster.connection import Cluster, connected
from lemniscate.cluster.parcel import STORAGE, pack, unpack
from lemniscate.errors import NonFiniteError, RankError, UserError, WorkerError, resume_line
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import CONFIG, LOCK, create_directory
from lemniscate.run.stopping import Stopped, stop_signals_to
from lemniscate.sweeps.sweep_progress import progress_of
from lemniscate.system import named, processes
from lemniscate.system.console import say
from lemniscate.system.processes import Processes
from lemniscate.system.world import CLUSTER, World

JOB = "job"
EVERY = 1.0
"""seconds between two looks at the storage"""
FAILURES = 100
"""workers that may be lost before the job gives up"""


def train_on_ray(path: Path, algorithm: str, config: RunConfig, cluster: Cluster, options: Mapping[str, Any]) -> float:
    """Train a run to its end on a cluster; its directory is here when it has ended, as far as it has come.

    Returns the seconds that it took. Raises what ended the run, as one `RankError` if it ended in a worker.
    """
    workers = cluster.workers or 1
    record = {"algorithm": algorithm, "config": config.to_json()}
    new = not (path / CONFIG).exists()
    if new:
        config = config.replace(shards=max(config.shards, workers))
        record["config"] = config.to_json()
    begun = pack(path) if (path / "checkpoints").exists() else None
    began = time.monotonic()
    with connected(cluster):
        if new:
            create_directory(path, CONFIG, record)
        from ray.train import CheckpointConfig, FailureConfig, ScalingConfig
        from ray.train import RunConfig as JobConfig
        from ray.train.torch import TorchConfig, TorchTrainer
        from ray.train.v2.api.exceptions import TrainingFailedError

        storage = cluster.storage or str((path / STORAGE).absolute())
        name = JOB if cluster.storage is None else path.name
        trainer = TorchTrainer(
            _work,
            train_loop_config={"record": record, "begun": begun, "options": dict(options), "name": path.name},
            torch_config=TorchConfig(backend="gloo"),
            scaling_config=ScalingConfig(
                num_workers=(1, workers) if workers > 1 else 1,
                use_gpu=config.device.startswith("cuda"),
                resources_per_worker={"CPU": config.threads},
            ),
            run_config=JobConfig(
                name=name,
                storage_path=storage,
                checkpoint_config=CheckpointConfig(num_to_keep=2),
                failure_config=FailureConfig(max_failures=FAILURES),
            ),
        )
        watching = _Progress(Path(storage) / name, config.total_steps) if options["progress"] else nullcontext()
        asked: list[int] = []  # Ray makes exceptions of its own of what a handler raises

        def stop(signum: int, _frame: FrameType | None) -> None:
            asked.append(signum)
            raise KeyboardInterrupt

        try:
            with stop_signals_to(stop), watching:
                result = trainer.fit()
        except (KeyboardInterrupt, SystemExit):
            again = f"{resume_line(path)} --cluster ray --workers {workers}"
            sentence = f"Stopped; the last checkpoint is kept. Go on with: {again}"
            raise Stopped(sentence, asked[0] if asked else signal.SIGINT) from None  # Ray has Ctrl-C for itself
        except TrainingFailedError as error:
            raise RankError(f"The workers failed {FAILURES} times; the last time: {error}") from None
        _fetch(result.checkpoint, path)
    if result.return_value:
        raise RankError(result.return_value)
    rmtree(path / STORAGE, ignore_errors=True)
    return time.monotonic() - began


class _Progress:
    """A line on standard error for each checkpoint that comes into a storage on this machine's disk."""

    def __init__(self, storage: Path, total_steps: int) -> None:
        self._storage, self._total, self._ended = storage, total_steps, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        told = 0
        while not self._ended.wait(EVERY):
            newest = max(self._storage.glob("checkpoint_*"), default=None)
            step, episode_return, _ = progress_of(newest) if newest else (0, None, None)
            if step > told:
                told = step
                so_far = "" if episode_return is None else f", return {episode_return:.1f}"
                say(f"{step:,} of {self._total:,} steps{so_far}")


def _usable(shards: int, workers: int) -> int:
    """The most workers, not above those there are, that can share the shards equally; the others stand by."""
    return next(n for n in range(workers, 0, -1) if shards % n == 0)


def _fetch(checkpoint: Any, path: Path) -> None:
    """Put what the job's storage has of a run into its directory, whose own config stays."""
    if checkpoint is None:
        return
    with checkpoint.as_directory() as stored:
        rmtree(path / "checkpoints", ignore_errors=True)
        copytree(stored, path, dirs_exist_ok=True, ignore=lambda _, names: {CONFIG, LOCK} & set(names))


def _work(given: dict[str, Any]) -> str | None:
    """The program of each worker. Returns the sentence of what ended the run, if that would end it again."""
    import ray.train
    import torch.distributed as dist
    from ray.train.collective import broadcast_from_rank_zero

    context = ray.train.get_context()
    if dist.is_initialized():  # Ray's own group, of all workers; ours is of those that can share the shards
        dist.destroy_process_group()
    rank, size = context.get_world_rank(), _usable(given["record"]["config"]["shards"], context.get_world_size())
    with socket.socket() as free:
        free.bind(("", 0))
        here = socket.gethostbyname(socket.gethostname()), free.getsockname()[1]
    host, port = broadcast_from_rank_zero(here)
    local = {"LOCAL_RANK": context.get_local_rank(), "LOCAL_WORLD_SIZE": min(size, context.get_local_world_size())}
    ranks = {"RANK": rank, "WORLD_SIZE": size, **local, "MASTER_ADDR": host, "MASTER_PORT": port}
    os.environ.update({CLUSTER: "ray", **{name: str(value) for name, value in ranks.items()}})
    if rank >= size:  # stands by, and takes part in what all workers do
        while broadcast_from_rank_zero(None):
            ray.train.report({})
        return None
    with tempfile.TemporaryDirectory(prefix="lemniscate-") as folder:
        path = Path(folder) / given["name"]
        if rank == 0:
            _begin(path, given, ray.train.get_checkpoint())
        sentence = _train(path, given["options"])
        if sentence is None:
            _keep(path, rank == 0)
        broadcast_from_rank_zero(False)
    return sentence


def _begin(path: Path, given: Mapping[str, Any], checkpoint: Any) -> None:
    """Make the run directory as the job's storage has it, or as it was when the job began, or new."""
    if checkpoint is not None:
        with checkpoint.as_directory() as stored:
            copytree(stored, path)
    elif given["begun"]:
        unpack(given["begun"], path)
    else:
        create_directory(path, CONFIG, given["record"])


def _train(path: Path, options: Mapping[str, Any]) -> str | None:
    """Train a run to its end; returns the sentence of what would end it again."""
    try:
        named.find("lemniscate.api.training:resume")(path, **options)
    except RankError as error:
        if error.repeats:
            return error.reason
        raise  # a worker is gone: Ray replaces it
    except (UserError, NonFiniteError, WorkerError) as error:
        return str(error)
    except Exception:  # a mistake of ours, or of the user's code: it would be made again
        return traceback.format_exc()
    return None


def _keep(path: Path, is_first: bool) -> None:
    """Put a run directory into the job's storage: all workers at the same time."""
    import ray.train
    from ray.train.collective import broadcast_from_rank_zero

    broadcast_from_rank_zero(True)  # to those that stand by
    ray.train.report({}, ray.train.Checkpoint.from_directory(str(path)) if is_first else None)


class RayWorker(World):
    """The only worker of a job."""

    def saved(self, path: Path) -> None:
        """Keep the run directory in the job's storage."""
        _keep(path, True)


class RayWorkers(Processes):
    """The workers of a job."""

    def saved(self, path: Path) -> None:
        """Keep the run directory in the job's storage."""
        with self.busy():
            _keep(path, self.is_first)


def together() -> AbstractContextManager[World]:
    """The world of this worker's job."""
    return nullcontext(RayWorker()) if os.environ["WORLD_SIZE"] == "1" else processes.together(RayWorkers)
