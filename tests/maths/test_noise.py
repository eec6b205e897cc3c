import math

import pytest
import torch

from lemniscate.maths import coloured, ornstein_uhlenbeck, uniform


def within(values, expected, standard_errors=5.0):
    """Each mean over dim 0 is within so many standard errors of what it should be."""
    error = values.std(0) / math.sqrt(len(values))
    return bool(((values.mean(0) - expected).abs() <= standard_errors * error).all())


@pytest.mark.parametrize("time", [0.3, 5.0, 40.0])
def test_the_process_has_variance_one_at_every_step_and_forgets_exponentially(rng, time):
    path = ornstein_uhlenbeck(torch.randn(20_000, 61, generator=rng, dtype=torch.float64), time)
    assert within(path, 0.0)
    assert within(path.square(), 1.0)
    for lag in (1, 7, 30):
        assert within(path[:, :-lag] * path[:, lag:], math.exp(-lag / time))


@pytest.mark.parametrize("length", [1, 2, 3, 16, 61])
@pytest.mark.parametrize("time", [0.01, 6.7, 1000.0])
def test_the_process_is_the_recursion_that_defines_it(rng, length, time):
    normal = torch.randn(4, 3, length, generator=rng, dtype=torch.float64)
    phi = math.exp(-1 / time)
    x = [normal[..., 0]]
    for t in range(1, length):
        x.append(phi * x[-1] + math.sqrt(1 - phi * phi) * normal[..., t])
    torch.testing.assert_close(ornstein_uhlenbeck(normal, time), torch.stack(x, dim=-1), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("length", [2, 16, 250])
def test_coloured_noise_has_variance_one_at_every_step(rng, exponent, length):
    x = coloured(torch.randn(20_000, length, generator=rng, dtype=torch.float64), exponent)
    assert within(x, 0.0)
    assert within(x.square(), 1.0)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
def test_the_power_falls_as_its_exponent_says(rng, exponent):
    length = 64
    x = coloured(torch.randn(20_000, length, generator=rng, dtype=torch.float64), exponent)
    power = torch.fft.rfft(x).abs().square()
    frequency = torch.arange(1, length // 2 + 1, dtype=torch.float64)
    flat = power[:, 1:] * frequency**exponent
    assert within(flat / flat[:, :-1].mean(), 1.0)
    assert within(power[:, 0] / flat[:, :-1].mean(), 1.0)  # frequency 0 has the power of the lowest above it


def test_white_noise_is_white(rng):
    x = coloured(torch.randn(20_000, 32, generator=rng, dtype=torch.float64), 0.0)
    for lag in (1, 2, 9):
        assert within(x[:, :-lag] * x[:, lag:], 0.0)


def test_coloured_noise_is_the_sum_of_its_waves(rng):
    """The transform, written out."""
    normal = torch.randn(10, generator=rng, dtype=torch.float64)
    t = torch.arange(10, dtype=torch.float64)
    s = torch.tensor([1.0, 1.0, 2**-0.5, 3**-0.5, 4**-0.5, 5**-0.5], dtype=torch.float64)
    s = s / math.sqrt(2 * (s[0] ** 2 + s[5] ** 2) + 4 * (s[1:5] ** 2).sum())
    expected = math.sqrt(2) * (s[0] * normal[0] + s[5] * normal[5] * (-1) ** t)
    for k in range(1, 5):
        angle = 2 * math.pi * k * t / 10
        expected = expected + 2 * s[k] * (normal[k] * angle.cos() - normal[5 + k] * angle.sin())
    assert coloured(normal, 1.0) == pytest.approx(expected)


def test_uniform_numbers_are_uniform_and_go_together_as_before(rng):
    x = torch.randn(100_000, generator=rng, dtype=torch.float64)
    u = uniform(x)
    quantiles = torch.linspace(0.01, 0.99, 99, dtype=torch.float64)
    torch.testing.assert_close(u.quantile(quantiles), 2 * quantiles - 1, atol=0.015, rtol=0)
    assert torch.equal(u.argsort(), x.argsort())
    torch.testing.assert_close(uniform(-x), -u)
