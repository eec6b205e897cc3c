"""SAC: its target, the loss of its policy, and its temperature."""

import numpy as np
import pytest
import torch

from helpers import begin_off_policy, half_square, q_of, slope, small_off_policy, with_random_targets
from lemniscate.algos import sac


def test_the_target_is_the_smaller_of_two_less_the_price_of_the_action(rng):
    config, state, batch = with_random_targets(sac, rng, initial_temperature=0.3)
    noise = torch.randn(50, 1, generator=rng)
    loss, metrics = sac.critic_loss(config, state, state.networks.critics, batch, noise)
    next_action, log_prob = state.policy(batch.next_obs).sample_with_log_prob(noise)
    both = q_of(state.targets, batch.next_obs, next_action)
    target = batch.reward + 0.9 * (torch.min(*both) - 0.3 * log_prob) * (1 - batch.terminated.float())
    values = q_of(state.networks.critics, batch.obs, batch.action)
    torch.testing.assert_close(loss, half_square(values[0], target) + half_square(values[1], target))
    torch.testing.assert_close(metrics["q"], values[0].mean())


def test_the_policy_is_rewarded_for_entropy(rng):
    _, state, batch = with_random_targets(sac, rng, initial_temperature=0.3)
    noise = torch.randn(50, 1, generator=rng)
    loss, metrics = sac.actor_loss(state, state.policy, batch, noise)
    action, log_prob = state.policy(batch.obs).sample_with_log_prob(noise)
    value = torch.min(*q_of(state.networks.critics, batch.obs, action))
    torch.testing.assert_close(loss, (0.3 * log_prob - value).mean())
    torch.testing.assert_close(metrics["losses/actor"], loss.detach())
    torch.testing.assert_close(metrics["losses/entropy"], -log_prob.mean())
    assert not slope(loss, state.networks.temperature).any()  # the temperature has a loss of its own


def test_the_temperature_falls_where_the_entropy_is_above_its_target(rng):
    config, state, batch = with_random_targets(sac, rng, initial_temperature=0.3, target_entropy=0.7)
    noise = torch.randn(50, 1, generator=rng)
    _, log_prob = state.policy(batch.obs).sample_with_log_prob(noise)
    entropy = -log_prob.mean().detach()
    loss, metrics = sac.temperature_loss(config, state.networks.temperature, entropy, 1)
    (gradient,) = torch.autograd.grad(loss, state.networks.temperature.log_alpha)
    # d/d log α of α (H − H̄), H = −E[log π]
    torch.testing.assert_close(gradient, 0.3 * (entropy - 0.7))
    torch.testing.assert_close(metrics["temperature"], torch.tensor(0.3))
    assert sac.temperature_loss(config.replace(target_entropy=None), state.networks.temperature, entropy, 3)[
        0
    ].item() == pytest.approx(0.3 * (entropy.item() + 3))  # H̄ = −A


def test_the_entropy_reaches_its_target():
    """The best policy would be deterministic; a uniform one has log 2 = 0.69."""
    fields = {"initial_temperature": 1.0, "actor_learning_rate": 0.01, "target_entropy": -0.5, "gamma": 0.5}
    config = small_off_policy(sac, "Greedy-v0", critic_hidden=(8,), **fields)
    state, _ = begin_off_policy(sac, config, length=None, horizon=4)
    for _ in range(600):
        metrics = sac.update(config, state)
    entropy = [sac.update(config, state)["losses/entropy"].item() for _ in range(50)]
    assert np.mean(entropy) == pytest.approx(-0.5, abs=0.2)
    assert 0 < metrics["temperature"] < 1
