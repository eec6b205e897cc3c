"""Action noise for deterministic policies: a sequence for each parallel environment and episode."""

from typing import Literal

import torch
from torch import Generator, Tensor

from lemniscate.maths import coloured, ornstein_uhlenbeck
from lemniscate.types import Streams

Kind = Literal["white", "ou", "coloured"]


class ActionNoise:
    """Noise of variance 1 for N parallel environments and A coordinates, each a sequence of its own.

    A sequence is as long as an episode may be, and every episode begins a new one. (Where episodes have no time limit,
    a sequence may end first; then the next one follows.)

    Args:
        kind: white; Ornstein–Uhlenbeck; or coloured, of power f^(−β).
        shape: (N, A).
        length: steps of a sequence, L.
        device: of the sequences.
        time: steps in which an Ornstein–Uhlenbeck correlation falls to 1/e.
        exponent: β.
    """

    local = ("sequences", "position")

    def __init__(
        self, kind: Kind, shape: tuple[int, int], length: int, device: torch.device, *, time: float, exponent: float
    ) -> None:
        self._kind, self._time, self._exponent = kind, time, exponent
        self._length = length + length % 2  # `coloured` is for even lengths
        self._sequences = torch.zeros(*shape, self._length, device=device)
        self._position = torch.full((shape[0],), self._length)
        self._rows = torch.arange(shape[0])

    def __call__(self, streams: Streams) -> Tensor:
        """The noise of the next step, [N, A]; an equal part of the environments draws from each stream."""
        due = self._position == self._length
        if due.any():
            parts = zip(self._sequences.chunk(len(streams)), due.chunk(len(streams)), streams, strict=True)
            for sequences, where, stream in parts:
                if where.any():
                    sequences[where] = self._new_sequences(int(where.sum()), stream)
            self._position[due] = 0
        noise = self._sequences[self._rows, :, self._position]
        self._position += 1
        return noise

    def on_episode_end(self, done: Tensor) -> None:
        """Begin new sequences in the environments `done` [N] bool, whose episodes ended."""
        self._position[done.cpu()] = self._length

    def on_restart(self) -> None:
        """Begin new sequences everywhere: the environments have been restarted."""
        self._position.fill_(self._length)

    @property
    def num_envs(self) -> int:
        """N."""
        return len(self._position)

    def hold(self, rows: slice) -> None:
        """Keep only these environments."""
        self._sequences, self._position = self._sequences[rows].clone(), self._position[rows].clone()
        self._rows = torch.arange(len(self._position))

    def state_dict(self) -> dict[str, Tensor]:
        """The sequences, and the position in each."""
        return {"sequences": self._sequences, "position": self._position}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        self._sequences.copy_(state["sequences"])
        self._position.copy_(state["position"])

    def _new_sequences(self, count: int, generator: Generator) -> Tensor:
        """[count, A, L]."""
        shape = (count, *self._sequences.shape[1:])
        normal = torch.randn(shape, generator=generator, device=generator.device)
        if self._kind == "white":
            return normal
        if self._kind == "ou":
            return ornstein_uhlenbeck(normal, self._time)
        return coloured(normal, self._exponent)
