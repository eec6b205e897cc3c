"""A2C: the one-step actor-critic, PPO's gradient at ratio 1, standardized advantages, clipped gradients."""

import pytest
import torch

from helpers import begin, copy_of, learned_with, one_rollout, slope, small
from lemniscate.algos import a2c, ppo


def test_with_one_step_it_is_the_one_step_actor_critic():
    """r + γ V(s') − V(s) weights log π, and its square is the critic's loss; one step of Adam; whatever λ."""
    fields = {"normalize_observations": False, "normalize_advantage": False, "scale_rewards": False}
    config, state, rollout = one_rollout(a2c, num_steps=1, gae_lambda=0.7, value_coef=0.5, max_grad_norm=None, **fields)
    twin = config.networks(begin(a2c, config)[1].spec)
    twin.load_state_dict(state.networks.state_dict())
    optimizer = torch.optim.Adam(twin.parameters(), lr=config.learning_rate, eps=config.adam_eps)
    obs, action, reward, next_obs = (x[0] for x in (rollout.obs, rollout.action, rollout.reward, rollout.next_obs))
    with torch.no_grad():
        target = reward + config.gamma * twin.value(next_obs) * ~rollout.terminated[0]
    error = target - twin.value(obs)
    loss = -(twin.policy(obs).log_prob(action) * error.detach()).mean() + 0.5 * 0.5 * error.square().mean()
    loss.backward()
    optimizer.step()
    a2c.update(config, state, rollout)
    for ours, theirs in zip(state.networks.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


def test_at_ratio_1_it_has_the_gradient_of_ppo():
    shared = {"gae_lambda": 0.9, "normalize_advantage": False, "value_coef": 0.4, "entropy_coef": 0.01}
    config, state, rollout = one_rollout(a2c, **shared)
    batch = ppo.advantages(config, state.networks, rollout)
    configs = ((a2c, config), (ppo, small(ppo, "Pendulum-v1", **{**shared, "minibatch_size": 32})))
    gradients = [slope(algo.loss(its, state.networks, batch)[0], state.networks) for algo, its in configs]
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6)
    assert gradients[0].norm() > 0


@pytest.mark.parametrize("standardized", [False, True])
def test_advantages_are_standardized_only_on_request(standardized):
    config, state, rollout = one_rollout(a2c, normalize_advantage=standardized)
    (advantage,) = learned_with(a2c, config, state, rollout)
    assert (abs(advantage.mean()) < 1e-6) == standardized
    assert (abs(advantage.std() - 1) < 1e-6) == standardized


def test_the_gradient_is_clipped():
    """Adam forgets the length of a gradient, but for its ε: far below that, nothing moves."""
    config, state, rollout = one_rollout(a2c, max_grad_norm=1e-12)
    before = copy_of(state.networks.parameters())
    a2c.update(config, state, rollout)
    for old, new in zip(before, state.networks.parameters(), strict=True):
        torch.testing.assert_close(old, new, rtol=0, atol=1e-8)
