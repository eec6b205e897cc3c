"""Replay: a ring of transitions that a learner draws from again and again (Lin 1992; Mnih et al. 2015)."""

import math

import psutil
import torch
from torch import Generator, Tensor

from lemniscate.errors import UserError
from lemniscate.nn.actor_critic import bounded_box
from lemniscate.types import Spec, Step, Transition


class Replay:
    """The last `capacity` transitions, whichever copy they came from; preallocated on `device`.

    Raises `UserError` where they would not fit into the memory that is free.
    """

    def __init__(self, spec: Spec, capacity: int, device: torch.device) -> None:
        observation, action = spec.observation_size, bounded_box(spec).size
        pixel = torch.uint8 if spec.image else torch.float32
        shapes = {
            "obs": ((observation,), pixel),
            "action": ((action,), torch.float32),
            "reward": ((), torch.float32),
            "next_obs": ((observation,), pixel),
            "terminated": ((), torch.bool),
        }
        self.num_bytes = capacity * sum(math.prod(shape) * dtype.itemsize for shape, dtype in shapes.values())
        free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else psutil.virtual_memory().available
        if self.num_bytes > free:
            raise UserError(
                f"A replay of {capacity:,} transitions of {spec.env_id} takes {_megabytes(self.num_bytes)}, and"
                f" {_megabytes(free)} are free: choose buffer_size at most {capacity * free // self.num_bytes:,}."
            )
        self.transitions = Transition(
            **{
                name: torch.zeros(capacity, *shape, dtype=dtype, device=device)
                for name, (shape, dtype) in shapes.items()
            }
        )
        self.capacity = capacity
        self._written = 0

    def __len__(self) -> int:
        return min(self._written, self.capacity)

    def __str__(self) -> str:
        return f"replay of {self.capacity:,} transitions, {_megabytes(self.num_bytes)}"

    def add(self, obs: Tensor, action: Tensor, step: Step) -> None:
        """Remember what `action` at `obs` brought, copy by copy; rows in which it was ignored are left out."""
        rows = Transition(obs, action, step.reward, step.next_obs, step.terminated)
        self.extend(rows if step.valid.all() else rows[step.valid])

    def extend(self, rows: Transition) -> None:
        """Keep `rows` [B, …], in the place of the oldest."""
        start, count = self._written % self.capacity, len(rows.reward)
        room = min(count, self.capacity - start)
        for name, ring in vars(self.transitions).items():
            new = getattr(rows, name)
            ring[start : start + room] = new[:room]
            if count > room:
                ring[: count - room] = new[room:]
        self._written += count

    def draw(self, batches: int, size: int, generator: Generator) -> Tensor:
        """Rows of `transitions`, each as probable as any other: [batches, size] int64."""
        return torch.randint(len(self), (batches, size), generator=generator, device=generator.device)

    def state_dict(self) -> dict[str, Tensor]:
        """What is filled, not copied, and how many rows were ever written."""
        filled = {name: ring[: len(self)] for name, ring in vars(self.transitions).items()}
        return {**filled, "written": torch.tensor(self._written)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take up where `state_dict` was."""
        self._written = int(state["written"])
        for name, ring in vars(self.transitions).items():
            ring[: len(self)] = state[name]


def _megabytes(num_bytes: int) -> str:
    return f"{num_bytes / 1e6:,.0f} MB"
