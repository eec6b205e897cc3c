"""The runs of a set as tasks of Ray's: each is resumed by a process on whichever machine has room.

After each checkpoint the run directory comes back to the machine where the set was begun. Where a task is lost with its
process or its machine, another one goes on from what has come back, and ends in the same bits.
"""

# pyright: reportMissingImports=false
# Ray is an extra that no check of types needs.

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from signal import SIGTERM
from tempfile import TemporaryDirectory
from typing import Any

from lemniscate.cluster.connection import ITS_OWN, Cluster, connected, pack, unpack
from lemniscate.run.checkpoint import list_steps
from lemniscate.run.metrics import METRICS
from lemniscate.run.places import LOG, Places, Processes
from lemniscate.system.files import replace_file

EVERY = 1.0
"""seconds between two looks at a run"""
MOST_LOSSES = 100
"""tasks that a run may lose before it counts as failed"""


class Task:
    """One run, in a process on the machine that Ray has chosen. It stands beside itself, to be told to stop."""

    def __init__(self) -> None:
        self._places = Processes(1)

    def train(self, name: str, packed: bytes, options: Sequence[str]) -> Iterator[tuple[int | None, bytes, bool]]:
        """Resume a run. Yields its exit code, at the end; and its metrics, or all of it after a checkpoint."""
        with TemporaryDirectory(prefix="lemniscate-") as folder:
            run, sent = Path(folder) / name, None
            unpack(packed, run)
            self._places.start(run, options)
            yield None, b"", False
            while not (codes := self._places.ended()):
                time.sleep(EVERY)
                newest = list_steps(run / "checkpoints")[-1:]
                if newest != sent:
                    sent = newest
                    yield None, pack(run), True
                elif (run / METRICS).exists():
                    yield None, (run / METRICS).read_bytes(), False
            yield codes[run], pack(run, ITS_OWN), True

    def stop(self) -> None:
        """Ask the process to save and stop."""
        self._places.stop()


@dataclass
class _Running:
    """A run that a task is training, or will."""

    task: Any
    said: Any
    options: Sequence[str]
    lost: int
    begun: bool = False
    asked: bool = False
    """to stop"""


class RayTasks(Places):
    """Places on a cluster: as many runs at a time as its cores serve.

    Args:
        cluster: with at most so many `workers` at a time, if it says how many.
        threads: of each run.
        gpu: whether each run needs one.
    """

    def __init__(self, cluster: Cluster, threads: int, gpu: bool = False) -> None:
        import ray

        super().__init__()
        self._ray, self._connection = ray, ExitStack()
        self._connection.enter_context(connected(cluster))
        self._most, self._threads = cluster.workers, threads
        needs: dict[str, Any] = {"num_cpus": threads, "num_gpus": int(gpu), "max_concurrency": 2}
        self._task: Any = ray.remote(**needs)(Task)

    @property
    def count(self) -> int:
        """The number of runs at a time: it changes with the machines of the cluster."""
        cores = int(self._ray.cluster_resources().get("CPU", 1))
        return min(self._most or cores, max(1, cores // self._threads))

    def start(self, run: Path, options: Sequence[str], lost: int = 0) -> None:
        """Send a run, of which so many tasks were lost, to a machine that has room, or will have."""
        task = self._task.remote()
        said = task.train.options(num_returns="streaming").remote(run.name, pack(run), options)
        self._running[run] = _Running(task, said, options, lost)

    def close(self) -> None:
        """Stop all runs, wait for them, and leave the cluster."""
        try:
            super().close()
        finally:
            self._connection.close()

    def _ask_to_stop(self, trainer: _Running) -> None:
        trainer.asked = True
        if trainer.begun:
            trainer.task.stop.remote()
        else:  # it waits for room: nothing is lost
            trainer.said = None

    def _release(self, trainer: _Running) -> None:
        self._ray.kill(trainer.task)

    def _code_of(self, run: Path) -> int | None:
        """Store what a task has sent; its exit code if it has ended. A task that is lost begins again."""
        running = self._running[run]
        if running.said is None:
            return -SIGTERM
        code = None
        try:
            while code is None and self._ray.wait([running.said], timeout=0, fetch_local=False)[0]:
                code, sent, whole = self._ray.get(next(running.said))
                running.begun = True
                if whole:
                    unpack(sent, run)
                elif sent:
                    replace_file(run / METRICS, sent)
        except self._ray.exceptions.RayTaskError as error:  # a mistake, which another task would make again
            (run / LOG).write_text(str(error), "utf-8")
            return 1
        except (self._ray.exceptions.RayError, StopIteration) as error:
            if running.asked:
                return -SIGTERM
            if running.lost == MOST_LOSSES:
                (run / LOG).write_text(f"{MOST_LOSSES + 1} tasks of this run were lost; the last: {error}", "utf-8")
                return 1
            self.start(run, running.options, running.lost + 1)
        return code
