"""A run as a job of Ray Train: Ray places the processes and replaces those that die; the program is the same.

Each worker resumes the run in a folder of its own machine. Every planned checkpoint goes with its run directory into
the job's storage, which all machines reach; whoever replaces a worker, or all of them, begins with the newest there.
"""

# pyright: reportMissingImports=false
# Ray is an extra that no check of types needs.

import os
import shlex
import signal
import socket
import tempfile
import threading
import traceback
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from shutil import copytree, ignore_patterns, rmtree
from types import FrameType
from typing import Any

from lemniscate.cluster.connection import STORAGE, Cluster, connected, pack, unpack
from lemniscate.errors import NonFiniteError, RankError, UserError, WorkerError, resume_line
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import CONFIG, LOCK, create_directory
from lemniscate.run.metrics import progress_of
from lemniscate.run.stopping import Stopped, stop_signals_to
from lemniscate.system import named, processes
from lemniscate.system.console import ProgressBar
from lemniscate.system.files import remove, write_json
from lemniscate.system.processes import Processes
from lemniscate.system.world import CLUSTER, World

JOB = "job"
EVERY = 1.0
"""seconds between two looks at the storage"""
FAILURES = 100
"""workers that may be lost before the job gives up"""


def train_on_ray(
    path: Path, algorithm: str, config: RunConfig, cluster: Cluster, resume: str, options: Mapping[str, Any]
) -> None:
    """Train a run to its end on a cluster; its directory here is then as far as it has come.

    Args:
        path: the run directory.
        algorithm: its name.
        config: of the run; a new one has a shard for each worker, unless more are asked for.
        cluster: where.
        resume: the name, as `module:function`, of what each worker calls with its run directory and the options.
        options: of `resume`, in the worker; with `progress`, it is shown here too.

    Raises:
        Stopped: after a signal; the last checkpoint is kept.
        RankError: what ended the run in a worker.
    """
    workers = cluster.workers or 1
    with connected(cluster):  # before the directory is made: a cluster that does not answer leaves nothing
        from ray.train.v2.api.exceptions import TrainingFailedError

        if not (path / CONFIG).exists():
            require_no_other_job(cluster.storage, path.name)
            config = config.replace(shards=max(config.shards, workers))
            create_directory(path, CONFIG, {"algorithm": algorithm, "config": config.to_json()})
        name = path.name if cluster.storage else JOB
        storage = cluster.storage or str((path / STORAGE).absolute())
        given = {
            "name": path.name,
            "record": {"algorithm": algorithm, "config": config.to_json()},
            "begun": pack(path) if (path / "checkpoints").exists() else None,
            "resume": resume,
            "options": dict(options),
        }
        trainer = _trainer(given, config, workers, name, storage)
        shown = _shown_progress(Path(storage) / name, config.total_steps) if options["progress"] else nullcontext()
        asked: list[int] = []  # Ray makes exceptions of its own of what a handler raises

        def stop(signum: int, _frame: FrameType | None) -> None:
            asked.append(signum)
            raise KeyboardInterrupt

        try:
            with stop_signals_to(stop), shown:
                result = trainer.fit()
        except (KeyboardInterrupt, SystemExit):
            sentence = f"Stopped; the last checkpoint is kept. Go on with: {line_to_resume(path, cluster, workers)}"
            raise Stopped(sentence, asked[0] if asked else signal.SIGINT) from None  # Ray has Ctrl-C for itself
        except TrainingFailedError as error:
            raise RankError(f"The workers failed {FAILURES} times; the last time: {error}") from None
        if result.checkpoint is not None:
            with result.checkpoint.as_directory() as stored:  # the config of the directory stays
                take_back(Path(stored), path)
        if result.return_value:
            raise RankError(result.return_value)
        rmtree(path / STORAGE, ignore_errors=True)


def _trainer(given: dict[str, Any], config: RunConfig, workers: int, name: str, storage: str) -> Any:
    """Ray's trainer of a job with this name in its storage; each worker gets what is given."""
    from ray.train import CheckpointConfig, FailureConfig, ScalingConfig
    from ray.train import RunConfig as JobConfig
    from ray.train.torch import TorchConfig, TorchTrainer

    return TorchTrainer(
        _work,
        train_loop_config=given,
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


def require_no_other_job(storage: str | None, name: str) -> None:
    """Raise `UserError` where a storage has a job of that name, from whose checkpoint Ray would begin a new run."""
    if storage is None:
        return
    from pyarrow import fs

    try:
        files, folder = fs.FileSystem.from_uri(f"{storage}/{name}")
        found = files.get_file_info(folder).type
    except (OSError, ValueError) as error:
        raise UserError(f"The storage {storage} cannot be reached: {error}.") from error
    if found is not fs.FileType.NotFound:
        raise UserError(f"{storage} has a job {name} of another run: choose another --run, or another --storage.")


def line_to_resume(path: Path, cluster: Cluster, workers: int) -> str:
    """The command that goes on with a job from its own storage, which another address or place would not have."""
    place = f"ray={cluster.address}" if cluster.address else "ray"
    kept = ["--storage", cluster.storage] if cluster.storage else []
    return f"{resume_line(path)} {shlex.join(['--cluster', place, '--workers', str(workers), *kept])}"


def take_back(stored: Path, path: Path) -> None:
    """Copy what a job has stored into its run; older checkpoints are removed last, so that there always is one."""
    copytree(stored, path, dirs_exist_ok=True, ignore=ignore_patterns(CONFIG, LOCK))
    newest = {checkpoint.name for checkpoint in (stored / "checkpoints").iterdir()}
    for checkpoint in (path / "checkpoints").iterdir():
        if checkpoint.name not in newest:
            remove(checkpoint)


@contextmanager
def _shown_progress(storage: Path, total_steps: int) -> Iterator[None]:
    """Show meanwhile how far the checkpoints have come that a storage on this machine's disk receives."""
    ended = threading.Event()

    def watch() -> None:
        told, bar = 0, ProgressBar(total_steps, 0)
        while not ended.wait(EVERY):
            newest = max(storage.glob("checkpoint_*"), default=None)
            step, episode_return, _ = progress_of(newest) if newest else (0, None, None)
            if step > told:
                told = step
                bar.update(step, episode_return)
        bar.close()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _work(given: dict[str, Any]) -> str | None:
    """The program of each worker. Returns the sentence of what ended the run, if that would end it again."""
    import ray.train
    import ray.util
    import torch.distributed as dist
    from ray.train.collective import broadcast_from_rank_zero

    context = ray.train.get_context()
    if dist.is_initialized():  # Ray's own group, of all workers; ours is of those that can share the shards
        dist.destroy_process_group()
    rank, workers, shards = context.get_world_rank(), context.get_world_size(), given["record"]["config"]["shards"]
    size = next(n for n in range(workers, 0, -1) if shards % n == 0)  # the most that can share the shards equally
    with socket.socket() as free:
        free.bind(("", 0))
        here = ray.util.get_node_ip_address(), free.getsockname()[1]  # a host may know itself as 127.0.1.1
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
            checkpoint = ray.train.get_checkpoint()
            if checkpoint is not None:  # the job's storage has it
                with checkpoint.as_directory() as stored:
                    copytree(stored, path)
                write_json(path / CONFIG, given["record"])  # which may ask for more steps than there
            elif given["begun"]:
                unpack(given["begun"], path)
            else:
                create_directory(path, CONFIG, given["record"])
        sentence = _train(path, given["resume"], given["options"])
        if sentence is None:
            _keep(path, rank == 0)
        broadcast_from_rank_zero(False)
    return sentence


def _train(path: Path, resume: str, options: Mapping[str, Any]) -> str | None:
    """Train a run to its end; returns the sentence of what would end it again."""
    try:
        named.find(resume)(path, **options)
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
        with self.busy():
            _keep(path, self.is_first)


class RayWorkers(RayWorker, Processes):
    """The workers of a job."""


def join_world() -> AbstractContextManager[World]:
    """The world of this worker's job."""
    return nullcontext(RayWorker()) if os.environ["WORLD_SIZE"] == "1" else processes.join_world(RayWorkers)
