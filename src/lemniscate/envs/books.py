"""The books of a vector of environments: what each episode brought, and how long it took."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lemniscate.types import Step

LOG_ROWS = 1024
"""steps after which the books are brought up to date, asked or not"""


@dataclass(frozen=True)
class Episodes:
    """Whole episodes that ended, in the order of their ends."""

    returns: list[float]
    lengths: list[int]


class Books:
    """Steps are logged one by one and booked many at once, since [T, N] costs hardly more than [N].

    Fragments (episodes that staggering began late or cut early) and ignored actions (`valid` False) are not counted.
    """

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self._log: list[tuple[Tensor, ...]] = []
        self._running = torch.zeros(2, num_envs, dtype=torch.float64, device=device)
        self._ended: list[Tensor] = []

    def log(self, step: Step, whole: Tensor) -> None:
        """One step of every copy; `whole` [N] says whose episode had begun at its beginning."""
        self._log.append((step.reward, step.terminated, step.truncated, step.valid, whole))
        if len(self._log) == LOG_ROWS:
            self._book()

    def take(self) -> Episodes:
        """The whole episodes that ended since the last call."""
        if self._log:
            self._book()
        returns, lengths = torch.cat([self._running[:, :0], *self._ended], dim=1)
        self._ended = []
        return Episodes(returns.tolist(), lengths.int().tolist())

    def _book(self) -> None:
        reward, terminated, truncated, valid, whole = (torch.stack(column) for column in zip(*self._log, strict=True))
        done = (terminated | truncated) & valid
        running = episode_sums(torch.stack([reward * valid, valid]).double(), done, self._running)
        self._ended.append(running[:, done & whole])  # by time, then by copy
        self._running = running[:, -1] * ~done[-1]
        self._log = []


def episode_sums(rows: Tensor, done: Tensor, carried: Tensor) -> Tensor:
    """What had run up in each episode by each row.

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
