"""Gradients of actions on their way into a simulator: what is kept of them, against a loop over environments."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lemniscate.maths import clip_inward


def passed(action, gradient, max_ratio):
    """The gradient that arrives before the clip."""
    leaf = action.clone().requires_grad_()
    clip_inward(leaf, max_ratio).backward(gradient)
    return leaf.grad


def by_hand(action, gradient, max_ratio):
    """The same, number by number."""
    kept = [
        [g if abs(a) <= 1 or (a > 1) == (g > 0) else 0.0 for a, g in zip(*rows, strict=True)]
        for rows in zip(action.tolist(), gradient.tolist(), strict=True)
    ]
    norms = [math.hypot(*row) for row in kept]
    some = sorted(norm for norm in norms if norm > 0)
    limit = max_ratio * some[(len(some) - 1) // 2] if some else math.inf
    scale = [min(1.0, limit / norm) if norm else 1.0 for norm in norms]
    return torch.tensor([[g * s for g in row] for row, s in zip(kept, scale, strict=True)], dtype=torch.float64)


@given(st.integers(0, 10**6), st.integers(1, 7), st.integers(1, 4), st.sampled_from([0.5, 1.0, 3.0, math.inf]))
def test_what_is_kept_of_a_gradient(seed, envs, size, max_ratio):
    generator = torch.Generator().manual_seed(seed)
    action = 2 * torch.randn(envs, size, generator=generator, dtype=torch.float64)
    gradient = torch.randn(envs, size, generator=generator, dtype=torch.float64)
    gradient *= torch.randint(0, 4, (envs, 1), generator=generator).double() ** 6  # some have none, some a long one
    torch.testing.assert_close(passed(action, gradient, max_ratio), by_hand(action, gradient, max_ratio))
    assert torch.equal(clip_inward(action, max_ratio), action.clamp(-1, 1))


def test_an_action_out_of_range_is_led_back_and_not_further_out():
    action = torch.tensor([[1.5], [1.5], [-1.5], [-1.5]])
    descends = torch.tensor([[1.0], [-1.0], [1.0], [-1.0]])
    assert passed(action, descends, 3.0).flatten().tolist() == [1, 0, 0, -1]


def test_one_environment_has_no_more_say_than_its_share():
    gradient = torch.ones(5, 2)
    gradient[3] = 1e9
    kept = passed(torch.zeros(5, 2), gradient, 3.0)
    torch.testing.assert_close(kept.norm(dim=-1), torch.tensor([1.0, 1, 1, 3, 1]) * 2**0.5)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_gradient_that_is_not_finite_stays_so(bad):
    gradient = torch.ones(3, 1)
    gradient[1] = bad
    assert not passed(torch.zeros(3, 1), gradient, 3.0)[1].isfinite()


def test_no_gradient_at_all_stays_zero():
    assert not passed(torch.zeros(3, 2), torch.zeros(3, 2), 3.0).any()
