"""TRPO: the bound on the KL, the line search, the natural gradient, damping."""

import copy
import dataclasses

import pytest
import torch
from torch import nn

import lemniscate as lem
from helpers import begin, copy_of, equal, one_rollout, small
from lemniscate.algos import reinforce, trpo
from lemniscate.data.rollout import collect
from lemniscate.errors import UserError


@pytest.mark.parametrize("env", ["Pendulum-v1", "Matching-v0"])
@pytest.mark.parametrize("max_kl", [1e-4, 0.01, 0.3])
@pytest.mark.one_in(2)
def test_the_kl_stays_within_its_bound_at_every_update(env, max_kl):
    """Of continuous and of discrete actions; a sixth of Matching's rows are resets, which no mean counts."""
    config = small(trpo, env, max_kl=max_kl, num_steps=32, critic_epochs=1, normalize_observations=False)
    state, env = begin(trpo, config, "NEXT_STEP")
    moved = 0
    for _ in range(10):
        rollout = collect(env, state.policy, config.num_steps, state.rng.action)
        obs, before = rollout.obs[rollout.valid], copy.deepcopy(state.policy)
        metrics = trpo.update(config, state, rollout)
        with torch.no_grad():
            kl = before(obs).kl(state.policy(obs)).mean().item()
        assert kl == pytest.approx(metrics["kl"].item(), rel=1e-3, abs=1e-7)
        assert kl <= max_kl
        assert (kl > 0) == (metrics["step_fraction"] > 0)
        moved += kl > 0.2 * max_kl
    assert moved >= 8


def test_an_update_lowers_the_surrogate_loss():
    config, state, rollout = one_rollout(trpo, num_steps=32)
    batch = trpo.advantages(config, state.networks, rollout)
    metrics = trpo.improve(config, state, batch, batch.obs)
    assert metrics["step_fraction"] > 0
    assert metrics["losses/policy"] < 0  # it is 0 at the start: standardized advantages


def stepped(config, state, batch, start, fisher_obs=None):
    """The parameters of the policy after one step from `start`."""
    state.parameters.vector.copy_(start)
    trpo.improve(config, state, batch, batch.obs if fisher_obs is None else fisher_obs)
    return state.parameters.vector.clone()


def too_long(**fields):
    """Config, state, batch, and observations at which the Fisher matrix is too small, so that steps are too long."""
    fields = {"num_steps": 64, "shrink": 0.5, "damping": 1e-3, "max_kl": 1e-4, "hidden": (), **fields}
    config, state, rollout = one_rollout(trpo, normalize_observations=False, **fields)
    batch = trpo.advantages(config, state.networks, rollout)
    return config, state, batch, batch.obs / 50


@pytest.mark.parametrize("attempts", [2, 20])
def test_a_step_that_is_too_long_is_shortened_until_the_kl_is_within_its_bound(attempts):
    """Or not taken, if that takes more attempts than there are."""
    config, state, batch, fisher_obs = too_long(attempts=attempts)
    start = state.parameters.vector.clone()
    whole = stepped(config.replace(line_search=False), state, batch, start, fisher_obs) - start
    pi = state.parameters.at
    with torch.no_grad():
        kl = [pi(start, batch.obs).kl(pi(start + 0.5**j * whole, batch.obs)).mean().item() for j in range(20)]
    first = next(j for j in range(20) if kl[j] <= 1e-4)
    assert 2 < first < 10
    state.parameters.vector.copy_(start)
    fraction = trpo.improve(config, state, batch, fisher_obs)["step_fraction"]
    assert fraction == (0.5**first if first < attempts else 0)


def test_a_step_that_is_not_taken_leaves_the_policy_bit_for_bit():
    config, state, batch, fisher_obs = too_long(attempts=1)
    before = copy_of(state.policy.parameters())
    assert trpo.improve(config, state, batch, fisher_obs)["step_fraction"] == 0
    assert all(equal(before, state.policy.parameters()))


def test_without_the_line_search_it_is_the_natural_policy_gradient():
    """The whole step is taken, whatever comes of it; its KL is δ to second order."""
    fields = {"line_search": False, "damping": 1e-3, "cg_iterations": 30, "max_kl": 1e-4, "hidden": (4,)}
    config, state, rollout = one_rollout(trpo, num_steps=64, **fields)
    batch, before = trpo.advantages(config, state.networks, rollout), state.parameters.vector.clone()
    metrics = trpo.improve(config, state, batch, batch.obs)
    assert metrics["step_fraction"] == 1
    assert metrics["kl"].item() == pytest.approx(1e-4, rel=0.2)
    uphill = dataclasses.replace(batch, advantage=-batch.advantage)
    there = before + (before - stepped(config, state, uphill, before))
    torch.testing.assert_close(there, stepped(config, state, batch, before), rtol=1e-2, atol=1e-4)


def test_damping_shortens_the_step():
    """With very much of it the step is √(2δ / c) along the gradient, whatever the Fisher matrix says."""
    config, state, rollout = one_rollout(trpo, num_steps=64, line_search=False, damping=1e4, max_kl=1e-2)
    batch, start = trpo.advantages(config, state.networks, rollout), state.parameters.vector.clone()
    step = stepped(config, state, batch, start) - start
    assert step.norm().item() == pytest.approx((2 * 1e-2 / 1e4) ** 0.5, rel=1e-2)


def test_the_steps_of_policy_and_value_leave_each_other_alone():
    config, state, rollout = one_rollout(trpo)
    assert len(state.parameters.vector) == sum(p.numel() for p in state.policy.parameters())
    batch = trpo.advantages(config, state.networks, rollout)
    value = copy_of(state.networks.value.parameters())
    trpo.improve(config, state, batch, batch.obs)
    assert all(equal(value, state.networks.value.parameters()))
    policy = copy_of(state.policy.parameters())
    state.critic_optimizer.learning_rate = 0.1
    trpo.learn(config, state, batch, torch.arange(32)[None])
    assert all(equal(policy, state.policy.parameters()))
    assert not all(equal(value, state.networks.value.parameters()))


@pytest.mark.parametrize("standardized", [False, True])
def test_advantages_are_standardized_only_on_request(standardized):
    """Then their scale and shift change nothing."""
    config, state, rollout = one_rollout(trpo, normalize_advantage=standardized)
    batch = trpo.advantages(config, state.networks, rollout)
    other = dataclasses.replace(batch, advantage=3 * batch.advantage + 5)
    start = state.parameters.vector.clone()
    a, b = (stepped(config, state, x, start) - start for x in (batch, other))
    assert torch.allclose(a, b, rtol=1e-3, atol=1e-5) == standardized


@pytest.mark.parametrize("algo", [trpo, reinforce])
def test_minibatches_of_the_value_have_no_more_rows_than_the_rollout(algo):
    fields = {"num_envs": 4, "num_steps": 8, **({"episodes": 0, "baseline": "value"} if algo is reinforce else {})}
    algo.Config(**fields, critic_minibatch_size=32)
    with pytest.raises(UserError, match="critic_minibatch_size 33 is above the 32 rows of a rollout"):
        algo.Config(**fields, critic_minibatch_size=33)


class Backward(nn.Module):
    """A layer whose derivative torch has in one mode only."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.layer = nn.utils.parametrizations.weight_norm(nn.Linear(inputs, outputs))

    def forward(self, x):
        return self.layer(x)


def test_a_layer_without_a_derivative_in_forward_mode_gets_a_sentence(tmp_path):
    with pytest.raises(UserError, match=r"has no derivative in forward mode, which trpo takes .*; ppo learns with it"):
        lem.train("trpo", "CartPole-v1", network=Backward, run=tmp_path / "r", total_steps=256, progress=False)
