"""The world of a run: its processes, and the shards whose work each of them does. In an ordinary run there is one.

Everything that a run knows is the same in every process, a *rank*: networks, statistics, random generators, rollouts
and replay. Only work is divided: the steps of the environments (`envs.vec_env`), estimates and gradients
(`optim.shards`). Rank 0 writes.
"""

import multiprocessing.process
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from torch import Tensor

from lemniscate.errors import UserError

CLUSTER = "LEMNISCATE_CLUSTER"
"""in the environment of a worker of a cluster: its kind"""


class World:
    """One process with all shards: nothing is sent. `lemniscate.system.processes.Processes` is a world of several.

    S shards are divided among the W processes, the `size` of the world, which divides S; a rank is 0 … W − 1.
    """

    busy: Callable[[], AbstractContextManager[Any]] = nullcontext
    """makes a context in which this process may take as long as it likes"""

    def __init__(self, shards: int = 1, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size, self.is_first = rank, size, rank == 0
        self.divide(shards)

    def divide(self, shards: int) -> None:
        """Divide the work into so many shards. Raises `UserError` where W does not divide S."""
        size, rank = self.size, self.rank
        if shards % size:
            fits = ", ".join(str(n) for n in range(1, shards + 1) if shards % n == 0)
            raise UserError(f"{size} processes cannot share {shards} shards equally: {shards} can be shared by {fits}.")
        self.shards = shards
        self.held = range(rank * shards // size, (rank + 1) * shards // size)
        """the numbers of the shards that this process computes"""

    def gather(self, mine: Tensor) -> Tensor:
        """The rows of all processes in the order of their ranks, [W · n, …], from [n, …] of each."""
        return mine

    def gather_columns(self, columns: Sequence[Tensor]) -> list[Tensor]:
        """`gather` for several tensors [n, …] of any types, in one message."""
        return list(columns)

    def each(self, mine: Any) -> list[Any]:
        """The objects that all processes pass, in the order of their ranks."""
        return [mine]

    def from_first(self, mine: Any) -> Any:
        """The object that rank 0 passes, in every process."""
        return mine

    def begin(self, steps: Callable[[], int]) -> None:
        """From here on every process is to come further every few seconds, by these steps or by what it sends."""

    def saved(self, path: Path) -> None:
        """The hook after a planned checkpoint in a run directory, called in every process."""


ALONE = World()
"""one process that does all of the work, undivided"""


def leave_if_imported_again() -> None:
    """End this process where it is to be an environment of a script that has no `if __name__ == "__main__":`.

    Such a process imports the script first, and would do all over again what stands in it; who made it says what lacks.
    """
    process = multiprocessing.process.current_process()
    if getattr(process, "_inheriting", False) and "WatchedVectorEnv" in process.name:
        sys.exit(1)
