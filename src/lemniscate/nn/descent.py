"""One step of Adam down a loss: the same loss on two engines.

Small networks on a CPU are bound by the overhead of single operations, not by arithmetic. So all parameters live in
one vector, and the whole step (gather the rows, forward, backward, clip, Adam) is one pure function of it, which the
compiler turns into one native call. Without the compiler the same loss goes through autograd. Both agree to rounding.
"""

import math
from collections.abc import Callable, Mapping
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
    parameters: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, scales: Tensor, betas: tuple[float, float]
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
        scales: the numbers that differ from step to step, [4]: α / (1 − β₁ᵗ), 1 / √(1 − β₂ᵗ), ε, c.
        betas: β₁ and β₂.

    Returns:
        ‖g‖ before the clip, a scalar.
    """
    rate, correction, eps, limit = scales.unbind()
    norm = gradient.square().sum().sqrt()
    gradient = gradient * (limit / (norm + 1e-6)).clamp(max=1)
    mean.lerp_(gradient, 1 - betas[0])
    square.lerp_(gradient.square(), 1 - betas[1])
    parameters.sub_(rate * mean / (square.sqrt() * correction + eps))
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
        self._objective = _Objective(networks, loss)
        self._betas, self._eps, self._max_grad_norm = betas, eps, max_grad_norm or math.inf
        self._watch_as = watch_as
        self._flat = Flat(self._objective)
        self._vector = self._flat.vector
        self._gradient = torch.zeros_like(self._vector)
        self._mean, self._square = torch.zeros_like(self._vector), torch.zeros_like(self._vector)
        self._parameters = list(self._objective.parameters())
        for parameter, gradient in zip(self._parameters, self._flat.parts(self._gradient).values(), strict=True):
            parameter.grad = gradient
        self.steps = 0
        self._engine: Callable[..., dict[str, Tensor]] = self._eager
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
        steps = range(self.steps + 1, self.steps + 1 + len(parts))
        self.steps += len(parts)
        scales = torch.tensor([self._scales(step, learning_rate) for step in steps], dtype=self._vector.dtype)
        at_once = next(n for n in range(self._steps_per_call, 0, -1) if len(parts) % n == 0)
        by_step = (scales.to(self._vector.device), parts, *noise)
        chunks = zip(*(tensor.split(at_once) for tensor in by_step), strict=True)
        watched = [self._engine(self._vector, self._mean, self._square, batch, *chunk) for chunk in chunks]
        return means(watched)

    def _scales(self, step: int, learning_rate: float) -> tuple[float, float, float, float]:
        beta_1, beta_2 = self._betas
        rate, correction = learning_rate / (1 - beta_1**step), 1 / math.sqrt(1 - beta_2**step)
        return rate, correction, self._eps, self._max_grad_norm

    def make_native(self) -> None:
        """From the next step on, up to four steps are one native call."""
        self._engine = Native(self._functional, self._eager, self._vector.device)
        self._steps_per_call = STEPS_PER_CALL

    def state_dict(self) -> dict[str, Tensor]:
        """Adam's two moments and its count; the parameters belong to the networks."""
        return {"mean": self._mean, "square": self._square, "steps": torch.tensor(self.steps)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Take up where `state_dict` was."""
        self._mean.copy_(state["mean"])
        self._square.copy_(state["square"])
        self.steps = int(state["steps"])

    def _eager(
        self, vector: Tensor, mean: Tensor, square: Tensor, batch: Record, *by_step: Tensor
    ) -> dict[str, Tensor]:
        watched = []
        for scales, rows, *noise in zip(*by_step, strict=True):
            self._gradient.zero_()
            total, metrics = self._objective(batch[rows], *noise)
            total.backward(inputs=self._parameters)
            with torch.no_grad():
                norm = adam(vector, self._gradient, mean, square, scales, self._betas)
            watched.append({**metrics, self._watch_as: norm})
        return means(watched)

    def _functional(
        self, vector: Tensor, mean: Tensor, square: Tensor, batch: Record, *by_step: Tensor
    ) -> dict[str, Tensor]:
        watched = []
        with torch.no_grad():  # of networks that only take part; `grad_and_value` differentiates all the same
            for scales, rows, *noise in zip(*(tensor.unbind() for tensor in by_step), strict=True):
                args = (batch[rows], *noise)
                differentiate = grad_and_value(partial(functional_call, self._objective, args=args), has_aux=True)
                gradients, (_, metrics) = differentiate(self._flat.parts(vector))
                norm = adam(vector, self._flat.join(gradients), mean, square, scales, self._betas)
                watched.append({**metrics, self._watch_as: norm})
        return means(watched)


class _Objective(nn.Module, Generic[Networks]):
    """A loss as a module, so that `functional_call` can put other parameters under it."""

    def __init__(self, networks: Networks, loss: Loss) -> None:
        super().__init__()
        self.networks = networks
        self._loss = loss

    def forward(self, batch: Any, *noise: Tensor) -> tuple[Tensor, Metrics]:
        return self._loss(self.networks, batch, *noise)
