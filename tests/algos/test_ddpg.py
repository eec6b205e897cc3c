"""DDPG: its target, and the deterministic policy gradient."""

import pytest
import torch

from helpers import begin_off_policy, half_square, q_of, small_off_policy, with_random_targets
from lemniscate.algos import ddpg
from lemniscate.types import Transition


def test_the_target_is_that_of_the_target_networks_alone(rng):
    config, state, batch = with_random_targets(ddpg, rng)
    critics, target_critics = state.networks.critics, state.targets.critics
    loss, metrics = ddpg.critic_loss(config, state, critics, batch)
    next_action = torch.tanh(state.targets.policy.net(batch.next_obs))
    (next_value,) = q_of(target_critics, batch.next_obs, next_action)
    target = batch.reward + 0.9 * next_value * (1 - batch.terminated.float())
    (value,) = q_of(critics, batch.obs, batch.action)
    torch.testing.assert_close(loss, half_square(value, target))
    torch.testing.assert_close(metrics["q"], value.mean())


def test_the_gradient_of_the_policy_is_that_of_q_through_the_action():
    """By finite differences in float64."""
    config = small_off_policy(ddpg, critic_hidden=(8,))
    state, _ = begin_off_policy(ddpg, config)
    networks = state.networks.double()
    policy, obs = networks.policy, torch.randn(5, 3, dtype=torch.float64)
    batch = Transition(obs, obs[:, :1], obs[:, 0], obs, obs[:, 0] > 0)
    weight = policy.net[-1].weight
    (gradient,) = torch.autograd.grad(ddpg.actor_loss(state, policy, batch)[0], weight)
    with torch.no_grad():
        for i in range(weight.numel()):
            flat, kept = weight.data.view(-1), weight.data.view(-1)[i].item()
            flat[i] = kept + 1e-6
            up = -networks.critics(obs, policy(obs).mode()).mean()
            flat[i] = kept - 1e-6
            down = -networks.critics(obs, policy(obs).mode()).mean()
            flat[i] = kept
            assert gradient.view(-1)[i].item() == pytest.approx(((up - down) / 2e-6).item(), abs=1e-7)
