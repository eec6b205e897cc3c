"""One step of Adam down a loss: the same loss on two engines.

Small networks on a CPU are bound by the overhead of single operations, not by arithmetic. So all parameters live in
one vector, and the whole step (gather the rows, forward, backward, clip, Adam) is a function of it, which the compiler
turns into one native call. Without the compiler the same loss goes through autograd. Both agree to rounding.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.func import functional_call, grad_and_value

from lemniscate.maths import means
from lemniscate.nn.flat import Flat
from lemniscate.nn.native import Native
from lemniscate.types import Record

Networks = TypeVar("Networks", bound=nn.Module)
Metrics = Mapping[str, Tensor]
Loss = Callable[..., tuple[Tensor, Metrics]]
"""loss(networks, batch [b, …], *noise) -> (a scalar to descend, what to watch of it)"""

STEPS_PER_CALL = 4
"""compiled into one native call, where the minibatches can be so grouped; more are hardly faster, and compile longer"""


def adam(
    parameters: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    scales: Tensor,
    *,
    betas: tuple[float, float],
    eps: float,
    max_grad_norm: float,
) -> Tensor:
    """Clip the gradient's norm, then one step of Adam in place: Kingma & Ba 2015, arXiv:1412.6980, algorithm 1.

        g ← g · min(1, c / ‖g‖)
        m ← β₁ m + (1 − β₁) g        v ← β₂ v + (1 − β₂) g²
        θ ← θ − α m̂ / (√v̂ + ε),      m̂ = m / (1 − β₁ᵗ),  v̂ = v / (1 − β₂ᵗ)

    Args:
        parameters: θ [P], changed.
        gradient: g [P].
        mean: m [P], changed.
        square: v [P], changed.
        scales: what differs from step to step, α / (1 − β₁ᵗ) and 1 / √(1 − β₂ᵗ), [2].
        betas: β₁ and β₂.
        eps: ε.
        max_grad_norm: c, which may be infinite.

    Returns:
        ‖g‖ before the clip, a scalar.
    """
    norm = gradient.square().sum().sqrt()
    gradient = gradient * (max_grad_norm / (norm + 1e-6)).clamp(max=1)
    mean.lerp_(gradient, 1 - betas[0])
    square.lerp_(gradient.square(), 1 - betas[1])
    parameters.sub_(scales[0] * mean / (square.sqrt() * scales[1] + eps))
    return norm


class Descent(Generic[Networks]):
    """Adam down `loss(networks, batch, *noise)`, minibatch by minibatch.

    Other networks may take part in the loss; only the parameters of `networks` move, from here on views of one vector
    (`Flat`). Move the networks to their device before.
    """

    def __init__(
        self,
        networks: Networks,
        loss: Loss,
        *,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        max_grad_norm: float | None = None,
        watch_as: str = "gradient_norm",
    ) -> None:
        self.objective = _Objective(networks, loss)
        self._watch_as = watch_as
        self._flat = Flat(self.objective)
        self._vector = self._flat.vector
        self.device = self._vector.device
        self._gradient = torch.zeros_like(self._vector)
        self._mean, self._square = torch.zeros_like(self._vector), torch.zeros_like(self._vector)
        self._adam = partial(adam, betas=betas, eps=eps, max_grad_norm=max_grad_norm or math.inf)
        self._log_betas = torch.tensor(betas, dtype=torch.float64, device=self.device).log()
        self._rates, self._powers = self._log_betas.new_ones(2), self._log_betas.new_tensor([-1, -0.5])
        self._count = self._log_betas.new_zeros(1)
        self._parameters = list(self.objective.parameters())
        for parameter, gradient in zip(self._parameters, self._flat.parts(self._gradient).values(), strict=True):
            parameter.grad = gradient
        self._engine: Callable[..., dict[str, Tensor]] = self._steps
        self._steps_per_call = 1

    def __call__(self, batch: Record, parts: Tensor, learning_rate: float, *noise: Tensor) -> dict[str, Tensor]:
        """Descend one step on `batch[rows]` for each `rows` in `parts`.

        Args:
            batch: record of tensors [B, …].
            parts: K minibatches of b rows each, [K, b] int64. Once native, every call must have the same B, K and b.
            learning_rate: α.
            *noise: random numbers that the loss needs, a part of them for each step, [K, …].

        Returns:
            Means over the K steps of what the loss watches, and of the gradient's norm before the clip.
        """
        self.set_learning_rate(learning_rate)
        return means([self._engine(batch, *chunk) for chunk in in_calls(self._steps_per_call, parts, *noise)])

    def set_learning_rate(self, learning_rate: float) -> None:
        """α of every step from here on."""
        self._rates[0] = learning_rate

    @property
    def steps(self) -> int:
        """Taken so far, t."""
        return int(self._count)

    def step(self, batch: Record, *noise: Tensor) -> dict[str, Tensor]:
        """One step down the loss of `batch`: what the loss watches, and the gradient's norm before the clip.

        In a native call the networks are a function of the vector; elsewhere the vector's parts are their parameters.
        """
        if torch.compiler.is_compiling():
            differentiate = grad_and_value(partial(functional_call, self.objective, args=(batch, *noise)), has_aux=True)
            gradients, (_, metrics) = differentiate(self.parameters())
            gradient = self._flat.join(gradients)
        else:
            gradient = self._gradient.zero_()
            total, metrics = self.objective(batch, *noise)
            total.backward(inputs=self._parameters)
        with torch.no_grad():
            self._count.add_(1)
            bias = 1 - (self._log_betas * self._count).exp()  # as a power, βᵗ would be computed for each parameter
            scales = (self._rates * bias**self._powers).to(self._vector)
            norm = self._adam(self._vector, gradient, self._mean, self._square, scales)
        return {**metrics, self._watch_as: norm}

    def parameters(self) -> dict[str, Tensor]:
        """Those of `objective` by name, views of the vector as it is now."""
        return self._flat.parts(self._vector)

    def make_native(self) -> None:
        """From the next step on, up to four steps are one native call."""
        self._engine = Native(self._native, self._steps, self.device)
        self._steps_per_call = STEPS_PER_CALL

    def state_dict(self) -> dict[str, Tensor]:
        """Adam's two moments and its count; the parameters belong to the networks."""
        return {"mean": self._mean, "square": self._square, "steps": self._count}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Take up where `state_dict` was."""
        self._mean.copy_(state["mean"])
        self._square.copy_(state["square"])
        self._count.copy_(state["steps"])

    def _steps(self, batch: Record, parts: Tensor, *by_step: Tensor) -> dict[str, Tensor]:
        steps = zip(*(tensor.unbind() for tensor in (parts, *by_step)), strict=True)
        return means([self.step(batch[rows], *rest) for rows, *rest in steps])

    def _native(self, batch: Record, *by_step: Tensor) -> dict[str, Tensor]:
        with torch.no_grad():  # of networks that only take part; `grad_and_value` differentiates all the same
            return self._steps(batch, *by_step)


def in_calls(most: int, *by_step: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """Tensors [K, …] in parts of one size, as large as divides K and is at most `most`."""
    size = next(n for n in range(most, 0, -1) if len(by_step[0]) % n == 0)
    return zip(*(tensor.split(size) for tensor in by_step), strict=True)


class _Objective(nn.Module, Generic[Networks]):
    """A loss as a module, so that `functional_call` can put other parameters under it."""

    def __init__(self, networks: Networks, loss: Loss) -> None:
        super().__init__()
        self.networks = networks
        self._loss = loss

    def forward(self, batch: Any, *noise: Tensor) -> tuple[Tensor, Metrics]:
        return self._loss(self.networks, batch, *noise)
