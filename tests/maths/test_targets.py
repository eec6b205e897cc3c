"""Soft returns, and numbers as distributions over bins."""

from statistics import NormalDist

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lemniscate.maths import cross_entropy, gae, hl_gauss, q_lambda, soft_lambda_return, td_target
from maths.test_returns import rollouts


def mixture(reward, next_value, next_bonus, terminated, done, gamma, lam):
    """The TD(λ) return as what it is: n-step returns, weighted by (1 − λ) λ^(n−1), the longest by what is left."""
    T, N = reward.shape
    target = torch.zeros(T, N, dtype=torch.float64)
    for n in range(N):
        for t in range(T):
            last = next((k for k in range(t, T) if done[k, n]), T - 1)
            for end in range(t, last + 1):
                steps = range(t, end + 1)
                n_step = sum(gamma ** (k - t) * reward[k, n].item() for k in steps)
                n_step += sum(gamma ** (k - t + 1) * next_bonus[k, n].item() for k in steps if not terminated[k, n])
                if not terminated[end, n]:
                    n_step += gamma ** (end - t + 1) * next_value[end, n].item()
                target[t, n] += (lam ** (end - t) * (1 - lam) if end < last else lam ** (last - t)) * n_step
    return target


@given(rollouts(), st.floats(0, 1), st.floats(0, 1))
def test_the_soft_return_is_the_mixture_of_n_step_returns(rollout, gamma, lam):
    reward, next_bonus, next_value, terminated, done = rollout
    rows = reward, next_value, next_bonus, terminated, done
    found = soft_lambda_return(*rows, gamma=gamma, lam=lam)
    torch.testing.assert_close(found, mixture(*rows, gamma, lam), rtol=1e-10, atol=1e-10)


@given(rollouts(), st.floats(0, 1))
def test_at_lambda_zero_the_soft_return_is_the_target_of_sac(rollout, gamma):
    reward, bonus, next_value, terminated, done = rollout
    found = soft_lambda_return(reward, next_value, bonus, terminated, done, gamma=gamma, lam=0.0)
    flat = (x.flatten() for x in (reward, next_value + bonus, terminated))
    torch.testing.assert_close(found.flatten(), td_target(*flat, gamma=gamma))


@given(rollouts(), st.floats(0, 1), st.floats(0, 1))
def test_without_a_bonus_the_soft_return_is_the_target_of_gae(rollout, gamma, lam):
    reward, value, next_value, terminated, done = rollout
    next_value = torch.cat([torch.where(done[:-1], next_value[:-1], value[1:]), next_value[-1:]])  # V must agree
    _, target = gae(reward, value, next_value, terminated, done, gamma=gamma, lam=lam)
    found = soft_lambda_return(reward, next_value, torch.zeros_like(reward), terminated, done, gamma=gamma, lam=lam)
    torch.testing.assert_close(found, target, rtol=1e-10, atol=1e-10)


@given(rollouts(), st.floats(0, 1), st.floats(0, 1))
def test_the_return_of_q_learning_is_the_mixture_of_n_step_returns(rollout, gamma, lam):
    reward, _, next_value, terminated, done = rollout
    found = q_lambda(reward, next_value, terminated, done, gamma=gamma, lam=lam)
    expected = mixture(reward, next_value, torch.zeros_like(reward), terminated, done, gamma, lam)
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_hl_gauss_is_the_mass_of_a_normal_in_each_bin(rng):
    edges, width = torch.linspace(-2, 2, 9, dtype=torch.float64), 0.6
    target = torch.cat([torch.rand(20, generator=rng, dtype=torch.float64) * 4 - 2, torch.tensor([-2.0, 2.0])])
    phi = NormalDist().cdf
    for y, found in zip(target.tolist(), hl_gauss(target, edges, width), strict=True):
        below = [phi((edge - y) / (width * 0.5)) for edge in edges.tolist()]
        mass = np.diff(below) / (below[-1] - below[0])
        torch.testing.assert_close(found, torch.from_numpy(mass), rtol=1e-9, atol=1e-12)


@given(st.floats(-6, 6), st.integers(20, 200))
def test_the_mean_of_hl_gauss_is_the_number(y, bins):
    edges = torch.linspace(-10, 10, bins + 1, dtype=torch.float64)
    mean = hl_gauss(torch.tensor([y], dtype=torch.float64), edges) @ ((edges[1:] + edges[:-1]) / 2)
    assert mean.item() == pytest.approx(y, abs=1e-4)


def test_hl_gauss_of_what_lies_outside_is_that_of_the_end():
    edges = torch.linspace(-1, 1, 6)
    found = hl_gauss(torch.tensor([-1e30, -1.0, 1.0, 1e30]), edges)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[2], found[3])
    torch.testing.assert_close(found.sum(1), torch.ones(4))


def test_the_cross_entropy_is_that_of_torch_and_least_where_both_agree(rng):
    logits, other = torch.randn(2, 10, 7, generator=rng, dtype=torch.float64)
    target = other.softmax(1)
    expected = torch.nn.functional.cross_entropy(logits, target)
    torch.testing.assert_close(cross_entropy(logits, target), expected)
    assert cross_entropy(other, target) < expected
