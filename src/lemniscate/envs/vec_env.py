"""The contract of the environment floor: what a backend provides, and `VecEnv`, which is what the floors above see."""

import math
import time
from typing import Protocol

import torch
from torch import Tensor

from lemniscate.envs.episodes import Episodes, EpisodeStatistics
from lemniscate.errors import NonFiniteError, UserError
from lemniscate.spec import Spec
from lemniscate.types import Step


class Backend(Protocol):
    """N copies of an environment, stepped together."""

    spec: Spec
    num_envs: int
    device: torch.device
    counts: Tensor
    """[N] bool: the environment's present episode counts in the statistics; False for the fragments of staggering"""

    def restart(self, seed: int) -> Tensor:
        """Begin anew, as if just built from `seed`: nothing of the past remains. Returns obs [N, O]."""
        ...

    def step(self, action: Tensor) -> Step:
        """Act in every copy: Box actions float [N, A] in [-1, 1], Discrete ones int64 [N]."""
        ...

    def close(self) -> None:
        """Give back processes and windows."""
        ...


PATIENCE = 20_000
"""steps that an episode may take in an environment without a time limit, where whole ones are wanted"""


class Stopwatch:
    """Seconds spent inside its `with` blocks."""

    def __init__(self) -> None:
        self._began, self._seconds = 0.0, 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._seconds += time.perf_counter() - self._began

    def take(self) -> float:
        """The seconds since the last call."""
        seconds, self._seconds = self._seconds, 0.0
        return seconds


class VecEnv:
    """A backend with its current observation and the books of its episodes."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.spec = backend.spec
        self.num_envs = backend.num_envs
        self.device = backend.device
        self.obs = torch.empty(0)
        self.collecting = Stopwatch()
        """seconds that the functions of `data` spend acting and stepping"""

    def restart(self, seed: int, steps: int = 0) -> Tensor:
        """Begin anew from `seed`; also stored as `obs`, [N, O]. `steps` is what the run has taken so far."""
        self.steps = steps
        self._statistics = EpisodeStatistics(self.num_envs, self.device)
        self.obs = self.backend.restart(seed)
        self._require_finite(observation=self.obs)
        return self.obs

    def step(self, action: Tensor) -> Step:
        """Act in every copy and move `obs` on.

        Raises:
            NonFiniteError: an observation or a reward is NaN or infinite; nothing has learned from it yet.
        """
        counts = self.backend.counts
        step = self.backend.step(action)
        self._require_finite(observation=step.next_obs, reward=step.reward)
        if step.obs is not step.next_obs:
            self._require_finite(observation=step.obs)
        self.obs = step.obs
        self.steps += self.num_envs
        self._statistics.log(step, counts)
        return step

    def _require_finite(self, **quantities: Tensor) -> None:
        for name, values in quantities.items():
            if math.isfinite(values.sum().item()):  # one NaN or infinity shows in the sum of all, and the sum is cheap
                continue
            bad = torch.nonzero(~torch.isfinite(values))
            if len(bad):
                value, copy = values[tuple(bad[0])].item(), int(bad[0, 0])
                raise NonFiniteError(f"The {name} of environment {copy} is {value} in the step after {self.steps:,}.")

    def require_end(self, age: int) -> None:
        """Raise `UserError` where an episode of `age` steps has had its chance to end, and there is no time limit."""
        if self.spec.max_episode_steps is None and age >= PATIENCE:
            raise UserError(
                f"An episode of {self.spec.env_id} has not ended after {PATIENCE:,} steps, and there is no time limit;"
                " give it one, with max_episode_steps where it is registered."
            )

    def take_episodes(self) -> Episodes:
        """The whole episodes that ended since the last call."""
        return self._statistics.take()

    def close(self) -> None:
        """Give back processes and windows."""
        self.backend.close()
