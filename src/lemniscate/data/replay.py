"""ReplayBuffer: a ring of transitions that a learner draws from again and again (Lin 1992; Mnih et al. 2015)."""

import math

import psutil
import torch
from torch import Generator, Tensor

from lemniscate.errors import UserError
from lemniscate.spec import Spec
from lemniscate.types import Step, Transition


class ReplayBuffer:
    """The last `capacity` transitions, whichever copy they came from; preallocated on `device`.

    Raises `UserError` where they would not fit into the memory that is free.
    """

    def __init__(self, spec: Spec, capacity: int, device: torch.device) -> None:
        num_bytes = capacity * bytes_per_transition(spec)
        free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else psutil.virtual_memory().available
        if num_bytes > free:
            raise UserError(
                f"A replay of {capacity:,} transitions of {spec.env_id} takes {num_bytes / 1e6:,.0f} MB, and"
                f" {free / 1e6:,.0f} MB are free: choose buffer_size at most {capacity * free // num_bytes:,}."
            )
        columns = {
            name: torch.zeros(capacity, *shape, dtype=kind, device=device) for name, shape, kind in _columns(spec)
        }
        self.transitions = Transition(**columns)
        self.capacity = capacity
        self._written = 0

    def __len__(self) -> int:
        return min(self._written, self.capacity)

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


def bytes_per_transition(spec: Spec) -> int:
    """What a transition takes."""
    return sum(math.prod(shape) * kind.itemsize for _, shape, kind in _columns(spec))


def _columns(spec: Spec) -> list[tuple[str, tuple[int, ...], torch.dtype]]:
    seen = ((spec.observation_size,), torch.uint8 if spec.image else torch.float32)
    return [
        ("obs", *seen),
        ("action", (spec.bounded_box().size,), torch.float32),
        ("reward", (), torch.float32),
        ("next_obs", *seen),
        ("terminated", (), torch.bool),
    ]
