"""torch.distributions is the oracle."""

import math

import pytest
import torch
from torch import distributions

from lemniscate.maths import (
    Bernoulli,
    Categorical,
    Deterministic,
    EpsilonGreedy,
    Gaussian,
    MultiCategorical,
    SquashedGaussian,
    mean_and_std,
)


def test_mean_and_std_are_those_of_many_samples(rng):
    mean, log_std = torch.tensor([[0.3, -2.0, 0.0]]), torch.tensor([[-1.0, 0.5, 2.0]])
    noise = torch.randn(400_000, 3, generator=rng)
    for distribution in (Gaussian(mean, log_std), SquashedGaussian(mean, log_std)):
        samples = distribution.sample(noise)
        for found, expected in zip(mean_and_std(distribution), (samples.mean(0), samples.std(0)), strict=True):
            torch.testing.assert_close(
                found[0], expected, atol=0.05 if isinstance(distribution, Gaussian) else 0.005, rtol=0
            )
    action = torch.tensor([[0.25, -1.0]])
    found, none = mean_and_std(Deterministic(action))
    torch.testing.assert_close(found, action)
    torch.testing.assert_close(none, torch.zeros(1, 2), atol=1e-6, rtol=0)


def test_gaussian(rng):
    mean, log_std = torch.randn(7, 3, generator=rng, dtype=torch.float64), torch.tensor([-1.0, 0.0, 0.7]).double()
    ours, oracle = Gaussian(mean, log_std), distributions.Normal(mean, log_std.exp())
    action = ours.sample(torch.randn(7, 3, generator=rng, dtype=torch.float64))
    torch.testing.assert_close(ours.log_prob(action), oracle.log_prob(action).sum(-1))
    torch.testing.assert_close(ours.entropy().expand(7), oracle.entropy().sum(-1))
    assert ours.mode() is mean


def test_gaussian_samples_have_its_moments(rng):
    mean, log_std = torch.tensor([1.0, -2.0]), torch.tensor([0.5, -0.5])
    sample = Gaussian(mean.expand(200_000, 2), log_std).sample(torch.randn(200_000, 2, generator=rng))
    torch.testing.assert_close(sample.mean(0), mean, atol=0.02, rtol=0)
    torch.testing.assert_close(sample.std(0), log_std.exp(), atol=0.02, rtol=0)


def test_categorical(rng):
    logits = torch.randn(7, 4, generator=rng, dtype=torch.float64) * 3
    ours, oracle = Categorical(logits), distributions.Categorical(logits=logits)
    action = ours.sample(torch.rand(7, generator=rng))
    torch.testing.assert_close(ours.log_prob(action), oracle.log_prob(action))
    torch.testing.assert_close(ours.entropy(), oracle.entropy())
    assert (ours.mode() == logits.argmax(-1)).all()


def test_categorical_samples_have_its_frequencies(rng):
    logits = torch.tensor([0.0, 1.0, -1e9, -1.0])
    sample = Categorical(logits.expand(200_000, 4)).sample(torch.rand(200_000, generator=rng))
    frequency = torch.bincount(sample, minlength=4) / len(sample)
    torch.testing.assert_close(frequency, logits.softmax(-1), atol=0.01, rtol=0)
    assert frequency[2] == 0


@pytest.mark.parametrize("masked", range(4))
def test_the_ends_of_the_noise_never_choose_what_is_impossible(masked):
    """The smallest and the largest number that `torch.rand` gives."""
    logits = torch.zeros(2, 4)
    logits[:, masked] = -1e9
    ours = Categorical(logits)
    sample = ours.sample(torch.tensor([0.0, 1 - 2**-24]))
    assert sample.tolist() == [[0, 1][masked == 0], [3, 2][masked == 3]]
    assert torch.isfinite(ours.entropy()).all()


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_epsilon_greedy_samples_have_its_frequencies(epsilon, rng):
    """(1 − ε) for the best, and ε shared by all that are permitted; by hand."""
    values = torch.tensor([0.5, -7.0, -1e9, 2.0])
    expected = torch.tensor([epsilon / 3, epsilon / 3, 0.0, 1 - epsilon + epsilon / 3])
    ours = EpsilonGreedy(values.expand(200_000, 4), torch.tensor(epsilon))
    torch.testing.assert_close(ours.probabilities[0], expected)
    sample = ours.sample(torch.rand(200_000, generator=rng))
    frequency = torch.bincount(sample, minlength=4) / len(sample)
    torch.testing.assert_close(frequency, expected, atol=0.005, rtol=0)
    assert frequency[2] == 0
    assert (ours.mode() == 3).all()


@pytest.mark.parametrize("masked", range(4))
def test_the_ends_of_the_noise_never_explore_what_is_impossible(masked):
    values = torch.arange(4.0).expand(2, 4).clone()
    values[:, masked] = -1e9
    sample = EpsilonGreedy(values, torch.ones(())).sample(torch.tensor([0.0, 1 - 2**-24]))
    assert sample.tolist() == [[0, 1][masked == 0], [3, 2][masked == 3]]


def test_multi_categorical(rng):
    logits = [torch.randn(7, n, generator=rng, dtype=torch.float64) for n in (2, 5)]
    ours = MultiCategorical(tuple(Categorical(part) for part in logits))
    oracle = [distributions.Categorical(logits=part) for part in logits]
    action = ours.sample(torch.rand(7, 2, generator=rng))
    assert action.shape == ours.mode().shape == (7, 2)
    expected = sum(part.log_prob(column) for part, column in zip(oracle, action.unbind(-1), strict=True))
    torch.testing.assert_close(ours.log_prob(action), expected)
    torch.testing.assert_close(ours.entropy(), sum(part.entropy() for part in oracle))
    assert torch.equal(ours.mode()[:, 1], logits[1].argmax(-1))


def test_bernoulli(rng):
    logits = torch.randn(7, 3, generator=rng, dtype=torch.float64) * 3
    ours, oracle = Bernoulli(logits), distributions.Bernoulli(logits=logits)
    action = ours.sample(torch.rand(7, 3, generator=rng))
    torch.testing.assert_close(ours.log_prob(action), oracle.log_prob(action.double()).sum(-1))
    torch.testing.assert_close(ours.entropy(), oracle.entropy().sum(-1))
    assert torch.equal(ours.mode(), (logits > 0).long())
    many = Bernoulli(logits[0].expand(200_000, 3)).sample(torch.rand(200_000, 3, generator=rng)).double().mean(0)
    torch.testing.assert_close(many, logits[0].sigmoid(), atol=0.01, rtol=0)


def test_squashed_gaussian(rng):
    mean, log_std, noise = (torch.randn(7, 3, generator=rng, dtype=torch.float64) for _ in range(3))
    ours = SquashedGaussian(mean, log_std)
    normal = distributions.Normal(mean, log_std.exp())
    oracle = distributions.TransformedDistribution(normal, distributions.TanhTransform())
    action, log_prob = ours.sample_with_log_prob(noise)
    torch.testing.assert_close(action, ours.sample(noise))
    torch.testing.assert_close(log_prob, oracle.log_prob(action).sum(-1))
    torch.testing.assert_close(ours.mode(), torch.tanh(mean))


def test_a_squashed_density_integrates_to_one():
    noise = torch.linspace(-8, 8, 20_001, dtype=torch.float64)[:, None]
    squashed = SquashedGaussian(torch.tensor([0.4]).double(), torch.tensor([-0.5]).double())
    action, log_prob = squashed.sample_with_log_prob(noise)
    assert torch.trapezoid(log_prob.exp(), action[:, 0]).item() == pytest.approx(1, abs=1e-6)


def test_a_squashed_log_prob_is_finite_and_has_a_gradient_where_tanh_is_one():
    mean = torch.tensor([[30.0, -30.0]], requires_grad=True)
    action, log_prob = SquashedGaussian(mean, torch.zeros(1, 2)).sample_with_log_prob(torch.zeros(1, 2))
    assert action.abs().min() == 1
    log_prob.sum().backward()
    # log(1 − tanh² u) → 2 (log 2 − |u|)
    assert log_prob.item() == pytest.approx(-math.log(2 * math.pi) + 2 * 2 * (30 - math.log(2)))
    assert mean.grad.tolist() == [[2.0, -2.0]]


def test_a_point_is_itself_and_what_is_added_stays_in_bounds():
    point = Deterministic(torch.tensor([[0.5, -0.9]]))
    assert point.mode() is point.action
    assert torch.equal(point.sample(torch.zeros(1, 2)), point.action)
    assert torch.equal(point.sample(torch.tensor([[0.25, -0.25]])), torch.tensor([[0.75, -1.0]]))


def pairs(rng):
    """Two of each kind that are neither equal nor far apart: (ours, the same in torch.distributions)."""

    def logits(*shape):
        return [torch.randn(*shape, generator=rng, dtype=torch.float64) for _ in range(2)]

    mean, log_std = logits(7, 3), logits(3)
    yield (
        [Gaussian(*x) for x in zip(mean, log_std, strict=True)],
        [distributions.Independent(distributions.Normal(m, s.exp()), 1) for m, s in zip(mean, log_std, strict=True)],
    )
    of = logits(7, 4)
    yield [Categorical(x) for x in of], [distributions.Categorical(logits=x) for x in of]
    of = logits(7, 3)
    yield (
        [Bernoulli(x) for x in of],
        [distributions.Independent(distributions.Bernoulli(logits=x), 1) for x in of],
    )


def test_kl_is_that_of_torch_never_negative_and_not_symmetric(rng):
    for (ours, other), (oracle, its_other) in pairs(rng):
        expected = distributions.kl_divergence(oracle, its_other)
        torch.testing.assert_close(ours.kl(other), expected, rtol=1e-9, atol=1e-12)
        assert (expected > 0).all()
        assert not torch.allclose(ours.kl(other), other.kl(ours))
        torch.testing.assert_close(ours.kl(ours), torch.zeros(7, dtype=torch.float64), rtol=0, atol=1e-12)


def test_the_kl_of_several_choices_is_the_sum_of_theirs(rng):
    parts = [[Categorical(torch.randn(7, n, generator=rng, dtype=torch.float64)) for n in (2, 5)] for _ in range(2)]
    one, two = (MultiCategorical(tuple(of)) for of in parts)
    torch.testing.assert_close(one.kl(two), sum(a.kl(b) for a, b in zip(*parts, strict=True)))


def test_the_kl_of_what_is_masked_in_both_is_finite():
    one, two = (Categorical(torch.tensor([[0.0, x, -1e9]], dtype=torch.float64)) for x in (1.0, -2.0))
    short = [Categorical(x.logits[:, :2]) for x in (one, two)]
    torch.testing.assert_close(one.kl(two), short[0].kl(short[1]))


def test_the_kl_of_normals_is_that_of_their_images_under_tanh(rng):
    """By integration over actions, on a fine grid of u = artanh a."""
    grid = torch.linspace(-12, 12, 100_001, dtype=torch.float64)
    actions, slope = torch.tanh(grid), 1 / torch.cosh(grid) ** 2
    for mean, log_std, other_mean, other_log_std in (
        torch.randn(6, 4, generator=rng, dtype=torch.float64) / 2
    ).tolist():
        pairs = [(mean, log_std), (other_mean, other_log_std)]
        p, q = (distributions.Normal(m, math.exp(s)).log_prob(grid) - slope.log() for m, s in pairs)  # of actions
        integral = torch.trapezoid(p.exp() * (p - q), actions)
        one, other = (Gaussian(torch.tensor([[m]]), torch.tensor([[s]])) for m, s in pairs)
        torch.testing.assert_close(one.kl(other)[0], integral.float(), rtol=1e-4, atol=1e-5)
