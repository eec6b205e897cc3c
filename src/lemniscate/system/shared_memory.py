"""Memory that the processes of one machine share: what each writes there, all read."""

import mmap
import os
import socket
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

CAPACITY = 2**22
"""bytes that a process may send at once"""
TRIES = 50
"""looks for the word of another process before this one sleeps: some 25 µs, and to wake takes as long"""


class SharedMemory:
    """One process's part of the memory, once all have opened it: two places for each, and a socket to each other one.

    A process writes into its place and tells the others so; when all have told it, it reads all places. What they say
    next goes into the other places, so nobody overwrites what somebody still reads.

    Args:
        folder: on this machine, of all processes; whoever made it may remove it once all are connected.
        rank: of this process.
        size: number of processes.

    Raises:
        OSError: a process of another machine, or too little memory.
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

    @staticmethod
    def new_folder() -> Path:
        """A new folder, in memory where the system has one there."""
        return Path(tempfile.mkdtemp(prefix="lemniscate-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))

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

    def holds(self, mine: Tensor) -> bool:
        """Whether a tensor can be sent so."""
        return mine.device.type == "cpu" and mine.nbytes <= CAPACITY

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

    def gather_bytes(self, mine: bytes) -> list[bytes]:
        """The bytes of all processes, of different lengths; none if those of one are too many. Raises as `gather`."""
        lengths = self.gather(torch.tensor([len(mine)])).tolist()
        if max(lengths) > CAPACITY:
            return []
        padded = torch.frombuffer(bytearray(mine.ljust(max(lengths))), dtype=torch.uint8)
        rows = self.gather(padded).view(len(lengths), -1)
        return [bytes(row.numpy())[:length] for row, length in zip(rows, lengths, strict=True)]

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
