"""torch.distributions is the oracle."""

import torch

from lemniscate.maths import Categorical, Gaussian


def test_gaussian(rng):
    mean, log_std = torch.randn(7, 3, generator=rng, dtype=torch.float64), torch.tensor([-1.0, 0.0, 0.7]).double()
    ours, oracle = Gaussian(mean, log_std), torch.distributions.Normal(mean, log_std.exp())
    action = ours.sample(rng)
    torch.testing.assert_close(ours.log_prob(action), oracle.log_prob(action).sum(-1))
    torch.testing.assert_close(ours.entropy().expand(7), oracle.entropy().sum(-1))
    assert ours.mode() is mean


def test_gaussian_samples_have_its_moments(rng):
    mean, log_std = torch.tensor([1.0, -2.0]), torch.tensor([0.5, -0.5])
    sample = Gaussian(mean.expand(200_000, 2), log_std).sample(rng)
    torch.testing.assert_close(sample.mean(0), mean, atol=0.02, rtol=0)
    torch.testing.assert_close(sample.std(0), log_std.exp(), atol=0.02, rtol=0)


def test_categorical(rng):
    logits = torch.randn(7, 4, generator=rng, dtype=torch.float64) * 3
    ours, oracle = Categorical(logits), torch.distributions.Categorical(logits=logits)
    action = ours.sample(rng)
    torch.testing.assert_close(ours.log_prob(action), oracle.log_prob(action))
    torch.testing.assert_close(ours.entropy(), oracle.entropy())
    assert (ours.mode() == logits.argmax(-1)).all()


def test_categorical_samples_have_its_frequencies(rng):
    logits = torch.tensor([0.0, 1.0, -1.0])
    sample = Categorical(logits.expand(200_000, 3)).sample(rng)
    frequency = torch.bincount(sample, minlength=3) / len(sample)
    torch.testing.assert_close(frequency, logits.softmax(-1), atol=0.01, rtol=0)


def test_the_same_generator_state_draws_the_same_actions():
    for distribution in (Gaussian(torch.zeros(5, 2), torch.zeros(2)), Categorical(torch.zeros(5, 3))):
        first = distribution.sample(torch.Generator().manual_seed(3))
        torch.rand(4)  # the global generator has no part in it
        assert torch.equal(first, distribution.sample(torch.Generator().manual_seed(3)))
