"""Several processes of one run, as `torchrun` starts them: what they send each other.

Between machines, and between GPUs, by `torch.distributed`; on one machine through memory that all of them share.
"""

import mmap
import os
import pickle
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import Any, Self

import torch
import torch.distributed as dist
from torch import Tensor
from torch.distributed import PrefixStore, TCPStore  # pyright: ignore[reportPrivateImportUsage]

from lemniscate.errors import RankError
from lemniscate.system.watchdog import Watch
from lemniscate.system.world import World

LONGEST = timedelta(hours=2)
"""that processes wait for one that evaluates, saves or compiles; one that hangs is found by the `Watch` long before"""
CAPACITY = 2**22
"""bytes that a process may send at once through shared memory"""
TRIES = 50
"""looks for the word of another process before this one sleeps: some 25 µs, and to wake takes as long"""


class SharedMemory:
    """One process's part of shared memory: two places for each process, and a socket to each other one.

    A gather takes 17 to 34 µs, where gloo takes some 300.

    A process writes into its place and tells the others so; when all have told it, it reads all places. What they say
    next goes into the other places, so nobody overwrites what somebody still reads.

    The `folder` is on this machine, of all processes; whoever made it may remove it once all are connected. Raises
    `OSError` for a process of another machine, or too little memory.
    """

    def __init__(self, folder: Path, rank: int, size: int) -> None:
        self._rank, self._turn = rank, 0
        with (folder / "memory").open("a+b") as file:
            os.posix_fallocate(file.fileno(), 0, 2 * size * CAPACITY)
            memory = mmap.mmap(file.fileno(), 2 * size * CAPACITY)
        self._places = torch.frombuffer(memory, dtype=torch.uint8).view(2, size, CAPACITY)
        self._others: list[socket.socket] = []
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(folder / str(rank)))
        self._listener.listen(size)

    def connect(self, folder: Path) -> Self:
        """Connect to the other processes, once all listen: those of lower rank are called, the others call."""
        size = self._places.shape[1]
        with self._listener:
            for rank in range(self._rank):
                connection = socket.socket(socket.AF_UNIX)
                connection.connect(str(folder / str(rank)))
                self._others.append(connection)
            self._others += [self._listener.accept()[0] for _ in range(self._rank + 1, size)]
        return self

    def gather(self, mine: Tensor) -> Tensor:
        """The values of all processes in the order of their ranks, [W · n, …], from [n, …] of each.

        Raises `ConnectionError` where a process has ended.
        """
        places, self._turn = self._places[self._turn, :, : mine.nbytes], 1 - self._turn
        places[self._rank] = mine.detach().contiguous().view(-1).view(torch.uint8)
        for other in self._others:
            other.send(b".")
        for other in self._others:
            _hear(other)
        return places.clone(memory_format=torch.contiguous_format).view(-1).view(mine.dtype).view(-1, *mine.shape[1:])

    def close(self) -> None:
        """Leave the others."""
        for other in self._others:
            other.close()


def _hear(other: socket.socket) -> None:
    for _ in range(TRIES):
        with suppress(BlockingIOError):
            if other.recv(1, socket.MSG_DONTWAIT):
                return
            break
    if not other.recv(1):
        raise ConnectionError("A process has ended.")


class Processes(World):
    """This process's part of a world of several: made once all of them are there.

    Tensors on the CPU are sent by gloo, those on a GPU by NCCL; each process of a machine takes the next GPU.
    """

    def __init__(self) -> None:
        super().__init__(int(os.environ["WORLD_SIZE"]), int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]))
        has_gpus = torch.cuda.is_available() and dist.is_nccl_available()
        if has_gpus:
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", 0)) % torch.cuda.device_count())
        backend = "cpu:gloo,cuda:nccl" if has_gpus else "gloo"
        host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
        hosts_store = self.rank == 0 and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True"
        name = f"lemniscate-{os.environ.get('TORCHELASTIC_RESTART_COUNT', 0)}"
        store = PrefixStore(name, TCPStore(host, port, self.size, hosts_store, LONGEST))
        dist.init_process_group(backend, store=store, rank=self.rank, world_size=self.size, timeout=LONGEST)
        self._watch = Watch(PrefixStore(name, TCPStore(host, port, is_master=False)), self.rank, self.size)
        self._begun, self._memory = False, None
        self._memory = self._shared_memory()

    def gather(self, mine: Tensor) -> Tensor:
        """The rows of all processes in the order of their ranks, [W · n, …], from [n, …] of each."""
        with self._together():
            if self._memory and mine.device.type == "cpu" and mine.nbytes <= CAPACITY:
                return self._memory.gather(mine)
            parts = [torch.empty_like(mine, memory_format=torch.contiguous_format) for _ in range(self.size)]
            dist.all_gather(parts, mine.contiguous())
            return torch.cat(parts)

    def gather_columns(self, columns: Sequence[Tensor]) -> list[Tensor]:
        """`gather` for several tensors [n, …] of any types, in one message: they are sent as bytes, side by side."""
        rows = [column.contiguous().view(len(column), -1).view(torch.uint8) for column in columns]
        widths = [row.shape[1] for row in rows]
        parts = zip(self.gather(torch.cat(rows, dim=1)).split(widths, dim=1), columns, strict=True)
        return [part.contiguous().view(c.dtype).view(-1, *c.shape[1:]) for part, c in parts]

    def each(self, mine: Any) -> list[Any]:
        """The objects that all processes pass, in the order of their ranks."""
        data = pickle.dumps(mine)
        longest = int(self.gather(torch.tensor([len(data)])).max())
        padded = torch.frombuffer(bytearray(data.ljust(longest)), dtype=torch.uint8)
        # A pickle says itself where it ends, so what pads it is not read.
        return [pickle.loads(bytes(row.numpy())) for row in self.gather(padded).view(self.size, -1)]

    def from_first(self, mine: Any) -> Any:
        """The object that rank 0 passes, in every process."""
        said = [mine]
        with self._together():
            dist.broadcast_object_list(said, src=0)
        return said[0]

    def busy(self) -> AbstractContextManager[None]:
        """A context in which this process may take as long as it likes."""
        return self._watch.state("busy")

    def begin(self, steps: Callable[[], int]) -> None:
        """From here on every process is to come further every few seconds, by these steps or by what it sends."""
        self._begun = True
        self._watch.begin(steps)

    def fail(self, error: Exception) -> Exception:
        """Tell the other processes why this one ends, so that they end too; returns what it is to raise."""
        if isinstance(error, RankError):
            return error
        if not self._begun and self.rank:
            time.sleep(1.0)  # most likely it is everyone's mistake, and the first says so
        sentence = self._watch.fail(str(error) or type(error).__name__)
        return error if sentence and self.rank == 0 else self._error(sentence)

    def close(self) -> None:
        """Leave the other processes."""
        self._watch.close()
        if self._memory:
            self._memory.close()
        with suppress(RuntimeError):
            dist.destroy_process_group()

    @contextmanager
    def _together(self) -> Iterator[None]:
        """Wait for the others. Raises `RankError` where one of them has gone."""
        self._watch.steps += 1
        try:
            with self._watch.state("waiting"):
                yield
        except (RuntimeError, OSError) as error:
            raise self._error(self._watch.why()) from error

    def _error(self, sentence: str) -> RankError:
        error, fault = RankError(sentence), self._watch.fault()
        if fault:
            error.reason, error.repeats = fault["sentence"], fault["by"] == fault["rank"]
        return error

    def _shared_memory(self) -> SharedMemory | None:
        """The memory shared by all processes of one machine; None if it is too small, or a process is elsewhere."""
        in_memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
        folder = Path(self.from_first(tempfile.mkdtemp(prefix="lemniscate-", dir=in_memory) if self.is_first else ""))
        memory = None
        try:
            with suppress(OSError, AttributeError):  # macOS cannot reserve a file's memory
                memory = SharedMemory(folder, self.rank, self.size)
            listening = all(self.each(memory is not None))
            with suppress(OSError):
                memory = memory.connect(folder) if memory and listening else None
            return memory if all(self.each(memory is not None)) else None
        finally:
            if self.is_first:
                shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def join_world(kind: type[Processes] = Processes) -> Iterator[World]:
    """The world that the environment variables of `torchrun` describe; what ends one process ends them all."""
    world = kind()
    try:
        yield world
    except Exception as error:
        raise world.fail(error) from error
    finally:
        world.close()
