"""REINFORCE: returns and baselines as weights, whole episodes, the entropy bonus."""

import dataclasses

import numpy as np
import pytest
import torch

from helpers import MODES, ONE_MODE, begin, learned_with, one_rollout, slope, small
from lemniscate.algos import reinforce
from lemniscate.data.rollout import collect_episodes, epoch_minibatches
from lemniscate.errors import UserError


def weighted(mode="DISABLED", **fields):
    """The steps within their episodes and the weights of log π, of two whole episodes in each of 3 environments of
    Countdown (rewards 1, five steps); the state; and the batch.
    """
    config = small(reinforce, num_envs=3, episodes=2, gamma=0.9, **fields)
    state, env = begin(reinforce, config, mode, length=5)
    rollout = collect_episodes(env, state.policy, 2, state.rng.action)
    batch = reinforce.weights(config, state.networks, rollout)[rollout.valid_rows]
    return batch.obs[:, 2].long(), batch.advantage, state, batch


@pytest.mark.parametrize("mode", MODES)
def test_the_weight_is_the_reward_to_go_or_the_return_of_the_episode_less_a_baseline(mode):
    to_go = torch.tensor([(1 - 0.9**k) / 0.1 for k in (5, 4, 3, 2, 1)])
    t, weight, _, _ = weighted(mode, baseline="none")
    torch.testing.assert_close(weight, to_go[t])
    _, weight, _, _ = weighted(mode, baseline="none", returns="episode")
    torch.testing.assert_close(weight, to_go[:1].expand(30))
    t, weight, _, _ = weighted(mode, baseline="mean")
    torch.testing.assert_close(weight, to_go[t] - to_go.mean())
    t, weight, state, batch = weighted(mode, baseline="value")
    torch.testing.assert_close(weight, to_go[t] - state.networks.value(batch.obs).detach())


def test_a_baseline_keeps_the_mean_of_the_gradient_and_lowers_its_variance():
    """The same 100 rollouts weighted in three ways: differences of means within four standard errors."""
    fields = {"num_envs": 16, "episodes": 1, "gamma": 0.9, "standardize": False}
    configs = {kind: small(reinforce, "Matching-v0", baseline=kind, **fields) for kind in ("none", "mean", "value")}
    state, env = begin(reinforce, configs["value"])
    draw = lambda: collect_episodes(env, state.policy, 1, state.rng.action)  # noqa: E731
    state.critic_optimizer.learning_rate = 0.01
    for _ in range(20):  # V learns what a guess is worth
        rollout = draw()
        batch, rows = reinforce.weights(configs["value"], state.networks, rollout), rollout.valid_rows
        minibatches = epoch_minibatches(rows, len(rows), 16, state.rng.minibatch)
        reinforce.learn(configs["value"], state, batch, minibatches, update_policy=False)
    gradients = {kind: [] for kind in configs}
    for _ in range(100):
        rollout = draw()
        for kind, config in configs.items():
            batch = reinforce.weights(config, state.networks, rollout)[rollout.valid_rows]
            gradients[kind].append(slope(reinforce.policy_loss(config, state.policy, batch)[0], state.policy))
    none, *others = (torch.stack(gradient) for gradient in gradients.values())
    assert (none.mean(0).abs() > 4 * none.std(0) / 100**0.5).any()
    for other in others:
        apart = none - other
        assert (apart.mean(0).abs() <= 4 * apart.std(0) / 100**0.5 + 1e-6).all()
        assert other.var(0).sum() < 0.5 * none.var(0).sum()


def test_a_batch_of_one_row_changes_nothing():
    config = small(reinforce, num_envs=1, episodes=1)
    state, env = begin(reinforce, config, length=1)
    rollout = collect_episodes(env, state.policy, 1, state.rng.action)
    assert rollout.valid.sum() == 1
    assert reinforce.update(config, state, rollout)["losses/policy"] == 0


@pytest.mark.parametrize("mode", ONE_MODE)
@pytest.mark.parametrize("baseline", ["none", "mean", "value"])
def test_learns_from_whole_episodes(mode, baseline):
    fields = {"num_envs": 8, "episodes": 1, "learning_rate": 0.03, "baseline": baseline, "standardize": False}
    config = small(reinforce, "Matching-v0", **fields)
    state, env = begin(reinforce, config, mode)
    returns = []
    for _ in range(40):
        rollout = collect_episodes(env, state.policy, config.episodes, state.rng.action)
        reinforce.update(config, state, rollout)
        returns += env.take_episodes().returns
    assert np.mean(returns[-16:]) > np.mean(returns[:16]) + 5


@pytest.mark.parametrize(
    "fields",
    [{"baseline": "none"}, {"baseline": "mean"}, {"returns": "episode"}, {"returns": "episode", "baseline": "none"}],
)
def test_rollouts_of_fixed_length_need_a_value_to_bootstrap_from(fields):
    with pytest.raises(UserError, match=r"need whole episodes, which num_steps cuts: use episodes 1 or more"):
        small(reinforce, **fields)


def test_batches_of_different_sizes_are_not_compiled():
    with pytest.raises(UserError, match="cannot be compiled"):
        small(reinforce, episodes=2, compile="on")
    assert small(reinforce, episodes=2, total_steps=10**9).gradient_steps == 0


@pytest.mark.parametrize("standardized", [False, True])
def test_weights_are_standardized_only_on_request(standardized):
    config, state, rollout = one_rollout(reinforce, standardize=standardized)
    (weight,) = learned_with(reinforce, config, state, rollout)
    assert (abs(weight.mean()) < 1e-6) == standardized
    assert (abs(weight.std() - 1) < 1e-6) == standardized


def test_the_entropy_bonus_rewards_entropy():
    config, state, rollout = one_rollout(reinforce)
    batch = reinforce.weights(config, state.networks, rollout)
    plain = slope(reinforce.policy_loss(config, state.policy, batch)[0], state.policy)
    rewarded = dataclasses.replace(config, entropy_coef=0.3)
    with_bonus = slope(reinforce.policy_loss(rewarded, state.policy, batch)[0], state.policy)
    entropy = slope(state.policy(batch.obs).entropy().mean(), state.policy)
    torch.testing.assert_close(with_bonus, plain - 0.3 * entropy)
    assert entropy.norm() > 0
