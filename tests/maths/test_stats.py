import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lemniscate.maths import (
    clip_fraction,
    explained_variance,
    kl_k1,
    kl_k3,
    merge_moments,
    moments,
    ratio_statistics,
    standardize,
)


def test_standardize():
    x = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    y = standardize(x)
    assert abs(y.mean()) < 1e-12
    assert abs(y.std() - 1) < 1e-7
    torch.testing.assert_close(standardize(torch.full((5,), 3.0)), torch.zeros(5))


def test_explained_variance():
    target = torch.tensor([1.0, 2.0, 4.0])
    assert explained_variance(target, target) == 1
    assert explained_variance(target.mean().expand(3), target).abs() < 1e-6
    assert explained_variance(-target, target) < 0
    assert not explained_variance(target, torch.ones(3)).isfinite()


def test_moments(rng):
    x = 3 + torch.randn(2, 24, generator=rng, dtype=torch.float64)
    mean, var, count = moments(x)
    torch.testing.assert_close(mean, torch.stack([row.sum() / 24 for row in x]), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(var, torch.stack([((row - row.mean()) ** 2).sum() / 24 for row in x]))
    assert count == 24
    assert [m.tolist() for m in moments(x[:, :0])] == [[0, 0], [0, 0], 0]


def test_both_kl_estimates_agree_with_the_exact_divergence():
    """KL(N(0, 1) ‖ N(0.1, 1.05²)) in closed form, estimated from a million draws of the first."""
    old, new = torch.distributions.Normal(0.0, 1.0), torch.distributions.Normal(0.1, 1.05)
    x = torch.randn(1_000_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    log_ratio = new.log_prob(x) - old.log_prob(x)
    exact = torch.distributions.kl_divergence(old, new)
    for estimate in (kl_k1(log_ratio), kl_k3(log_ratio)):
        assert abs(estimate - exact) < 2e-3
    assert (log_ratio.exp() - 1 - log_ratio).std() < 0.5 * log_ratio.std()  # why k3 is the one to watch


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=20))
def test_k3_is_never_negative(values):
    assert kl_k3(torch.tensor(values, dtype=torch.float64)) >= -1e-12


def test_clip_fraction():
    log_ratio = torch.tensor([1.0, 1.19, 1.21, 0.79, 0.81]).log()
    assert clip_fraction(log_ratio, 0.2) == 0.4


@given(st.integers(1, 50), st.integers(1, 50), st.integers(0, 1000))
def test_merged_moments_are_those_of_the_union(a, b, seed):
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(a, 3, generator=g, dtype=torch.float64) * 3 + 7
    y = torch.randn(b, 3, generator=g, dtype=torch.float64) - 2
    merged = merge_moments(
        x.mean(0),
        x.var(0, correction=0),
        torch.tensor(float(a)).double(),
        y.mean(0),
        y.var(0, correction=0),
        torch.tensor(float(b)).double(),
    )
    union = torch.cat([x, y])
    torch.testing.assert_close(merged[0], union.mean(0))
    torch.testing.assert_close(merged[1], union.var(0, correction=0))
    assert merged[2] == a + b


def test_the_statistics_of_a_ratio_have_their_usual_names():
    log_ratio = torch.tensor([0.0, 0.3, -0.5], dtype=torch.float64)
    found = ratio_statistics(log_ratio, 0.2)
    assert found["approx_kl"].item() == pytest.approx(sum(math.exp(x) - 1 - x for x in (0.0, 0.3, -0.5)) / 3)
    assert found["old_approx_kl"].item() == pytest.approx(0.2 / 3)
    assert found["clip_fraction"].item() == pytest.approx(2 / 3)
