"""All parameters of a module as one vector."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from lemniscate.errors import UserError
from lemniscate.maths import fisher_product


class ParameterVector:
    """The parameters of a module in one vector [P], of which they become views; those that need no gradient stay apart.

    They remain ordinary `nn.Parameter`s. Move the module to its device before. Raises `UserError` if there are none.
    """

    def __init__(self, module: nn.Module) -> None:
        named = {name: parameter for name, parameter in module.named_parameters() if parameter.requires_grad}
        if not named:
            raise UserError("There is nothing to learn: of one of the networks every parameter is frozen.")
        self.parameters = list(named.values())
        self._names = list(named)
        self._shapes = [parameter.shape for parameter in named.values()]
        self._sizes = [parameter.numel() for parameter in named.values()]
        self.vector = torch.cat([parameter.detach().flatten() for parameter in named.values()])
        for parameter, view in zip(named.values(), self.views(self.vector).values(), strict=True):
            parameter.data = view

    def views(self, vector: Tensor) -> dict[str, Tensor]:
        """Any vector [P] as views with the names and shapes of the parameters."""
        views = zip(self._names, vector.split(self._sizes), self._shapes, strict=True)
        return {name: view.view(shape) for name, view, shape in views}

    def join(self, tensors: dict[str, Tensor]) -> Tensor:
        """The inverse of `views`: tensors with the names of the parameters, as one vector [P]."""
        return torch.cat([tensors[name].flatten() for name in self._names])


class PolicyVector(ParameterVector):
    """A policy as a function of one vector of parameters θ, and the curvature of its distributions there."""

    def __init__(self, policy: nn.Module) -> None:
        super().__init__(policy)
        self._policy = policy

    def at(self, theta: Tensor, obs: Tensor) -> Any:
        """The distribution π_θ(·|s) at observations [B, O]."""
        return functional_call(self._policy, self.views(theta), (obs,))

    def fisher(self, vector: Tensor, obs: Tensor) -> Tensor:
        """F v [P], where F is the Fisher matrix at the present θ, averaged over observations [B, O]."""
        return fisher_product(lambda theta: self.at(theta, obs), self.vector, vector)
