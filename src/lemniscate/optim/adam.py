"""Adam on one vector of parameters, and its learning rate over a run: Kingma & Ba 2015, arXiv:1412.6980.

Small networks on a CPU are bound by the overhead of single operations, not by arithmetic. So all parameters lie in one
vector: clipping and Adam are a few operations on one tensor. Inside a compiled call (`optim.compiled`) the gradient is
that of a pure function of the vector; elsewhere it comes from autograd. Both agree to rounding.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call, grad_and_value

from lemniscate.errors import UserError, shown
from lemniscate.maths import fisher_product
from lemniscate.types import Loss, Metrics, Schedule, wide_float

LossFunction = Callable[..., Loss]
"""loss(networks, *args)"""


class Function(nn.Module):
    """A function as a module, so that `functional_call` can replace the parameters of the networks that it uses."""

    def __init__(self, function: Callable[..., Any], networks: Iterable[nn.Module]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)
        self._function = function

    def forward(self, *args: Any, **flags: Any) -> Any:
        """The function's result."""
        return self._function(*args, **flags)


class ParameterVector:
    """The parameters of a module in one vector [P], of which they become views; those that need no gradient stay apart.

    They remain ordinary `nn.Parameter`s. Move the module to its device before. Raises `UserError` if there are none.
    """

    def __init__(self, module: nn.Module) -> None:
        named = {name: parameter for name, parameter in module.named_parameters() if parameter.requires_grad}
        if not named:
            raise UserError("There is nothing to learn: of one of the networks every parameter is frozen.")
        self.module, self.parameters = module, list(named.values())
        self._shapes = {name: parameter.shape for name, parameter in named.items()}
        self._sizes = [parameter.numel() for parameter in self.parameters]
        self.vector = self.join({name: parameter.detach() for name, parameter in named.items()})
        for parameter, view in zip(self.parameters, self.views(self.vector).values(), strict=True):
            parameter.data = view

    def views(self, vector: Tensor) -> dict[str, Tensor]:
        """Any vector [P] as views with the names and shapes of the parameters."""
        views = zip(self._shapes.items(), vector.split(self._sizes), strict=True)
        return {name: view.view(shape) for (name, shape), view in views}

    def join(self, tensors: dict[str, Tensor]) -> Tensor:
        """The inverse of `views`: tensors with the names of the parameters, as one vector [P]."""
        return torch.cat([tensors[name].flatten() for name in self._shapes])


class PolicyVector(ParameterVector):
    """A policy as a function of one vector of parameters θ, and the curvature of its distributions there."""

    def at(self, theta: Tensor, obs: Tensor) -> Any:
        """The distribution π_θ(·|s) at observations [B, O]."""
        return functional_call(self.module, self.views(theta), (obs,))

    def fisher(self, vector: Tensor, obs: Tensor) -> Tensor:
        """F v [P], where F is the Fisher matrix at the present θ, averaged over observations [B, O].

        Raises `UserError` for a layer without a derivative in forward mode.
        """
        try:
            return fisher_product(lambda theta: self.at(theta, obs), self.vector, vector)
        except NotImplementedError as error:
            said = str(error).partition(" that ")[0]
            raise UserError(
                f"A layer of the policy has no derivative in forward mode, which trpo takes (torch: {said}); ppo learns"
                " with it."
            ) from error


class Adam(ParameterVector):
    """Clipping, and Adam, for the parameters of `networks` that need a gradient: Kingma & Ba 2015, algorithm 1.

    Args:
        networks: the module whose parameters move, already on its device. Other networks may take part in a loss.
        betas: β₁ and β₂, usually 0.9 and 0.99 to 0.999.
        eps: ε, usually 1e-8 to 1e-5.
        max_grad_norm: the global gradient norm above which a gradient is scaled down; None leaves it free.
        name: the ending of the metric `gradient_norm/name`, where an algorithm has several optimizers.
    """

    def __init__(
        self,
        networks: nn.Module,
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        max_grad_norm: float | None = None,
        name: str | None = None,
    ) -> None:
        super().__init__(Function(lambda loss, *args: loss(networks, *args), [networks]))
        self.networks = networks
        self._betas, self._eps, self._limit = betas, eps, max_grad_norm or math.inf
        self._gradient = torch.zeros_like(self.vector)
        self._mean, self._square = torch.zeros_like(self.vector), torch.zeros_like(self.vector)
        device = self.vector.device
        self._log_betas = torch.tensor(betas, dtype=torch.float64).log().to(device, wide_float(device))
        self._rates, self._powers = self._log_betas.new_ones(2), self._log_betas.new_tensor([-1, -0.5])
        self._count = self._log_betas.new_zeros(1)
        self._norm_name = f"gradient_norm/{name}" if name else "gradient_norm"
        self.over_shards: Callable[..., tuple[Tensor, Metrics]] | None = None
        """takes the place of `gradient` where there are several shards: `optim.shards`"""
        for parameter, gradient in zip(self.parameters, self.views(self._gradient).values(), strict=True):
            parameter.grad = gradient

    @property
    def learning_rate(self) -> float:
        """α, the step size of every step from here on."""
        return self._rates[0].item()

    @learning_rate.setter
    def learning_rate(self, learning_rate: float) -> None:
        self._rates[0] = learning_rate

    @property
    def steps(self) -> int:
        """The number of steps taken, t."""
        return int(self._count)

    def step(self, loss: LossFunction, *args: Any) -> Metrics:
        """One step down `loss(networks, *args)`; returns the metrics of the loss, and the gradient's norm.

        Of several shards, each has an equal part of the rows in `args`, records and tensors [M, …].
        """
        gradient, metrics = (self.over_shards or self.gradient)(loss, *args)
        return {**metrics, self._norm_name: self.descend(gradient)}

    def gradient(self, loss: LossFunction, *args: Any) -> tuple[Tensor, Metrics]:
        """The gradient [P] of `loss(networks, *args)`, valid until the next call, and the metrics of the loss."""
        if torch.compiler.is_compiling():
            differentiate = grad_and_value(partial(functional_call, self.module, args=(loss, *args)), has_aux=True)
            with torch.no_grad():  # of networks that only take part in the loss
                gradients, (_, metrics) = differentiate(self.views(self.vector))
            return self.join(gradients), metrics
        returned = loss(self.networks, *args)
        pair: Any = returned if isinstance(returned, tuple | list) and len(returned) == 2 else (None, None)
        if not getattr(pair[0], "requires_grad", False) or pair[0].numel() != 1:
            wanted = "a scalar that can be differentiated, and its metrics, (Tensor, dict)"
            raise UserError(f"A loss must return {wanted}, not {shown(returned)}.")
        total, metrics = pair
        self._gradient.zero_()
        total.backward(inputs=self.parameters)
        return self._gradient, metrics

    @torch.no_grad()
    def descend(self, gradient: Tensor) -> Tensor:
        """One step down a gradient g [P], clipped to a norm of c; returns ‖g‖ before the clip.

            g ← g · min(1, c / ‖g‖)
            m ← β₁ m + (1 − β₁) g        v ← β₂ v + (1 − β₂) g²
            θ ← θ − α m̂ / (√v̂ + ε),      m̂ = m / (1 − β₁ᵗ),  v̂ = v / (1 − β₂ᵗ)

        α is the learning rate, c `max_grad_norm`.
        """
        self._count.add_(1)
        bias = 1 - (self._log_betas * self._count).exp()  # as a power, βᵗ would be computed for each parameter
        rate, scale = (self._rates * bias**self._powers).to(gradient)  # α / (1 − β₁ᵗ) and 1 / √(1 − β₂ᵗ)
        norm = gradient.square().sum().sqrt()
        gradient = gradient * (self._limit / (norm + 1e-6)).clamp(max=1)
        self._mean.lerp_(gradient, 1 - self._betas[0])
        self._square.lerp_(gradient.square(), 1 - self._betas[1])
        self.vector.sub_(rate * self._mean / (self._square.sqrt() * scale + self._eps))
        return norm

    def state_dict(self) -> dict[str, Tensor]:
        """Adam's two moments and its count; the parameters belong to the networks."""
        return {"mean": self._mean, "square": self._square, "steps": self._count}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        self._mean.copy_(state["mean"])
        self._square.copy_(state["square"])
        self._count.copy_(state["steps"])


def linear(start: float, final_fraction: float, progress: float) -> float:
    """From `start` at progress 0 to `final_fraction` of it at progress 1, and no further; a `Schedule` says both."""
    if isinstance(start, Schedule):
        return start.at(progress)
    return start * (1 - (1 - final_fraction) * min(1.0, progress))


def adapt_to_kl(learning_rate: float, kl: float, desired_kl: float) -> float:
    """A smaller rate after an epoch that went twice too far, a larger one after one that went half as far.

    The rule for the penalty β of Schulman et al. 2017, arXiv:1707.06347, section 4, applied to the step size: with
    thresholds of 2 and ½ and a factor of 1.5, where theirs are 1.5 and 1/1.5 and a factor of 2; within [1e-6, 1e-2].
    """
    factor = 1 / 1.5 if kl > 2 * desired_kl else 1.5 if kl < desired_kl / 2 else 1.0
    return min(max(learning_rate * factor, 1e-6), 1e-2)
