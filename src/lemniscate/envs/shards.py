"""Environments of several shards: a backend for each where one cannot hold several, and their actions."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from lemniscate.envs.backend import Backend, Baseline, Scene, Summary
from lemniscate.maths import Shards
from lemniscate.types import Step

MOST_TOGETHER = 512
"""parallel environments of all shards up to which their actions are computed in one call"""


class BackendOfShards:
    """Several backends of the same environment, stepped one after the other as if they were one."""

    def __init__(self, backends: Sequence[Backend]) -> None:
        self._backends = backends
        self.spec, self.device = backends[0].spec, backends[0].device
        self.num_envs = sum(backend.num_envs for backend in backends)
        self.summaries: tuple[Summary, ...] = getattr(backends[0], "summaries", ())
        self.scene: Scene | None = getattr(backends[0], "scene", None)
        self.baseline: Baseline | None = getattr(backends[0], "baseline", None)

    @property
    def counts(self) -> Tensor:
        """The counts of all parts; see `Backend.counts`."""
        return torch.cat([backend.counts for backend in self._backends])

    def restart(self, *seeds: int) -> Tensor:
        """Begin again, each backend from its seed."""
        return torch.cat([backend.restart(seed) for backend, seed in zip(self._backends, seeds, strict=True)])

    def step(self, action: Tensor) -> Step:
        """The step of all parts; see `Backend.step`."""
        parts = zip(self._backends, action.chunk(len(self._backends)), strict=True)
        return joined([backend.step(part) for backend, part in parts])

    def close(self) -> None:
        """Close them all."""
        for backend in self._backends:
            backend.close()


def joined(steps: Sequence[Step]) -> Step:
    """The steps of several vectors of environments as one; a measure that some lack is NaN there."""
    names = dict.fromkeys(name for step in steps for name in step.measures)
    missing = [torch.full_like(step.reward, torch.nan) for step in steps]
    measures = {
        name: torch.cat([step.measures.get(name, nan) for step, nan in zip(steps, missing, strict=True)])
        for name in names
    }
    columns = ("obs", "next_obs", "reward", "terminated", "truncated", "valid")
    return Step(**{name: torch.cat([getattr(step, name) for step in steps]) for name in columns}, measures=measures)


def act_over_shards(act: Callable[[Tensor, Tensor], Tensor], shards: Shards, obs: Tensor, noise: Tensor) -> Tensor:
    """`act(obs, noise)` for the rows [N, …] of the shards held, in calls of the same shapes for all processes.

    All shards together are one call, in which the rows of shards that are not held are zero. Large ones are one each.
    """
    held, size = shards.held, len(obs) // len(shards.held)
    if shards.count * size > MOST_TOGETHER:
        parts = zip(obs.chunk(len(held)), noise.chunk(len(held)), strict=True)
        return torch.cat([act(*part) for part in parts])
    here = slice(held.start * size, held.stop * size)
    padded = [x.new_zeros(shards.count * size, *x.shape[1:]) for x in (obs, noise)]
    for whole, mine in zip(padded, (obs, noise), strict=True):
        whole[here] = mine
    return act(*padded)[here]
