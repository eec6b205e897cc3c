"""PPO: ratios, the loss, value clipping, epochs and their KL, the learning rate, the advantages of each epoch."""

import dataclasses

import numpy as np
import pytest
import torch

from conftest import tiny
from helpers import CPU, MODES, vectorize
from lemniscate.algos import ppo
from lemniscate.data.rollout import collect
from lemniscate.errors import UserError


@pytest.mark.parametrize(
    "mode", [mode if mode == "SAME_STEP" else pytest.param(mode, marks=pytest.mark.long) for mode in MODES]
)
def test_learns_to_match(mode):
    size = {"num_envs": 16, "num_steps": 16, "total_steps": 16 * 16 * 25, "epochs": 4}
    config = tiny("Matching-v0", **size, learning_rate=0.01, desired_kl=None)
    torch.manual_seed(1)
    env = vectorize("Matching-v0", 16, mode=mode)
    state = ppo.init(config, env.spec, CPU)
    returns = []
    for _ in range(25):
        rollout = collect(env, state.policy, config.num_steps, state.rng.action)
        ppo.update(config, state, rollout)
        returns += env.take_episodes().returns
    assert 7 < np.mean(returns[:16]) < 13  # guessing
    assert np.mean(returns[-16:]) > 19


def one_rollout(**fields):
    config = tiny("Pendulum-v1", **fields)
    torch.manual_seed(0)
    env = vectorize("Pendulum-v1")
    state = ppo.init(config, env.spec, CPU)
    return config, state, collect(env, state.policy, config.num_steps, state.rng.action)


def test_the_first_ratio_is_one():
    config, state, rollout = one_rollout(normalize_observations=True)
    batch = ppo.advantages(config, state.networks, rollout)
    _, metrics = ppo.loss(config, state.networks, batch)
    assert metrics["approx_kl"].abs() < 1e-6
    assert metrics["clip_fraction"] == 0


def test_the_first_gradient_step_of_every_update_has_ratios_of_one():
    """Whatever the normalizer learns from the rollouts."""
    env = vectorize("Pendulum-v1")
    config = tiny("Pendulum-v1", epochs=1, minibatch_size=32)
    state = ppo.init(config, env.spec, CPU)
    for _ in range(2):
        metrics = ppo.update(config, state, collect(env, state.policy, 8, state.rng.action))
        assert metrics["approx_kl"].item() == pytest.approx(0, abs=1e-9)


def test_the_loss_is_equation_9():
    config, state, rollout = one_rollout(entropy_coef=0.1, value_coef=0.7, normalize_advantage=False)
    batch = ppo.advantages(config, state.networks, rollout)
    total, parts = ppo.loss(config, state.networks, batch)
    expected = parts["losses/policy"] + 0.7 * parts["losses/value"] - 0.1 * parts["losses/entropy"]
    torch.testing.assert_close(total.detach(), expected)


def test_the_clip_of_the_value_is_a_setting():
    config, state, rollout = one_rollout(clip_value=1e-3)
    batch = ppo.advantages(config, state.networks, rollout)
    shifted = dataclasses.replace(batch, value=batch.value + 1)
    _, plain = ppo.loss(config.replace(clip_value=None), state.networks, shifted)
    _, clipped = ppo.loss(config, state.networks, shifted)
    assert plain["losses/value"] != clipped["losses/value"]


def test_target_kl_ends_the_epochs():
    many = {"epochs": 30, "learning_rate": 0.05, "desired_kl": None}
    config, state, rollout = one_rollout(**many)
    ppo.update(config, state, rollout)
    without = state.optimizer.steps
    config, state, rollout = one_rollout(**many, target_kl=0.01)
    ppo.update(config, state, rollout)
    assert state.optimizer.steps < without == 60


def test_the_learning_rate_adapts_to_the_kl():
    config, state, rollout = one_rollout(desired_kl=1e-9, epochs=2)
    ppo.update(config, state, rollout)
    assert state.learning_rate == pytest.approx(config.learning_rate / 1.5**2)
    assert state.optimizer.learning_rate == pytest.approx(config.learning_rate / 1.5)  # of the last epoch


@pytest.mark.parametrize("recomputed", [False, True])
def test_advantages_are_estimated_again_before_each_epoch_on_request(recomputed):
    """With the newest value, but the probabilities under which the actions were drawn."""
    config, state, rollout = one_rollout(recompute_advantages=recomputed, epochs=3, learning_rate=0.01)
    batches = []

    def record(config, state, batch, minibatches, advantage):
        batches.append(batch)
        return ppo.learn(config, state, batch, minibatches, advantage)

    state.learn = record
    drawn_with = state.networks.log_prob(rollout.obs, rollout.action).flatten()
    ppo.update(config, state, rollout)
    assert len(batches) == 3
    assert torch.equal(batches[0].value, batches[1].value) != recomputed
    assert torch.equal(batches[1].advantage, batches[2].advantage) != recomputed
    assert all(torch.equal(batch.log_prob, drawn_with) for batch in batches)
    assert not torch.equal(state.networks.log_prob(rollout.obs, rollout.action).flatten(), drawn_with)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"minibatch_size": 1}, "normalize_advantage needs"),
        (
            {"minibatch_size": 2049},
            "minibatch_size 2,049 is above the 32 rows of a rollout, num_envs 4 times num_steps 8",
        ),
        ({"gamma": 1.5}, "gamma must be a number from 0 to 1, not 1.5"),
        ({"clip": 0.0}, "clip must be a number above 0"),
        ({"num_envs": 0}, "num_envs must be a whole number from 1 to 1,000,000"),
        ({"epochs": 2.5}, "epochs must be a whole number"),
        ({"learning_rate": float("nan")}, "learning_rate must be"),
        ({"activation": "foo"}, "activation must be one of"),
        ({"hidden": 64}, "hidden must be several numbers"),
        ({"hidden": (64, 0)}, "hidden must be a whole number from 1 to 1,000,000"),
        ({"learning_rate": float("inf")}, "learning_rate must be"),
        ({"initial_log_std": float("nan")}, "initial_log_std must be"),
        ({"seed": 2**32}, "seed must be a whole number from 0 to"),
        ({"device": "tpu"}, "device must be one of"),
    ],
)
def test_a_value_out_of_range_is_named(fields, message):
    with pytest.raises(UserError, match=message):
        tiny(**fields)


def test_a_config_survives_json():
    config = tiny(target_kl=0.02, minibatch_size=8, hidden=(8, 8))
    assert ppo.Config.from_json(config.to_json()) == config


def test_the_kl_that_the_learning_rate_follows_may_have_a_schedule():
    """At the beginning every KL is too large for it, at the end every one too small."""
    rates = []
    for progress in (0, 0.999):
        config, state, rollout = one_rollout(desired_kl="1e-12>1e6", epochs=2)
        state.step = int(progress * config.total_steps)
        before = state.learning_rate
        ppo.update(config, state, rollout)
        rates.append(state.learning_rate / before)
    assert rates[0] < 1 < rates[1]
