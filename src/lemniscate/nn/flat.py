"""All parameters of some networks as one vector."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from lemniscate.maths import fisher_product
from lemniscate.nn.native import Native
from lemniscate.nn.policies import Policy


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


class FlatPolicy(Flat):
    """A policy as a function of one vector θ, and how its distributions curve there."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        self._policy = policy
        self._product: Callable[[Tensor, Tensor, Tensor], Tensor] = self._fisher

    def at(self, theta: Tensor, obs: Tensor) -> Any:
        """π_θ(·|s) at observations [B, O]."""
        return functional_call(self._policy, self.parts(theta), (obs,))

    def fisher(self, vector: Tensor, obs: Tensor) -> Tensor:
        """F v [P], F the Fisher matrix at θ over observations [B, O]; once native, B is always the same."""
        return self._product(self.vector, vector, obs)

    def make_native(self) -> None:
        """From the next product on, each is one native call."""
        self._product = Native(self._fisher, self._fisher, self.vector.device)

    def _fisher(self, theta: Tensor, vector: Tensor, obs: Tensor) -> Tensor:
        return fisher_product(lambda point: self.at(point, obs), theta, vector)
