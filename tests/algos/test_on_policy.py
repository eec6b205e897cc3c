"""REINFORCE, A2C, TRPO and PPO alike, on environments with known values."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
import torch
from torch import nn

import environments
import lemniscate as lem
from helpers import (
    COMPILERS,
    ONE_MODE,
    CompiledCalls,
    begin,
    copy_of,
    equal,
    one_rollout,
    require_in_own_process,
    small,
)
from lemniscate.algos import a2c, ppo, reinforce, reppo, trpo
from lemniscate.data.rollout import collect
from lemniscate.errors import UserError
from lemniscate.optim.adam import Adam
from lemniscate.optim.compiled import Compiler
from lemniscate.system.world import ALONE

ALGORITHMS = {"reinforce": reinforce, "a2c": a2c, "trpo": trpo, "ppo": ppo}
EACH = pytest.mark.parametrize("algo", ALGORITHMS.values(), ids=ALGORITHMS)
FAST = {
    reinforce: {"learning_rate": 0.02, "critic_learning_rate": 0.01},
    a2c: {"learning_rate": 0.02, "value_coef": 0.1},
    trpo: {"max_kl": 0.05, "critic_learning_rate": 0.01, "critic_epochs": 10},
    ppo: {"learning_rate": 0.01, "epochs": 6, "minibatch_size": 64, "desired_kl": None},
}
"""settings that learn a small environment in a moment"""


def learned_value(algo, mode, spoil=lambda rollout: rollout):
    """V(s) after enough updates with γ = 0.9; the truth is 10."""
    plain = {"hidden": (), "gamma": 0.9, "normalize_observations": False, "scale_rewards": False}
    of = {
        reinforce: {"critic_learning_rate": 0.1, "critic_minibatch_size": 16},
        a2c: {"learning_rate": 0.1, "final_learning_rate": 1.0, "max_grad_norm": None, "value_coef": 1.0},
        trpo: {"critic_learning_rate": 0.1, "critic_minibatch_size": 16, "critic_epochs": 10},
        ppo: {"learning_rate": 0.05, "desired_kl": None, "final_learning_rate": 1.0, "max_grad_norm": 1e3, "epochs": 20}
        | {"value_coef": 0.5, "recompute_advantages": False},
    }
    config = small(algo, "Endless-v0", **plain, **of[algo])
    state, env = begin(algo, config, mode, length=None, horizon=4)
    for _ in range({a2c: 200, ppo: 25}.get(algo, 40)):
        rollout = collect(env, state.policy, config.num_steps, state.rng.action)
        algo.update(config, state, spoil(rollout))
    return state.networks.value(torch.ones(1, 3)).item()


@EACH
@pytest.mark.parametrize("mode", ONE_MODE)
def test_values_are_bootstrapped_at_time_limits_and_ignore_reset_rows(algo, mode):
    assert learned_value(algo, mode) == pytest.approx(10.0, abs=0.4 if algo is ppo else 0.5)


@EACH
def test_without_the_bootstrap_the_value_is_wrong(algo):
    ends = lambda r: dataclasses.replace(r, terminated=r.truncated)  # noqa: E731
    assert learned_value(algo, "DISABLED", ends) < (5 if algo is ppo else 6)


@EACH
def test_with_reset_rows_the_value_is_wrong(algo):
    everything = lambda r: dataclasses.replace(r, valid=torch.ones_like(r.valid))  # noqa: E731
    assert learned_value(algo, "NEXT_STEP", everything) > 15


@pytest.mark.parametrize(
    ("algo", "kind"),
    [
        pytest.param(algo, kind, marks=() if name == "ppo" or (kind == "box" and name != "trpo") else pytest.mark.long)
        for name, algo in ALGORITHMS.items()
        for kind in environments.KINDS
    ],
)
@pytest.mark.one_in(4)
def test_learns_in_spaces_of_every_kind(algo, kind):
    size = {"num_envs": 16, "num_steps": 16, "initial_log_std": -1.0, "normalize_observations": False}
    size |= {"total_steps": 30 * 256} if algo is ppo else {}
    config = small(algo, f"Copy-{kind}-v0", **{**size, **FAST[algo]})
    state, env = begin(algo, config)
    means = []
    for _ in range({trpo: 40, ppo: 30}.get(algo, 80)):
        rollout = collect(env, state.policy, config.num_steps, state.rng.action)
        algo.update(config, state, rollout)
        means.append(rollout.reward.mean().item())
        assert rollout.reward.min() > -100  # no action that is masked
    assert means[0] < 0.65
    # σ = 0.37 costs a Gaussian policy that much
    if algo is ppo:
        assert means[-1] > (0.7 if kind == "box" else 0.85)
    assert np.mean(means[-5:]) > (0.65 if kind == "box" else 0.85)


@EACH
def test_the_normalizer_moves_after_the_update_and_sees_valid_rows_only(algo):
    config = small(algo)
    state, env = begin(algo, config, "NEXT_STEP", length=3)
    rollout = collect(env, state.policy, 8, state.rng.action)
    assert not rollout.valid.all()
    state.networks.estimates(rollout.obs, rollout.next_obs)
    assert state.policy.normalizer.count == 0
    algo.update(config, state, rollout)
    assert state.policy.normalizer.count == rollout.valid.sum()


@EACH
@pytest.mark.parametrize("scaled", [False, True])
def test_rewards_of_any_size_are_scaled_only_on_request(algo, rng, scaled):
    """γ = 0 and λ = 0: the value target is the reward."""
    fields = {"gae_lambda": 0.0} if algo is not reinforce else {}
    config, state, rollout = one_rollout(algo, gamma=0.0, scale_rewards=scaled, **fields)
    batches = []

    def record(config, state, batch, minibatches, *_, **__):
        batches.append(batch)
        return [{"approx_kl": torch.zeros(()), "losses/value": torch.zeros(())}]

    state.learn = record
    rollout = dataclasses.replace(rollout, reward=100 * torch.randn(8, 4, generator=rng) + 300)
    algo.update(config, state, rollout)
    expected = rollout.reward / rollout.reward.std(correction=0) if scaled else rollout.reward
    torch.testing.assert_close(batches[0].target, expected.flatten())


@pytest.mark.parametrize(
    ("algorithm", "env", "fields"),
    [
        ("a2c", "CartPole-v1", {}),
        ("ppo", "CartPole-v1", {"epochs": 3, "minibatch_size": 20}),
        ("pqn", "CartPole-v1", {"epochs": 2, "minibatch_size": 16}),
        ("reppo", "Pendulum-v1", {"epochs": 2, "minibatch_size": 20}),
    ],
)
def test_as_many_gradient_steps_are_taken_as_the_config_says(tmp_path, monkeypatch, algorithm, env, fields):
    fields = {"num_envs": 4, "num_steps": 8, "total_steps": 100, **fields}  # 4 rollouts of 32 rows
    taken, step = Counter[Adam](), Adam.step

    def counted(self, *args):
        taken[self] += 1
        return step(self, *args)

    monkeypatch.setattr(Adam, "step", counted)
    lem.train(algorithm, env, run=tmp_path / "r", progress=False, evaluate_episodes=1, **fields)
    assert set(taken.values()) == {lem.config_for(algorithm, env, **fields).gradient_steps}


@EACH
def test_learning_rates_fall_to_zero_where_the_settings_say_so(algo):
    """The networks that a falling learning rate moves stay as they are at the end of the run, and only there."""
    field = "final_critic_learning_rate" if algo is trpo else "final_learning_rate"
    fields = {"desired_kl": None} if algo is ppo else {}
    config, state, rollout = one_rollout(algo, **{field: 0.0}, **fields)
    first = config.critic_learning_rate if algo is trpo else config.learning_rate
    part = {reinforce: state.networks.policy, trpo: state.networks.value}.get(algo, state.networks)
    for step, moves in ((0, True), (config.total_steps // 2, True), (config.total_steps, False)):
        state.step, before = step, copy_of(part.parameters())
        rate = algo.update(config, state, rollout)["learning_rate"]
        assert rate == pytest.approx((1 - step / config.total_steps) * first)
        assert moves != all(equal(before, part.parameters()))


@EACH
def test_a_schedule_is_linear_in_steps_from_its_first_number_to_its_last(algo):
    """At each step of the run an update is that of the number there, for all fields that may have a schedule."""
    ends = {"critic_learning_rate": (0.1, 0.02)} if algo in (trpo, reinforce) else {}
    ends |= {"learning_rate": (0.1, 0.02)} if algo is not trpo else {}
    ends |= {"entropy_coef": (0.5, 0.1)} if algo in (ppo, a2c, reinforce) else {}
    ends |= {"clip": (0.2, 0.01), "clip_value": (0.2, 0.01)} if algo is ppo else {}
    free = {"desired_kl": None} if algo is ppo else {}
    config, _, rollout = one_rollout(algo, **{name: f"{a}>{b}" for name, (a, b) in ends.items()}, **free)
    final = "final_critic_learning_rate" if algo is trpo else "final_learning_rate"
    for step in (0, config.total_steps // 4, config.total_steps):
        numbers = {name: a + (b - a) * step / config.total_steps for name, (a, b) in ends.items()}
        moved = []
        for settings in (config, config.replace(**numbers, **{final: 1.0})):
            state, _ = begin(algo, settings)
            state.step = step
            algo.update(settings, state, rollout)
            moved.append(state.networks.parameters())
        for p, q in zip(*moved, strict=True):
            torch.testing.assert_close(p, q)


@EACH
def test_a_single_row_has_no_standard_deviation(algo):
    with pytest.raises(UserError, match=r"(standardize|normalize_advantage) needs batches of 2 rows"):
        small(
            algo,
            num_envs=1,
            num_steps=1,
            **({} if algo is reinforce else {"normalize_advantage": True}),
            **({"minibatch_size": 1} if algo is ppo else {}),
        )


def compiled_equals_eager(algo, env, programs):
    """Three updates from the same data, through a normalizer that moves."""
    compiled = CompiledCalls()
    config = small(algo, env, num_steps=16)
    (one, envs), (two, _) = begin(algo, config), begin(algo, config)
    two.prepare(ALONE, Compiler())
    for _ in range(3):
        rollout = collect(envs, one.policy, config.num_steps, one.rng.action)
        noise = two.policy.draw_noise((config.num_steps, config.num_envs), two.rng.action)  # as much as `collect` draws
        two.policy.act(rollout.obs[0], noise[0])
        a, b = (algo.update(config, state, rollout) for state in (one, two))
        for name in a:
            torch.testing.assert_close(torch.as_tensor(a[name]), torch.as_tensor(b[name]), rtol=1e-3, atol=1e-5)
    for p, q in zip(one.networks.parameters(), two.networks.parameters(), strict=True):
        torch.testing.assert_close(p, q, rtol=1e-3, atol=1e-5)
    assert len(compiled.calls) == programs
    assert min(compiled.calls) >= 3


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize(
    "case",
    [
        "trpo, 'CartPole-v1', programs=4",  # act, the estimates, the Fisher product, the value
        pytest.param("trpo, 'Pendulum-v1', programs=4", marks=pytest.mark.long),
        pytest.param("a2c, 'Pendulum-v1', programs=3", marks=pytest.mark.long),
        pytest.param(
            "reppo, 'Pendulum-v1', programs=3", marks=pytest.mark.long
        ),  # act, the estimates, the gradient steps
        pytest.param("reinforce, 'CartPole-v1', programs=4", marks=pytest.mark.long),
    ],
)
@pytest.mark.long
def test_traced_updates_equal_eager_ones(case, compiler):
    require_in_own_process(__name__, f"compiled_equals_eager({case})", compiler)


@pytest.mark.parametrize("algo", [trpo, reppo], ids=["trpo", "reppo"])
def test_the_bound_of_the_kl_may_fall(algo):
    """An update in the middle of a run is that with the bound in the middle of the schedule."""
    moved = []
    for bound in (0.006, "0.01>0.002", 0.01):
        config, state, rollout = one_rollout(algo, max_kl=bound, total_steps=10_000)
        state.step = 5_000
        algo.update(config, state, rollout)
        moved.append(nn.utils.parameters_to_vector(state.networks.parameters()))
    constant, falling, wider = moved
    torch.testing.assert_close(falling, constant, rtol=1e-4, atol=1e-6)
    assert (wider - constant).abs().max() > 1e-4
