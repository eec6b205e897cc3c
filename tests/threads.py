"""A world of several processes, played by threads: what they gather passes through a barrier."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, BrokenBarrierError

import torch

from lemniscate.system.world import World


class Member(World):
    """One thread's part of a world."""

    def __init__(self, shards, rank, size, barrier, places):
        super().__init__(shards, rank, size)
        self._barrier, self._places = barrier, places

    def gather(self, mine):
        self._places[self.rank] = mine
        self._barrier.wait()
        everyone = torch.cat(self._places)
        self._barrier.wait()
        return everyone

    def gather_columns(self, columns):
        return [self.gather(column) for column in columns]


def in_world(shards, size, work):
    """The results of `work(world)` in each of `size` threads that share so many shards; raises what one of them raised."""
    if size == 1:
        return [work(World(shards))]
    barrier, places = Barrier(size, timeout=300), [None] * size

    def play(rank):
        try:
            return work(Member(shards, rank, size, barrier, places))
        except BaseException:
            barrier.abort()  # the others wait for this thread
            raise

    with ThreadPoolExecutor(size) as pool:
        played = [pool.submit(play, rank) for rank in range(size)]
    failures = [failure for future in played if (failure := future.exception())]
    for failure in sorted(failures, key=lambda failure: isinstance(failure, BrokenBarrierError)):
        raise failure
    return [future.result() for future in played]
