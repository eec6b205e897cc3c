"""Several vectors of the same environment as one: where one vector cannot be divided, each shard has its own."""

from collections.abc import Sequence

import torch
from torch import Tensor

from lemniscate.envs.backend import Backend, Baseline, Scene, Summary
from lemniscate.types import Step


class Joined:
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

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Begin again; see `Backend.restart`."""
        size = self._backends[0].num_envs
        return torch.cat([backend.restart(seed, first + i * size) for i, backend in enumerate(self._backends)])

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
