"""All parameters of some networks as one vector."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn


class Flat:
    """The parameters of `networks` in one vector [P], of which they are views from here on.

    They stay ordinary parameters to everyone else. Move the networks to their device before.
    """

    def __init__(self, networks: nn.Module) -> None:
        named = dict(networks.named_parameters())
        self._names = list(named)
        self._shapes = [parameter.shape for parameter in named.values()]
        self._sizes = [parameter.numel() for parameter in named.values()]
        self.vector = torch.cat([parameter.detach().flatten() for parameter in named.values()])
        for parameter, mine in zip(named.values(), self.parts(self.vector).values(), strict=True):
            parameter.data = mine

    def parts(self, vector: Tensor) -> dict[str, Tensor]:
        """Any vector [P] cut into views with the names and shapes of the parameters."""
        parts = zip(self._names, vector.split(self._sizes), self._shapes, strict=True)
        return {name: part.view(shape) for name, part, shape in parts}

    def join(self, parts: dict[str, Tensor]) -> Tensor:
        """What `parts` cut, in one vector [P] again."""
        return torch.cat([parts[name].flatten() for name in self._names])

    def state_dict(self) -> dict[str, Tensor]:
        """Nothing of its own: the parameters belong to the networks."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Nothing to do."""
