"""SAC: its target, the loss of its policy, and its temperature."""

import numpy as np
import pytest
import torch
from torch.nn.functional import cross_entropy

from helpers import (
    CPU,
    ONE_MODE,
    begin_off_policy,
    half_square,
    play,
    q_of,
    slope,
    small_off_policy,
    with_random_targets,
)
from lemniscate.algos import sac
from lemniscate.errors import UserError
from lemniscate.maths import hl_gauss


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


def logits_of(critics, obs, action):
    """The logits of each Q(s, a) of `critics`, by its layers: two tensors [B, 101]."""
    return [q.net(torch.cat([obs, action], dim=-1)) for q in critics.members]


def test_a_q_that_is_a_distribution_learns_the_probabilities_of_the_same_target(rng):
    config, state, batch = with_random_targets(sac, rng, initial_temperature=0.3, value_range=4.0)
    state.networks.bins.moments.copy_(torch.tensor([1.0, 6.25, 100.0]))
    edges = torch.linspace(-10, 10, 102)
    centres = (edges[1:] + edges[:-1]) / 2
    noise = torch.randn(50, 1, generator=rng)
    loss, metrics = sac.critic_loss(config, state, state.networks.critics, batch, noise)
    next_action, log_prob = state.policy(batch.next_obs).sample_with_log_prob(noise)
    both = [logits.softmax(1) @ centres for logits in logits_of(state.targets, batch.next_obs, next_action)]
    target = batch.reward + 0.9 * (torch.min(*both) - 0.3 * log_prob) * (1 - batch.terminated.float())
    logits = logits_of(state.networks.critics, batch.obs, batch.action)
    probabilities = hl_gauss(target.detach(), edges)
    torch.testing.assert_close(loss, sum(cross_entropy(both, probabilities) for both in logits))
    torch.testing.assert_close(metrics["q"], (logits[0].softmax(1) @ centres).mean())
    slopes = torch.autograd.grad(loss, list(state.networks.critics.parameters()))
    assert all(gradient.any() for gradient in slopes)  # both Q learn


def test_bins_follow_the_spread_of_the_returns_and_the_targets_share_them():
    config = small_off_policy(sac, "EndlessLevers-v0", value_range=4.0, gamma=0.5)
    state, env = begin_off_policy(sac, config, "NEXT_STEP", length=None, horizon=4)
    assert all(q.bins is state.networks.bins for q in (*state.targets.members, *state.networks.critics.members))
    counted = []
    for _ in range(5):  # an episode, and in NEXT_STEP a reset row, which pays 100 and does not count
        before = float(state.reward_scale.count)
        play(config, state, env)
        counted.append(float(state.reward_scale.count) - before)
    assert sorted(counted) == [0, 4, 4, 4, 4]
    spread = state.reward_scale.var.sqrt().float()
    assert 0.05 < spread < 1  # returns from 0 to 2
    torch.testing.assert_close(state.networks.bins.edges, torch.linspace(-4, 4, 102) * spread)
    play(config, state, env)
    assert state.reward_scale.running.any()
    state.on_restart(env)
    assert not state.reward_scale.running.any()


@pytest.mark.parametrize("mode", ONE_MODE)
def test_a_q_that_is_a_distribution_has_the_values_of_the_rewards_themselves(mode):
    config = small_off_policy(sac, "EndlessLevers-v0", value_range=20.0)
    state, _ = begin_off_policy(sac, config, mode, length=None, horizon=4)
    for _ in range(700):
        sac.update(config, state)
    assert (state.networks.q(torch.ones(1, 3), torch.zeros(1, 1)) - 10).abs().max() < 0.2


def test_the_weights_of_each_unit_of_q_have_length_one_after_an_update():
    fields = {"value_range": 10.0, "critic_hidden": (8, 8), "network": "layer_norm", "compile": "off"}
    state, _ = begin_off_policy(sac, config := small_off_policy(sac, unit_weights=True, **fields))
    for q in state.targets.members:  # copied before the first update, they have the same length
        assert all((torch.linalg.vector_norm(p, dim=1) - 1).abs().max() < 1e-5 for p in q.parameters() if p.dim() == 2)
    sac.update(config, state)
    lengths = [torch.linalg.vector_norm(p, dim=1) for p in state.networks.critics.parameters() if p.dim() == 2]
    assert [len(each) for each in lengths] == 2 * [8, 8, 101]
    for each in lengths:
        torch.testing.assert_close(each, torch.ones_like(each))
    theirs = [torch.linalg.vector_norm(p, dim=1) for p in state.policy.parameters() if p.dim() == 2]
    assert all((each - 1).abs().max() > 0.1 for each in theirs)  # those of the policy are as they were


@pytest.mark.parametrize(
    "fields", [{"network": "mlp"}, {"value_range": None}, {"critic_hidden": ()}, {"network": "simba"}]
)
def test_weights_of_length_one_need_normalized_layers_and_a_distribution(fields):
    good = {"value_range": 10.0, "network": "layer_norm", "critic_hidden": (8, 8), "hidden": (8, 8)}
    sac.Config(env="Pendulum-v1", unit_weights=True, **good)
    with pytest.raises(UserError, match="unit_weights needs a value_range, network layer_norm and hidden layers"):
        sac.Config(env="Pendulum-v1", unit_weights=True, **{**good, **fields})


def test_a_warm_start_goes_on_with_the_scale_of_the_loaded_bins():
    state, env = begin_off_policy(sac, config := small_off_policy(sac, value_range=4.0))
    fresh = sac.init(config, env.spec, CPU)
    fresh.networks.load_state_dict(state.networks.state_dict())
    fresh.on_warm_start()
    assert state.reward_scale.count > 0
    for name in ("mean", "var", "count"):
        assert torch.equal(getattr(fresh.reward_scale, name), getattr(state.reward_scale, name))
    torch.testing.assert_close(fresh.networks.bins.edges, state.networks.bins.edges)
    fresh.networks.bins.observe(fresh.reward_scale)
    torch.testing.assert_close(fresh.networks.bins.edges, state.networks.bins.edges)


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
