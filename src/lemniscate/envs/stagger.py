"""Cutting first episodes, so that the copies of an environment do not all stand at the same age."""

import numpy as np


class Cuts:
    """The first episode of each copy is cut after a random number of steps, uniform up to the time limit.

    A cut counts as a truncation. Without a limit there are no cuts, and every episode is whole.
    """

    def __init__(self, num_envs: int, limit: int | None, seed: int) -> None:
        self._steps_left = np.full(num_envs, -1)
        if limit is not None:
            self._steps_left = np.random.default_rng(seed).integers(1, limit, num_envs, endpoint=True)
        self.whole = np.full(num_envs, limit is None)
        """[N] bool: the copy's present episode began at its beginning and is not to be cut"""

    def apply(self, terminated: np.ndarray, truncated: np.ndarray) -> np.ndarray:
        """After one more step in every copy: `truncated` [N], with the cuts that are due."""
        if self.whole.all():
            return truncated
        self._steps_left -= 1
        truncated = truncated | ((self._steps_left == 0) & ~terminated)
        done = terminated | truncated
        self._steps_left[done] = -1
        self.whole = self.whole | done
        return truncated
