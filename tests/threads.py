"""A world of several processes, played by threads: what they gather passes through a barrier."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

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
    """The results of `work(world)` in each of `size` threads that share so many shards."""
    if size == 1:
        return [work(World(shards))]
    barrier, places = Barrier(size, timeout=60), [None] * size
    members = [Member(shards, rank, size, barrier, places) for rank in range(size)]
    with ThreadPoolExecutor(size) as pool:
        return list(pool.map(work, members))
