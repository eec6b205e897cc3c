"""The natural gradient and the trust region, from products with the curvature alone."""

from collections.abc import Callable
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import grad, jvp, vjp

Product = Callable[[Tensor], Tensor]
"""v [P] to A v [P], for a symmetric matrix A that is never stored"""


def fisher_product(
    policy: Callable[[Tensor], Any], theta: Float[Tensor, " P"], vector: Float[Tensor, " P"]
) -> Float[Tensor, " P"]:
    """F v, the curvature of the mean KL from a policy to its neighbours: arXiv:1502.05477, appendix C.1.

        F = Jᵀ M J      J = ∂φ/∂θ,  M = ∂²/∂φ² E[KL(π_θ ‖ π_φ)] at φ = φ(θ)

    φ are the numbers that a distribution is made of (mean and log σ, or logits). At θ itself the KL is zero and so is
    its gradient; therefore this is its Hessian, and the Fisher matrix E[∇log π ∇log πᵀ], exactly.

    Args:
        policy: θ to its distributions at B observations.
        theta: θ.
        vector: v.
    """
    here, tangent = cast(tuple[Any, Any], jvp(policy, (theta,), (vector,)))  # J v
    curved = jvp(grad(lambda there: here.kl(there).mean()), (here,), (tangent,))[1]  # M J v
    pull_back: Callable[[Any], tuple[Tensor]] = vjp(policy, theta)[1]
    return pull_back(curved)[0]  # Jᵀ M J v


def conjugate_gradient(
    product: Product, b: Float[Tensor, " P"], *, iterations: int = 10, tolerance: float = 1e-10
) -> Float[Tensor, " P"]:
    """Solve A x = b for a symmetric positive definite A: Hestenes & Stiefel 1952; arXiv:1502.05477, appendix C.

        α = rᵀr / pᵀAp      x ← x + α p      r' = r − α A p      p ← r' + (r'ᵀr' / rᵀr) p

    Exact after P iterations, up to rounding; good long before where few eigenvalues differ.

    Args:
        product: v to A v.
        b: the right-hand side.
        iterations: at most so many.
        tolerance: stop once ‖r‖² is below this fraction of ‖b‖².

    Returns:
        x; zeros where b is zero.
    """
    x, residual, direction = torch.zeros_like(b), b, b
    rr = residual @ residual
    enough = tolerance * rr
    for _ in range(iterations):
        if rr <= enough:
            break
        towards = product(direction)
        alpha = rr / (direction @ towards)
        x = x + alpha * direction
        residual = residual - alpha * towards
        before, rr = rr, residual @ residual
        direction = residual + (rr / before) * direction
    return x


def natural_step(
    product: Product, gradient: Float[Tensor, " P"], max_kl: float | Tensor, *, iterations: int = 10
) -> Float[Tensor, " P"]:
    """The step that lowers a loss most among those of one length in KL: arXiv:1502.05477, appendix C.

        minimize gᵀs  subject to  ½ sᵀHs = δ        s = −√(2δ / gᵀH⁻¹g) H⁻¹g

    Args:
        product: v to H v, the curvature of the KL (with any damping in it).
        gradient: g, of the loss.
        max_kl: δ.
        iterations: of the conjugate gradient.

    Returns:
        s; zeros where g is zero.
    """
    direction = conjugate_gradient(product, -gradient, iterations=iterations)
    length = (direction @ product(direction)).clamp(min=torch.finfo(gradient.dtype).tiny)
    return (2 * max_kl / length).sqrt() * direction


def backtrack(
    judge: Callable[[Tensor], tuple[Tensor, Tensor]],
    start: Float[Tensor, " P"],
    step: Float[Tensor, " P"],
    *,
    max_kl: float | Tensor,
    shrink: float = 0.8,
    attempts: int = 10,
) -> tuple[Float[Tensor, " P"], float]:
    """Backtracking line search: the farthest point start + shrinkʲ · step that meets both conditions.

    Its loss is below that at the start, and its KL within δ (arXiv:1502.05477, appendix C).

    Args:
        judge: a point to (its loss, its KL from the start), scalars.
        start: θ_old, also what is returned when no point will do.
        step: the whole step, j = 0.
        max_kl: δ.
        shrink: in (0, 1).
        attempts: how many points are tried.

    Returns:
        (the point to stand on, the fraction of the step taken: 0 where it is the start).
    """
    before, _ = judge(start)
    for j in range(attempts):
        fraction = shrink**j
        point = start + fraction * step
        loss, kl = judge(point)
        if loss < before and kl <= max_kl:
            return point, fraction
    return start, 0.0
