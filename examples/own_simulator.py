"""A simulator of one's own in torch, as a backend. Its steps can be differentiated, so SHAC learns by their gradient.

    cd examples
    lemniscate train shac --env Glide-v0 --backend own_simulator:Glide --total-steps 60_000
    python own_simulator.py

A vector of environments is one object: tensors of all N go in and come out, and what has ended begins anew in the step.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

import lemniscate as lem
from lemniscate.envs.backend import Backend
from lemniscate.spec import Box, ObservationPart, Spec
from lemniscate.types import Step

LENGTH, DT = 50, 0.1


class Glide(Backend):
    """N points in a plane, each to be brought to the origin and held there by a force.

    Observed are position and velocity. An episode takes 5 s, and ends where the point is 3 away.
    """

    differentiable = True

    def __init__(
        self,
        env: str,
        num_envs: int,
        device: torch.device,
        *,
        stagger: bool = False,
        kwargs: Mapping[str, Any] | None = None,
        wrappers: Sequence[str] = (),
    ) -> None:
        self.num_envs, self.device, self._stagger = num_envs, device, stagger
        self._generator = torch.Generator(device)
        self._valid = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.spec = Spec(env, (ObservationPart((), (4,)),), Box((-1.0, -1.0), (1.0, 1.0)), max_episode_steps=LENGTH)

    @classmethod
    def ids(cls) -> Collection[str]:
        """The ids that it serves."""
        return ("Glide-v0",)

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Begin anew; with `stagger`, each environment at a time of its own."""
        self._generator.manual_seed(seed + first)
        self._time = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        if self._stagger:
            self._time = torch.randint(LENGTH, self._time.shape, generator=self._generator, device=self.device)
        self.counts = self._time == 0
        self._state = self._starts()
        return self._state

    def step(self, action: Tensor) -> Step:
        """A tenth of a second: the force changes the velocity, and the velocity the position."""
        position, velocity = self._state.split(2, dim=-1)
        force = action.clamp(-1, 1)
        velocity = velocity + DT * force
        moved = torch.cat([position + DT * velocity, velocity], dim=-1)
        reward = -(moved.square().sum(-1) + force.square().sum(-1))
        self._time = self._time + 1
        terminated = moved[:, :2].detach().norm(dim=-1) > 3
        truncated = (self._time >= LENGTH) & ~terminated
        done = terminated | truncated
        self._state = torch.where(done[:, None], self._starts(), moved)
        self._time, self.counts = self._time.masked_fill(done, 0), self.counts | done
        return Step(self._state, moved, reward, terminated, truncated, self._valid)

    def detach(self) -> None:
        """Gradients go back as far as here."""
        self._state = self._state.detach()

    def close(self) -> None:
        """Nothing to give back."""

    def _starts(self) -> Tensor:
        """Positions within 1 of the origin, at rest, [N, 4]."""
        where = torch.rand(self.num_envs, 2, generator=self._generator, device=self.device) * 2 - 1
        return torch.cat([where, torch.zeros_like(where)], dim=-1)


if __name__ == "__main__":
    trained = lem.train("shac", env="Glide-v0", backend="own_simulator:Glide", total_steps=60_000)
    print(lem.evaluate(trained.policy, episodes=20).mean_return)
