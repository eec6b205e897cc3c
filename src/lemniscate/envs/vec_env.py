"""Parallel environments, as the floors above see them."""

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from lemniscate.envs.backend import Backend, Scene, Summary
from lemniscate.envs.episodes import Episodes, EpisodeStatistics
from lemniscate.envs.shards import act_over_shards
from lemniscate.errors import NonFiniteError, UserError, wrong_action
from lemniscate.maths import ONE_SHARD, Shards
from lemniscate.spec import Box, Discrete, MultiBinary, Spec
from lemniscate.types import Step

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
    """A backend with its current observation and the statistics of its episodes.

    Args:
        backend: N environments, those of the shards held.
        shards: of the run.
    """

    def __init__(self, backend: Backend, shards: Shards = ONE_SHARD) -> None:
        self.backend = backend
        self.spec = backend.spec
        self.num_envs = backend.num_envs
        self.shards = shards
        size = backend.num_envs // len(shards.held)
        self._first, self._total = shards.held[0] * size, shards.count * size
        self.device = backend.device
        self.summaries: tuple[Summary, ...] = getattr(backend, "summaries", ())
        self.scene: Scene | None = getattr(backend, "scene", None)
        self.obs = torch.empty(0)
        self.collecting = Stopwatch()
        """seconds that the functions of `data` spend acting and stepping"""
        self.steps = 0
        self._statistics = EpisodeStatistics(self.num_envs, self.device, self._first, self._total)
        self._actions: tuple[torch.Size, torch.dtype] | None = None  # before it is restarted, none is right

    def restart(self, *seeds: int, steps: int = 0) -> Tensor:
        """Begin again, each shard from its seed; also stored as `obs`, [N, O]. `steps` is what the run has taken."""
        self.steps = steps
        self._statistics = EpisodeStatistics(self.num_envs, self.device, self._first, self._total)
        self.obs = self.backend.restart(*seeds)
        self._actions = _action_layout(self.spec, self.num_envs)
        self._require_finite(observation=self.obs)
        return self.obs

    def act(self, act: Callable[[Tensor, Tensor], Tensor], noise: Tensor) -> Tensor:
        """`act(obs, noise)` for every environment, [N, …], the same bits for any number of processes."""
        return act(self.obs, noise) if self.shards.count == 1 else act_over_shards(act, self.shards, self.obs, noise)

    def step(self, action: Tensor) -> Step:
        """Act in every environment and move `obs` on; actions as in `Backend.step`.

        Raises:
            NonFiniteError: an action, an observation or a reward is NaN or infinite; nothing has learned from it yet.
            UserError: actions of another kind or shape.
        """
        if not isinstance(action, Tensor) or (action.shape, action.dtype) != self._actions:
            raise wrong_action(f"{self.num_envs} × {self.spec.env_id}", action, self._actions)
        if action.is_floating_point():
            self._require_finite(action=action)
        counts = self.backend.counts
        step = self.backend.step(action)
        self._require_finite(observation=step.next_obs, reward=step.reward)
        if step.obs is not step.next_obs:
            self._require_finite(observation=step.obs)
        self.obs = step.obs
        self.steps += self._total
        self._statistics.log(step, counts)
        return step

    def _require_finite(self, **quantities: Tensor) -> None:
        for name, values in quantities.items():
            if values.dtype is torch.uint8 or math.isfinite(values.sum().item()):  # a NaN shows in the sum
                continue
            bad = torch.nonzero(~torch.isfinite(values))
            if len(bad):
                value, number = values[tuple(bad[0])].item(), self._first + int(bad[0, 0])
                raise NonFiniteError(f"The {name} of environment {number} is {value} in the step after {self.steps:,}.")

    def require_end(self, age: int) -> None:
        """Raise `UserError` where an episode of `age` steps has had its chance to end, and there is no time limit."""
        require_end(self.spec.env_id, age, self.spec.max_episode_steps)

    def take_episodes(self) -> Episodes:
        """The whole episodes that ended since the last call."""
        return self._statistics.take()

    def close(self) -> None:
        """Give back processes and windows."""
        self.backend.close()


def require_end(env_id: str, age: int, limit: int | None) -> None:
    """Raise `UserError` where an episode of `age` steps has had its chance to end, and there is no time `limit`."""
    if limit is None and age >= PATIENCE:
        raise UserError(
            f"An episode of {env_id} has not ended after {PATIENCE:,} steps, and there is no time limit: return"
            " truncated in its step(), or train with --wrappers 'gymnasium.wrappers:TimeLimit(max_episode_steps=1000)'."
        )


def _action_layout(spec: Spec, num_envs: int) -> tuple[torch.Size, torch.dtype]:
    action = spec.action
    if isinstance(action, Discrete):
        return torch.Size((num_envs,)), torch.int64
    if isinstance(action, Box):
        return torch.Size((num_envs, action.size)), torch.float32
    return torch.Size((num_envs, action.n if isinstance(action, MultiBinary) else len(action.nvec))), torch.int64
