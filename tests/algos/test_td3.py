"""TD3: its target, and the loss of its policy."""

import torch

from helpers import half_square, q_of, with_random_targets
from lemniscate.algos import td3


def test_the_target_is_the_smaller_of_two_at_an_action_with_clipped_noise(rng):
    config, state, batch = with_random_targets(td3, rng, target_noise=0.8, target_noise_clip=0.3)
    noise = torch.randn(50, 1, generator=rng)
    loss, metrics = td3.critic_loss(config, state, state.networks.critics, batch, noise)
    clipped = (0.8 * noise).clamp(-0.3, 0.3)
    assert 5 < (clipped.abs() == 0.3).sum() < 45
    next_action = (torch.tanh(state.targets.policy.net(batch.next_obs)) + clipped).clamp(-1, 1)
    both = q_of(state.targets.critics, batch.next_obs, next_action)
    assert 0 < (both[0] < both[1]).sum() < 50
    target = batch.reward + 0.9 * torch.min(*both) * (1 - batch.terminated.float())
    values = q_of(state.networks.critics, batch.obs, batch.action)
    torch.testing.assert_close(loss, half_square(values[0], target) + half_square(values[1], target))
    torch.testing.assert_close(metrics["q"], values[0].mean())


def test_the_policy_climbs_the_first_q(rng):
    _, state, batch = with_random_targets(td3, rng)
    loss, _ = td3.actor_loss(state, state.policy, batch)
    first, second = q_of(state.networks.critics, batch.obs, torch.tanh(state.policy.net(batch.obs)))
    torch.testing.assert_close(loss, -first.mean())
    assert not torch.allclose(loss, -second.mean())
