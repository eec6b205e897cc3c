"""Noise for policies that have none of their own: a sequence for each copy and episode, drawn whole, read in order."""

from typing import Literal

import torch
from torch import Generator, Tensor

from lemniscate.maths import coloured, ornstein_uhlenbeck

Noise = Literal["white", "ou", "coloured"]


class ActionNoise:
    """Noise of variance 1 for N copies and A coordinates, each a sequence of its own.

    A sequence is as long as an episode may be, and a copy begins a new one with each episode. (Where episodes have no
    limit, a sequence may end first; then the next one follows.)

    Args:
        kind: white; Ornstein–Uhlenbeck; or coloured, of power f^(−β).
        shape: (N, A).
        length: steps of a sequence, L.
        device: where.
        time: in which an Ornstein–Uhlenbeck correlation falls to 1/e, in steps.
        exponent: β.
    """

    def __init__(
        self, kind: Noise, shape: tuple[int, int], length: int, device: torch.device, *, time: float, exponent: float
    ) -> None:
        self._kind, self._time, self._exponent = kind, time, exponent
        self._length = length + length % 2  # `coloured` is for even lengths
        self._sequences = torch.zeros(*shape, self._length, device=device)
        self._position = torch.full((shape[0],), self._length)
        self._copies = torch.arange(shape[0])

    def __call__(self, generator: Generator) -> Tensor:
        """The noise of the next step, [N, A]."""
        due = self._position == self._length
        if due.any():
            self._sequences[due] = self._draw(int(due.sum()), generator)
            self._position[due] = 0
        noise = self._sequences[self._copies, :, self._position]
        self._position += 1
        return noise

    def cut(self, done: Tensor) -> None:
        """Episodes ended in the copies `done` [N]: what follows there is a sequence from its beginning."""
        self._position[done.cpu()] = self._length

    def restart(self) -> None:
        """All episodes ended."""
        self._position.fill_(self._length)

    def state_dict(self) -> dict[str, Tensor]:
        """The sequences, and how far each has been read."""
        return {"sequences": self._sequences, "position": self._position}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take up where `state_dict` was."""
        self._sequences.copy_(state["sequences"])
        self._position.copy_(state["position"])

    def _draw(self, copies: int, generator: Generator) -> Tensor:
        """[copies, A, L]."""
        shape = (copies, *self._sequences.shape[1:])
        normal = torch.randn(shape, generator=generator, device=generator.device)
        if self._kind == "white":
            return normal
        if self._kind == "ou":
            return ornstein_uhlenbeck(normal, self._time)
        return coloured(normal, self._exponent)
