"""Action noise for deterministic policies: a sequence for each parallel environment and episode."""

from typing import Literal

import torch
from torch import Generator, Tensor

from lemniscate.maths import coloured, ornstein_uhlenbeck

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

    def __init__(
        self, kind: Kind, shape: tuple[int, int], length: int, device: torch.device, *, time: float, exponent: float
    ) -> None:
        self._kind, self._time, self._exponent = kind, time, exponent
        self._length = length + length % 2  # `coloured` is for even lengths
        self._sequences = torch.zeros(*shape, self._length, device=device)
        self._position = torch.full((shape[0],), self._length)
        self._rows = torch.arange(shape[0])

    def __call__(self, generator: Generator) -> Tensor:
        """The noise of the next step, [N, A]."""
        due = self._position == self._length
        if due.any():
            self._sequences[due] = self._new_sequences(int(due.sum()), generator)
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
