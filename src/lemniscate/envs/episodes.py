"""The episodes of N parallel environments: their returns and lengths, and their staggering."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from lemniscate.types import Step, wide_float

LOG_ROWS = 1024
"""steps after which the logged ones are summed up"""


@dataclass(frozen=True)
class Episodes:
    """Whole episodes that ended, in the order of their ends."""

    returns: list[float]
    lengths: list[int]
    ends: list[int] = field(default_factory=list)
    """for each a number that orders the ends, those of all processes: by time, then by environment"""

    @classmethod
    def merged(cls, parts: Sequence["Episodes"]) -> "Episodes":
        """The episodes of several processes, in the order of their ends."""
        rows = sorted((end, i, part) for part in parts for i, end in enumerate(part.ends))
        columns = ([getattr(part, name)[i] for _, i, part in rows] for name in ("returns", "lengths", "ends"))
        return cls(*columns)


class EpisodeStatistics:
    """Returns and lengths, summed up over many logged steps at once, since [T, N] costs hardly more than [N].

    Fragments (episodes that staggering began late or cut early) and ignored actions (`valid` False) are not counted.
    """

    def __init__(self, num_envs: int, device: torch.device, first: int = 0, total: int | None = None) -> None:
        self._rows, self._total = 0, total or num_envs
        self._numbers = torch.arange(first, first + num_envs, dtype=wide_float(device), device=device)
        """of these environments, among `total`"""
        self._log: list[tuple[Tensor, ...]] = []
        self._running = torch.zeros(2, num_envs, dtype=wide_float(device), device=device)
        self._ended: list[Tensor] = []

    def log(self, step: Step, counts: Tensor) -> None:
        """One step of every environment; `counts` [N] is False where the episode is a fragment."""
        self._log.append((step.reward, step.terminated, step.truncated, step.valid, counts))
        if len(self._log) == LOG_ROWS:
            self._sum_up()

    def take(self) -> Episodes:
        """The whole episodes that ended since the last call."""
        if self._log:
            self._sum_up()
        empty = self._running.new_zeros(3, 0)
        returns, lengths, ends = torch.cat([empty, *self._ended], dim=1)
        self._ended = []
        return Episodes(returns.tolist(), lengths.int().tolist(), ends.long().tolist())

    def _sum_up(self) -> None:
        reward, terminated, truncated, valid, counts = (torch.stack(column) for column in zip(*self._log, strict=True))
        done = (terminated | truncated) & valid
        running = episode_sums(torch.stack([reward * valid, valid]).to(self._running.dtype), done, self._running)
        rows = torch.arange(self._rows, self._rows + len(done), dtype=running.dtype, device=running.device)
        ends = rows[:, None] * self._total + self._numbers
        self._ended.append(torch.cat([running, ends[None]])[:, done & counts])  # by time, then by environment
        self._rows += len(done)
        self._running = running[:, -1] * ~done[-1]
        self._log = []


def episode_sums(rows: Tensor, done: Tensor, carried: Tensor) -> Tensor:
    """The running sums of each episode, at each row.

    Args:
        rows: quantities to sum, [K, T, N].
        done: the episode ends with this row, [T, N] bool.
        carried: sums of the episodes that were under way before the first row, [K, N].

    Returns:
        [K, T, N]
    """
    sums = torch.cat([torch.zeros_like(carried)[:, None], carried[:, None] + rows.cumsum(1)], dim=1)  # [K, T + 1, N]
    next_row = torch.arange(1, len(done) + 1, device=done.device)[:, None]
    after_end = torch.where(done, next_row, 0).cummax(0).values
    first_row = torch.cat([torch.zeros_like(after_end[:1]), after_end[:-1]])  # of the episode at hand, or 0
    return sums[:, 1:] - sums.gather(1, first_row.expand(len(rows), -1, -1))


class Stagger:
    """The first episode of each environment is cut after a random number of steps, uniform up to the time limit.

    A cut counts as a truncation. Without a limit there are no cuts, and every episode is whole.
    """

    def __init__(self, num_envs: int, limit: int | None, *seeds: int) -> None:
        self._steps_left = np.full(num_envs, -1)
        if limit is not None:
            size = num_envs // len(seeds)
            parts = [np.random.default_rng(seed).integers(1, limit, size, endpoint=True) for seed in seeds]
            self._steps_left = np.concatenate(parts)
        self.counts = np.full(num_envs, limit is None)
        """[N] bool: the environment's present episode began at its beginning and is not to be cut"""

    def apply(self, terminated: np.ndarray, truncated: np.ndarray) -> np.ndarray:
        """After one more step in every environment: `truncated` [N], with the cuts that are due."""
        if self.counts.all():
            return truncated
        self._steps_left -= 1
        truncated = truncated | ((self._steps_left == 0) & ~terminated)
        done = terminated | truncated
        self._steps_left[done] = -1
        self.counts = self.counts | done
        return truncated
