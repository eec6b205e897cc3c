"""PPO on environments whose answers are known."""

import dataclasses

import numpy as np
import pytest
import torch

import environments
from conftest import tiny
from lemniscate.algos import ppo
from lemniscate.data.rollout import collect, minibatches
from lemniscate.envs import toy
from lemniscate.envs.gymnasium import GymnasiumBackend
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError

CPU = torch.device("cpu")
MODES = ["NEXT_STEP", "SAME_STEP", "DISABLED"]


class Endless(toy.Countdown):
    """Reward 1 for ever, truncated every 4 steps, nothing to see: V = 1 / (1 − γ)."""

    def _observe(self):
        return np.ones((self.num_envs, 3), dtype=np.float32)


def learned_value(mode, spoil=lambda rollout: rollout):
    """V(s) after enough updates with γ = 0.9; the truth is 10."""
    config = tiny(hidden=(), learning_rate=0.05, gamma=0.9, epochs=20, normalize_observations=False, max_grad_norm=1e3)
    torch.manual_seed(0)
    env = VecEnv(GymnasiumBackend("Countdown-v0", 4, CPU, mode=mode, length=None, horizon=4))
    env.restart(0)
    state = ppo.init(config, env.spec, CPU)
    for _ in range(25):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        ppo.update(config, state, spoil(rollout))
        state.step = 0  # no annealing
    return state.networks.value(torch.ones(1, 3)).item()


@pytest.mark.parametrize("mode", MODES)
def test_time_outs_bootstrap_and_reset_rows_teach_nothing(monkeypatch, mode):
    monkeypatch.setattr(toy, "Countdown", Endless)
    assert learned_value(mode) == pytest.approx(10.0, abs=0.4)


def test_without_the_bootstrap_the_value_is_wrong(monkeypatch):
    monkeypatch.setattr(toy, "Countdown", Endless)
    death = lambda r: dataclasses.replace(r, terminated=r.truncated)  # noqa: E731
    assert learned_value("DISABLED", death) < 5


def test_with_reset_rows_the_value_is_wrong(monkeypatch):
    monkeypatch.setattr(toy, "Countdown", Endless)
    everything = lambda r: dataclasses.replace(r, valid=torch.ones_like(r.valid))  # noqa: E731
    assert learned_value("NEXT_STEP", everything) > 15


@pytest.mark.parametrize("scaled", [False, True])
def test_rewards_of_any_size_are_learned_from_as_they_are_unless_scaling_is_asked_for(rng, scaled):
    """γ = 0 and λ = 0: the value target is the reward."""
    env = VecEnv(GymnasiumBackend("Countdown-v0", 4, CPU, mode="DISABLED"))
    env.restart(0)
    config = tiny(gamma=0.0, gae_lambda=0.0, scale_rewards=scaled, epochs=1, minibatch_size=32)
    state, seen = ppo.init(config, env.spec, CPU), []
    state.optimizer = lambda batch, parts, rate: seen.append(batch) or {"approx_kl": torch.zeros(())}
    rollout = collect(env, state.policy, 8, state.noise)
    rollout = dataclasses.replace(rollout, reward=100 * torch.randn(8, 4, generator=rng) + 300)
    ppo.update(config, state, rollout)
    expected = rollout.reward / rollout.reward.std(correction=0) if scaled else rollout.reward
    torch.testing.assert_close(seen[0].target, expected.flatten())


@pytest.mark.parametrize("mode", MODES)
def test_it_learns_to_match(mode):
    config = tiny("Matching-v0", num_envs=16, num_steps=16, total_steps=16 * 16 * 25, learning_rate=0.01, epochs=4)
    torch.manual_seed(1)
    env = VecEnv(GymnasiumBackend("Matching-v0", 16, CPU, mode=mode))
    env.restart(0)
    state = ppo.init(config, env.spec, CPU)
    returns = []
    for _ in range(25):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        ppo.update(config, state, rollout)
        returns += env.take_episodes().returns
    assert 7 < np.mean(returns[:16]) < 13  # guessing
    assert np.mean(returns[-16:]) > 19


@pytest.mark.parametrize("kind", environments.KINDS)
def test_it_learns_in_spaces_of_every_kind(kind):
    knobs = {"minibatch_size": 64, "epochs": 6, "learning_rate": 0.01, "initial_log_std": -1.0}
    config = tiny(
        f"Copy-{kind}-v0", num_envs=16, num_steps=16, total_steps=30 * 256, normalize_observations=False, **knobs
    )
    torch.manual_seed(1)
    env = VecEnv(GymnasiumBackend(config.env, 16, CPU))
    env.restart(0)
    state = ppo.init(config, env.spec, CPU)
    means = []
    for _ in range(30):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        ppo.update(config, state, rollout)
        means.append(rollout.reward.mean().item())
        assert rollout.reward.min() > -100  # no action that is masked
    assert means[0] < 0.65
    assert means[-1] > (0.7 if kind == "box" else 0.85)  # σ = 0.37 costs a Gaussian that much


def one_update(**fields):
    config = tiny("Pendulum-v1", **fields)
    torch.manual_seed(0)
    env = VecEnv(GymnasiumBackend("Pendulum-v1", 4, CPU))
    env.restart(0)
    state = ppo.init(config, env.spec, CPU)
    rollout = collect(env, state.policy, config.num_steps, state.noise)
    return config, state, rollout


def test_the_first_ratio_is_one():
    config, state, rollout = one_update(normalize_observations=True)
    batch = ppo.advantages(config, state, rollout)
    _, watched = ppo.loss(config, state.networks, batch)
    assert watched["approx_kl"].abs() < 1e-6
    assert watched["clip_fraction"] == 0


def test_the_first_gradient_step_sees_ratios_of_one_whatever_the_normalizer_learns_from_the_rollout():
    env = VecEnv(GymnasiumBackend("Pendulum-v1", 4, CPU))
    env.restart(0)
    config = tiny("Pendulum-v1", epochs=1, minibatch_size=32)
    state = ppo.init(config, env.spec, CPU)
    for _ in range(2):
        seen = ppo.update(config, state, collect(env, state.policy, 8, state.noise))
        assert seen["approx_kl"].item() == pytest.approx(0, abs=1e-9)


def test_the_loss_is_equation_9():
    config, state, rollout = one_update(entropy_coef=0.1, value_coef=0.7, normalize_advantage=False)
    batch = ppo.advantages(config, state, rollout)
    total, parts = ppo.loss(config, state.networks, batch)
    expected = parts["losses/policy"] + 0.7 * parts["losses/value"] - 0.1 * parts["losses/entropy"]
    torch.testing.assert_close(total.detach(), expected)


def test_the_value_clip_is_passed_on():
    config, state, rollout = one_update(clip_value=1e-3)
    batch = ppo.advantages(config, state, rollout)
    shifted = dataclasses.replace(batch, value=batch.value + 1)
    _, plain = ppo.loss(config.replace(clip_value=None), state.networks, shifted)
    _, clipped = ppo.loss(config, state.networks, shifted)
    assert plain["losses/value"] != clipped["losses/value"]


def test_target_kl_stops_the_epochs():
    many = {"epochs": 30, "learning_rate": 0.05}
    config, state, rollout = one_update(**many)
    ppo.update(config, state, rollout)
    without = state.optimizer.steps
    config, state, rollout = one_update(**many, target_kl=0.01)
    ppo.update(config, state, rollout)
    assert state.optimizer.steps < without == 60


def test_the_learning_rate_adapts_to_the_kl():
    config, state, rollout = one_update(desired_kl=1e-9, epochs=2)
    ppo.update(config, state, rollout)
    assert state.learning_rate == pytest.approx(config.learning_rate / 1.5**2)


def test_advantages_are_estimated_anew_before_each_epoch(monkeypatch):
    seen = []
    original = ppo.advantages
    monkeypatch.setattr(ppo, "advantages", lambda *given: seen.append(original(*given)) or seen[-1])
    config, state, rollout = one_update(recompute_advantages=True, epochs=3)
    ppo.update(config, state, rollout)
    assert len(seen) == 3
    assert not torch.equal(seen[0].value, seen[1].value)


def test_the_normalizer_moves_in_training_only_and_sees_only_real_rows():
    config, state, rollout = one_update(normalize_observations=True)
    ppo.advantages(config, state, rollout)
    assert state.policy.normalizer.count == 0
    ppo.update(config, state, rollout)
    assert state.policy.normalizer.count == rollout.valid.sum()


def test_a_rollout_in_which_nothing_was_played_is_a_sentence(rng):
    with pytest.raises(UserError, match="take more num_steps"):
        minibatches(torch.arange(0), 4, 2, rng)


def test_minibatches_cover_everything_once_an_epoch(rng):
    first, second = (minibatches(torch.arange(24), 24, 6, rng) for _ in range(2))
    for parts in (first, second):
        assert parts.shape == (4, 6)
        assert parts.flatten().sort().values.tolist() == list(range(24))
    assert not torch.equal(first[0], second[0])


@pytest.mark.parametrize(
    ("played", "collected", "size", "shape"), [(5, 12, 4, (3, 4)), (12, 12, 5, (3, 5)), (3, 8, 9, (1, 8))]
)
def test_minibatches_have_one_shape_whatever_was_played(rng, played, collected, size, shape):
    rows = torch.arange(played) * 7
    parts = minibatches(rows, collected, size, rng)
    assert parts.shape == shape
    times = torch.bincount(parts.flatten(), minlength=played * 7)[rows]
    assert times.sum() == parts.numel()
    assert times.min() >= 1
    assert times.max() - times.min() <= 1


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"minibatch_size": 1}, "normalize_advantage needs"),
        ({"gamma": 1.5}, "gamma must be a number from 0 to 1, not 1.5"),
        ({"clip": 0.0}, "clip must be a number above 0"),
        ({"num_envs": 0}, "num_envs must be a whole number at least 1"),
        ({"epochs": 2.5}, "epochs must be a whole number"),
        ({"learning_rate": float("nan")}, "learning_rate must be"),
        ({"activation": "foo"}, "activation must be one of"),
        ({"hidden": 64}, "hidden must be several numbers"),
        ({"hidden": (64, 0)}, "hidden must be a whole number at least 1"),
        ({"learning_rate": float("inf")}, "learning_rate must be"),
        ({"initial_log_std": float("nan")}, "initial_log_std must be"),
        ({"seed": 2**32}, "seed must be a whole number from 0 to"),
        ({"device": "tpu"}, "device must be one of"),
    ],
)
def test_a_value_out_of_range_is_named(fields, said):
    with pytest.raises(UserError, match=said):
        tiny(**fields)


def test_a_config_survives_json():
    config = tiny(target_kl=0.02, minibatch_size=8, hidden=(8, 8))
    assert ppo.Config.from_json(config.to_json()) == config
