"""Against dense linear algebra, finite differences and policies whose natural gradient is known in closed form."""

import math
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.func import functional_call, grad

from lemniscate.maths import (
    Bernoulli,
    Categorical,
    Gaussian,
    MultiCategorical,
    backtrack,
    conjugate_gradient,
    fisher_product,
    natural_step,
)

F64 = torch.float64


@st.composite
def systems(draw):
    """A symmetric positive definite matrix [P, P] of a condition up to 10,000, and a vector [P]."""
    size, g = draw(st.integers(1, 12)), torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    basis, _ = torch.linalg.qr(torch.randn(size, size, generator=g, dtype=F64))
    eigenvalues = 10 ** (4 * torch.rand(size, generator=g, dtype=F64) - 2)
    return basis @ torch.diag(eigenvalues) @ basis.T, torch.randn(size, generator=g, dtype=F64)


@given(systems())
def test_conjugate_gradient_is_the_inverse(system):
    matrix, b = system
    x = conjugate_gradient(lambda v: matrix @ v, b, iterations=3 * len(b), tolerance=1e-24)
    torch.testing.assert_close(x, torch.linalg.solve(matrix, b), rtol=1e-6, atol=1e-8)


@given(systems(), st.integers(1, 12))
def test_each_iteration_brings_it_nearer_in_the_norm_of_the_matrix(system, iterations):
    matrix, b = system

    def error(n):
        x = conjugate_gradient(lambda v: matrix @ v, b, iterations=n) if n else torch.zeros_like(b)
        apart = x - torch.linalg.solve(matrix, b)
        return apart @ matrix @ apart

    assert error(iterations) <= error(iterations - 1) * (1 + 1e-6) + 1e-12


def test_it_stops_when_it_is_there():
    products = []
    matrix = torch.diag(torch.tensor([1.0, 1.0, 3.0, 3.0], dtype=F64))
    conjugate_gradient(lambda v: products.append(v) or matrix @ v, torch.ones(4, dtype=F64), iterations=10)
    assert len(products) == 2  # as many as there are different eigenvalues
    assert not conjugate_gradient(lambda v: matrix @ v, torch.zeros(4, dtype=F64)).any()


@given(systems(), st.floats(1e-4, 1))
def test_the_natural_step_has_its_length_and_nothing_of_that_length_goes_lower(system, max_kl):
    matrix, gradient = system
    step = natural_step(lambda v: matrix @ v, gradient, max_kl, iterations=40)
    assert (0.5 * step @ matrix @ step).item() == pytest.approx(max_kl, rel=1e-5)
    others = torch.randn(200, len(step), generator=torch.Generator().manual_seed(0), dtype=F64)
    length = 0.5 * (others @ matrix * others).sum(-1, keepdim=True)
    others = others * (max_kl / length).sqrt()
    assert (others @ gradient).min() >= gradient @ step - 1e-6 * (gradient @ step).abs()


def test_without_a_gradient_there_is_no_step():
    assert natural_step(lambda v: v, torch.zeros(3), 0.01).tolist() == [0, 0, 0]


def small_policy():
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 2)).double()
    obs, names = torch.randn(6, 3, dtype=F64), {name: p.shape for name, p in net.named_parameters()}
    point = torch.cat([p.detach().flatten() for p in net.parameters()])

    def policy(theta):
        parts = theta.split([shape.numel() for shape in names.values()])
        named = {name: part.view(shape) for (name, shape), part in zip(names.items(), parts, strict=True)}
        return Gaussian(functional_call(net, named, (obs,)), torch.tensor([-0.5, 0.3], dtype=F64))

    return policy, point


def dense(policy, theta):
    """The whole Fisher matrix, a product with each unit vector."""
    return torch.stack([fisher_product(policy, theta, row) for row in torch.eye(len(theta), dtype=F64)])


def test_products_are_finite_differences_of_the_gradient_of_the_kl():
    policy, point = small_policy()
    old = policy(point)
    gradient = grad(lambda theta: old.kl(policy(theta)).mean())
    torch.testing.assert_close(gradient(point), torch.zeros_like(point), rtol=0, atol=1e-12)
    for seed in range(3):
        v = torch.randn(len(point), generator=torch.Generator().manual_seed(seed), dtype=F64)
        numeric = (gradient(point + 1e-5 * v) - gradient(point - 1e-5 * v)) / 2e-5
        torch.testing.assert_close(fisher_product(policy, point, v), numeric, rtol=1e-6, atol=1e-8)


def test_it_is_the_fisher_matrix():
    """Of a Gaussian with a σ of its own it is E[ ∂μᵀ/∂θ σ⁻² ∂μ/∂θ ]; symmetric, and no direction has less than none."""
    policy, point = small_policy()
    jacobian = torch.func.jacrev(lambda theta: policy(theta).mean)(point)  # [6, 2, P]
    expected = torch.einsum("bap,baq,a->pq", jacobian, jacobian, (-2 * policy(point).log_std).exp()) / 6
    fisher = dense(policy, point)
    torch.testing.assert_close(fisher, expected, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(fisher, fisher.T, rtol=1e-9, atol=1e-12)
    assert torch.linalg.eigvalsh(fisher).min() > -1e-12


def test_it_is_the_covariance_of_the_score():
    """E[∇log π ∇log πᵀ], summed over the actions of two choices and of switches."""
    theta = torch.tensor([0.2, -1.0, 0.7, 0.0, 0.4], dtype=F64)
    two = lambda theta: MultiCategorical((Categorical(theta[None, :2]), Categorical(theta[None, 2:])))  # noqa: E731
    switches = lambda theta: Bernoulli(theta[None])  # noqa: E731
    for policy, actions in (
        (two, torch.cartesian_prod(torch.arange(2), torch.arange(3))),
        (switches, torch.cartesian_prod(*[torch.arange(2)] * 5)),
    ):
        expected = torch.zeros(5, 5, dtype=F64)
        for action in actions:
            log_prob = lambda theta: policy(theta).log_prob(action[None])[0]  # noqa: B023, E731
            score = grad(log_prob)(theta)
            expected += log_prob(theta).exp() * torch.outer(score, score)
        torch.testing.assert_close(dense(policy, theta), expected, rtol=1e-9, atol=1e-12)


def test_the_natural_gradient_of_a_gaussian_is_known():
    """Fisher information of μ is 1/σ², of log σ it is 2: so the natural gradient is σ² g and g / 2."""
    theta = torch.tensor([0.3, -1.0, 0.5, -0.7], dtype=F64)
    policy = lambda theta: Gaussian(theta[None, :2], theta[2:])  # noqa: E731
    g = torch.tensor([1.0, -2.0, 0.5, 3.0], dtype=F64)
    natural = conjugate_gradient(partial(fisher_product, policy, theta), g, iterations=20, tolerance=1e-24)
    expected = torch.cat([(2 * theta[2:]).exp() * g[:2], g[2:] / 2])
    torch.testing.assert_close(natural, expected, rtol=1e-9, atol=1e-12)


def test_the_curvature_of_a_softmax_is_known():
    """diag(p) − p pᵀ."""
    logits = torch.tensor([0.2, -1.0, 0.7, 0.0], dtype=F64)
    p = logits.softmax(0)
    expected = p.diag() - torch.outer(p, p)
    torch.testing.assert_close(dense(lambda theta: Categorical(theta[None]), logits), expected, rtol=1e-9, atol=1e-12)


def judge(point):
    """A loss with its minimum at 1, and a KL of x²."""
    return (point - 1).square().sum(), point.square().sum()


@pytest.mark.parametrize(
    ("step", "max_kl", "taken"),
    [
        (0.5, 1.0, 1.0),  # the whole step keeps both promises
        (4.0, 100.0, 0.25),  # at 4 and at 2 the loss is no lower; at 1 it is
        (4.0, 0.3, 0.125),  # the loss would do at 1, but the KL only at 0.5
        (4.0, 1e-9, 0.0),  # too far whatever is tried
        (-1.0, 100.0, 0.0),  # uphill
        (0.0, 1.0, 0.0),  # nowhere: not lower
        (math.nan, 1.0, 0.0),
        (math.inf, 1.0, 0.0),
    ],
)
def test_backtracking_stands_on_the_farthest_point_that_keeps_both_promises(step, max_kl, taken):
    start, whole = torch.zeros(1, dtype=F64), torch.tensor([step], dtype=F64)
    point, fraction = backtrack(judge, start, whole, max_kl=max_kl, shrink=0.5, attempts=5)
    assert fraction == taken
    torch.testing.assert_close(point, start + taken * whole if taken else start)
    assert start.item() == 0
    assert judge(point)[1] <= max_kl
    assert judge(point)[0] <= judge(start)[0]


def test_it_tries_no_oftener_than_it_may():
    tried = []
    backtrack(lambda x: tried.append(x) or judge(x), torch.zeros(1), torch.ones(1) * -1, max_kl=9.0, attempts=3)
    assert [x.item() for x in tried] == pytest.approx([0, -1, -0.8, -0.64])
