"""REINFORCE, A2C and TRPO, the road to PPO, on environments whose answers are known."""

import copy
import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import environments
from lemniscate.algos import a2c, ppo, reinforce, trpo
from lemniscate.data.rollout import collect, collect_episodes, minibatches
from lemniscate.envs import toy
from lemniscate.envs.gymnasium import GymnasiumBackend
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError

CPU = torch.device("cpu")
MODES = ["NEXT_STEP", "SAME_STEP", "DISABLED"]
EACH = pytest.mark.parametrize("algo", [reinforce, a2c, trpo], ids=["reinforce", "a2c", "trpo"])
FAST = {
    reinforce: {"learning_rate": 0.02, "critic_learning_rate": 0.01},
    a2c: {"learning_rate": 0.02, "value_coef": 0.1},
    trpo: {"max_kl": 0.05, "critic_learning_rate": 0.01},
}
"""what learns a toy in a moment"""


class Endless(toy.Countdown):
    """Reward 1 for ever, truncated every 4 steps, nothing to see: V = 1 / (1 − γ)."""

    def _observe(self):
        return np.ones((self.num_envs, 3), dtype=np.float32)


def small(algo, env="Countdown-v0", **fields):
    defaults = {"env": env, "num_envs": 4, "num_steps": 8, "total_steps": 100_000, "hidden": (16,)}
    return algo.Config(**{**defaults, **fields})


def begin(algo, config, mode="DISABLED", **kwargs):
    torch.manual_seed(0)
    toys = {"mode": mode, **kwargs} if config.env in ("Countdown-v0", "Matching-v0") else {}
    env = VecEnv(GymnasiumBackend(config.env, config.num_envs, CPU, **toys))
    env.restart(0)
    return algo.init(config, env.spec, CPU), env


def learned_value(algo, mode, spoil=lambda rollout: rollout):
    """V(s) after enough updates with γ = 0.9; the truth is 10."""
    plain = {"hidden": (), "gamma": 0.9, "normalize_observations": False}
    of = {
        reinforce: {"critic_learning_rate": 0.1, "critic_minibatch_size": 16},
        a2c: {"learning_rate": 0.1, "final_learning_rate": 1.0, "max_grad_norm": None, "value_coef": 1.0},
        trpo: {"critic_learning_rate": 0.1, "critic_minibatch_size": 16},
    }
    config = small(algo, **plain, **of[algo])
    state, env = begin(algo, config, mode, length=None, horizon=4)
    for _ in range(200 if algo is a2c else 40):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        algo.update(config, state, spoil(rollout))
    return state.networks.value(torch.ones(1, 3)).item()


@EACH
@pytest.mark.parametrize("mode", MODES)
def test_time_outs_bootstrap_and_reset_rows_teach_nothing(monkeypatch, algo, mode):
    monkeypatch.setattr(toy, "Countdown", Endless)
    assert learned_value(algo, mode) == pytest.approx(10.0, abs=0.5)


@EACH
def test_without_the_bootstrap_the_value_is_wrong(monkeypatch, algo):
    monkeypatch.setattr(toy, "Countdown", Endless)
    death = lambda r: dataclasses.replace(r, terminated=r.truncated)  # noqa: E731
    assert learned_value(algo, "DISABLED", death) < 6


@EACH
def test_with_reset_rows_the_value_is_wrong(monkeypatch, algo):
    monkeypatch.setattr(toy, "Countdown", Endless)
    everything = lambda r: dataclasses.replace(r, valid=torch.ones_like(r.valid))  # noqa: E731
    assert learned_value(algo, "NEXT_STEP", everything) > 15


@EACH
@pytest.mark.parametrize("kind", environments.KINDS)
def test_it_learns_in_spaces_of_every_kind(algo, kind):
    size = {"num_envs": 16, "num_steps": 16, "initial_log_std": -1.0, "normalize_observations": False}
    config = small(algo, f"Copy-{kind}-v0", **size, **FAST[algo])
    state, env = begin(algo, config)
    means = []
    for _ in range(80 if algo is not trpo else 40):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        algo.update(config, state, rollout)
        means.append(rollout.reward.mean().item())
        assert rollout.reward.min() > -100  # no action that is masked
    assert means[0] < 0.65
    assert np.mean(means[-5:]) > (0.65 if kind == "box" else 0.85)


@pytest.mark.parametrize("mode", MODES)
def test_whole_episodes_are_whole_and_as_many_from_each_copy(mode):
    """Countdown's rows say whose they are: (copy, episode, step)."""
    lengths = np.array([3, 5, 8])
    config = small(reinforce, episodes=2, num_envs=3)
    state, env = begin(reinforce, config, mode, length=lengths)
    collect(env, state.policy, 2, state.noise)  # now every copy stands within an episode
    for _ in range(2):
        rollout = collect_episodes(env, state.policy, 2, state.noise)
        rows = rollout.obs[rollout.valid].int()
        for n in range(3):
            mine = rows[rows[:, 0] == n, 1:]
            first = mine[0, 0].item()
            assert mine.tolist() == [[first + k, t] for k in range(2) for t in range(lengths[n])]


def weights(mode="DISABLED", rollout=None, **fields):
    """What weighs log π at each row, of two whole episodes of 3 copies of Countdown (rewards 1, five steps)."""
    config = small(reinforce, num_envs=3, episodes=2, gamma=0.9, **fields)
    state, env = begin(reinforce, config, mode, length=5)
    rollout = collect_episodes(env, state.policy, 2, state.noise)
    batch = reinforce.outcomes(config, state, rollout)
    played = rollout.valid.flatten()
    return batch.obs[played, 2].long(), batch.advantage[played], state, batch[played.nonzero()[:, 0]]


@pytest.mark.parametrize("mode", MODES)
def test_an_action_is_paid_with_what_followed_it_or_with_the_whole_episode(mode):
    to_go = torch.tensor([(1 - 0.9**k) / 0.1 for k in (5, 4, 3, 2, 1)])
    t, weight, _, _ = weights(mode, baseline="none")
    torch.testing.assert_close(weight, to_go[t])
    _, weight, _, _ = weights(mode, baseline="none", returns="whole")
    torch.testing.assert_close(weight, to_go[:1].expand(30))
    t, weight, _, _ = weights(mode, baseline="mean")
    torch.testing.assert_close(weight, to_go[t] - to_go.mean())
    t, weight, state, batch = weights(mode, baseline="value")
    torch.testing.assert_close(weight, to_go[t] - state.networks.value(batch.obs).detach())


def test_a_baseline_leaves_the_gradient_as_it_is_on_average_and_quiets_it():
    """The same 100 rollouts weighed in three ways: differences of means within four standard errors."""
    fields = {"num_envs": 16, "episodes": 1, "gamma": 0.9, "standardize": False}
    configs = {way: small(reinforce, "Matching-v0", baseline=way, **fields) for way in ("none", "mean", "value")}
    state, env = begin(reinforce, configs["value"])
    draw = lambda: collect_episodes(env, state.policy, 1, state.noise)  # noqa: E731
    for _ in range(20):  # V learns what a guess is worth
        batch, played = reinforce.outcomes(configs["value"], state, rollout := draw()), rollout.played
        state.critic(batch, minibatches(played, len(played), 16, state.shuffle), 0.01)
    gradients = {way: [] for way in configs}
    for _ in range(100):
        rollout = draw()
        for way, config in configs.items():
            state.policy.zero_grad()
            batch = reinforce.outcomes(config, state, rollout)[rollout.played]
            reinforce.policy_loss(config, state.policy, batch)[0].backward()
            gradients[way].append(torch.cat([p.grad.flatten() for p in state.policy.parameters()]).clone())
    none, *others = (torch.stack(gradient) for gradient in gradients.values())
    assert (none.mean(0).abs() > 4 * none.std(0) / 100**0.5).any()
    for other in others:
        apart = none - other
        assert (apart.mean(0).abs() <= 4 * apart.std(0) / 100**0.5 + 1e-6).all()
        assert other.var(0).sum() < 0.5 * none.var(0).sum()


def test_a_batch_of_one_row_teaches_nothing_and_harms_nothing():
    config = small(reinforce, num_envs=1, episodes=1)
    state, env = begin(reinforce, config, length=1)
    rollout = collect_episodes(env, state.policy, 1, state.noise)
    assert rollout.valid.sum() == 1
    assert reinforce.update(config, state, rollout)["losses/policy"] == 0


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("baseline", ["none", "mean", "value"])
def test_it_learns_from_whole_episodes(mode, baseline):
    config = small(
        reinforce, "Matching-v0", num_envs=8, episodes=1, learning_rate=0.03, baseline=baseline, standardize=False
    )
    state, env = begin(reinforce, config, mode)
    returns = []
    for _ in range(40):
        rollout = collect_episodes(env, state.policy, config.episodes, state.noise)
        reinforce.update(config, state, rollout)
        returns += env.take_episodes().returns
    assert np.mean(returns[-16:]) > np.mean(returns[:16]) + 5


def test_an_episode_that_never_ends_is_a_sentence(monkeypatch):
    monkeypatch.setattr("lemniscate.envs.vec_env.PATIENCE", 30)
    config = small(reinforce, episodes=1)
    state, env = begin(reinforce, config, length=None)
    with pytest.raises(UserError, match=r"Countdown-v0 has not ended after 30 steps"):
        collect_episodes(env, state.policy, 1, state.noise)


@pytest.mark.parametrize(
    "fields",
    [{"baseline": "none"}, {"baseline": "mean"}, {"returns": "whole"}, {"returns": "whole", "baseline": "none"}],
)
def test_fixed_batches_need_a_value_to_bootstrap_from(fields):
    with pytest.raises(UserError, match=r"cuts episodes.*Choose episodes 1 or more"):
        small(reinforce, **fields)


def test_batches_of_many_sizes_are_not_compiled_for():
    with pytest.raises(UserError, match="native engine cannot take"):
        small(reinforce, episodes=2, engine="native")
    assert small(reinforce, episodes=2, total_steps=10**9).gradient_steps == 0


def one_rollout(algo, **fields):
    config = small(algo, "Pendulum-v1", **fields)
    state, env = begin(algo, config)
    return config, state, collect(env, state.policy, config.num_steps, state.noise)


def test_a2c_with_one_step_is_the_one_step_actor_critic():
    """r + γ V(s') − V(s) weighs log π, and its square is the critic's loss; one step of Adam; whatever λ."""
    config, state, rollout = one_rollout(
        a2c, num_steps=1, gae_lambda=0.7, value_coef=0.5, max_grad_norm=None, normalize_observations=False
    )
    twin = a2c.networks(config, begin(a2c, config)[1].spec)
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


def test_at_ratio_one_ppo_and_a2c_have_one_gradient():
    shared = {"gae_lambda": 0.9, "normalize_advantage": False, "value_coef": 0.4, "entropy_coef": 0.01}
    config, state, rollout = one_rollout(a2c, **shared)
    batch = a2c.advantages(config, state, rollout)
    gradients = []
    for module, its in ((a2c, config), (ppo, small(ppo, "Pendulum-v1", minibatch_size=32, **shared))):
        state.networks.zero_grad()
        module.loss(its, state.networks, batch)[0].backward()
        gradients.append(torch.cat([p.grad.flatten() for p in state.networks.parameters()]).clone())
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6)
    assert gradients[0].norm() > 0


@pytest.mark.parametrize("env", ["Pendulum-v1", "Matching-v0"])
@pytest.mark.parametrize("max_kl", [1e-4, 0.01, 0.3])
def test_trpo_keeps_its_promises_after_every_step(env, max_kl):
    """Of numbers and of choices; of Matching's rows a sixth are resets, which no mean counts."""
    config = small(trpo, env, max_kl=max_kl, num_steps=32, critic_epochs=1, normalize_observations=False)
    state, env = begin(trpo, config, "NEXT_STEP")
    moved = 0
    for _ in range(10):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        obs, before = rollout.obs[rollout.valid], copy.deepcopy(state.policy)
        seen = trpo.update(config, state, rollout)
        with torch.no_grad():
            kl = before(obs).kl(state.policy(obs)).mean().item()
        assert kl == pytest.approx(seen["kl"].item(), rel=1e-3, abs=1e-7)
        assert kl <= max_kl
        assert (kl > 0) == (seen["step_fraction"] > 0)
        moved += kl > 0.2 * max_kl
    assert moved >= 8


def test_trpo_lowers_the_surrogate_or_stays_where_it_is():
    config, state, rollout = one_rollout(trpo, num_steps=32)
    batch = trpo.advantages(config, state, rollout)
    seen = trpo.improve(config, state, batch, batch.obs)
    assert seen["step_fraction"] > 0
    assert seen["losses/policy"] < 0  # it is 0 at the start: standardized advantages


def test_a_step_that_cannot_be_kept_leaves_every_bit_of_the_policy(monkeypatch):
    config, state, rollout = one_rollout(trpo)
    batch, before = trpo.advantages(config, state, rollout), [p.clone() for p in state.policy.parameters()]
    monkeypatch.setattr(trpo, "natural_step", lambda fisher, gradient, *_, **__: gradient)  # uphill
    assert trpo.improve(config, state, batch, batch.obs)["step_fraction"] == 0
    assert all(torch.equal(a, b) for a, b in zip(before, state.policy.parameters(), strict=True))


def test_without_the_line_search_it_is_the_natural_policy_gradient():
    """The whole step is taken, whatever comes of it; its KL is δ to second order."""
    config, state, rollout = one_rollout(
        trpo, num_steps=64, line_search=False, damping=1e-3, cg_iterations=30, max_kl=1e-4, hidden=(4,)
    )
    batch, before = trpo.advantages(config, state, rollout), state.parameters.vector.clone()
    seen = trpo.improve(config, state, batch, batch.obs)
    assert seen["step_fraction"] == 1
    assert seen["kl"].item() == pytest.approx(1e-4, rel=0.2)
    uphill = dataclasses.replace(batch, advantage=-batch.advantage)
    there = before + (before - _stepped(config, state, uphill, before))
    torch.testing.assert_close(there, _stepped(config, state, batch, before), rtol=1e-2, atol=1e-4)


def engines_agree(algo, env):
    """Three updates from the same data, through a normalizer that moves."""
    config = small(algo, env, num_steps=16)
    (one, envs), (two, _) = begin(algo, config), begin(algo, config)
    two.policy.make_native()
    for part in vars(two).values():
        if hasattr(part, "make_native"):
            part.make_native()
    for _ in range(3):
        rollout = collect(envs, one.policy, config.num_steps, one.noise)
        a, b = (algo.update(config, state, rollout) for state in (one, two))
        for name in a:
            torch.testing.assert_close(torch.as_tensor(a[name]), torch.as_tensor(b[name]), rtol=1e-3, atol=1e-5)
    for p, q in zip(one.networks.parameters(), two.networks.parameters(), strict=True):
        torch.testing.assert_close(p, q, rtol=1e-3, atol=1e-5)
    if algo is trpo:
        assert two.parameters._product._chosen is two.parameters._product._compiled


@pytest.mark.parametrize(
    "call", ["trpo, 'Pendulum-v1'", "trpo, 'CartPole-v1'", "a2c, 'Pendulum-v1'", "reinforce, 'CartPole-v1'"]
)
def test_the_two_engines_agree(call):
    """In a process of its own: the shape checks of this one are not for the compiler."""
    code = f"from test_on_policy import *; engines_agree({call})"
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_damping_shortens_the_step():
    """With very much of it the step is √(2δ / c) along the gradient, whatever the Fisher matrix says."""
    config, state, rollout = one_rollout(trpo, num_steps=64, line_search=False, damping=1e4, max_kl=1e-2)
    batch, start = trpo.advantages(config, state, rollout), state.parameters.vector.clone()
    step = _stepped(config, state, batch, start) - start
    assert step.norm().item() == pytest.approx((2 * 1e-2 / 1e4) ** 0.5, rel=1e-2)


def _stepped(config, state, batch, start):
    state.parameters.vector.copy_(start)
    trpo.improve(config, state, batch, batch.obs)
    return state.parameters.vector.clone()


def test_trpos_policy_step_leaves_the_critic_alone_and_the_critics_the_policy():
    config, state, rollout = one_rollout(trpo)
    assert len(state.parameters.vector) == sum(p.numel() for p in state.policy.parameters())
    batch = trpo.advantages(config, state, rollout)
    critic = [p.clone() for p in state.networks.value.parameters()]
    trpo.improve(config, state, batch, batch.obs)
    assert all(torch.equal(a, b) for a, b in zip(critic, state.networks.value.parameters(), strict=True))
    policy = [p.clone() for p in state.policy.parameters()]
    state.critic(batch, torch.arange(32)[None], 0.1)
    assert all(torch.equal(a, b) for a, b in zip(policy, state.policy.parameters(), strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(critic, state.networks.value.parameters(), strict=True))


@EACH
def test_the_normalizer_moves_after_the_update_and_sees_only_real_rows(algo):
    config = small(algo)
    state, env = begin(algo, config, "NEXT_STEP", length=3)
    rollout = collect(env, state.policy, 8, state.noise)
    assert not rollout.valid.all()
    algo.update(config, state, rollout)
    assert state.policy.normalizer.count == rollout.valid.sum()


@EACH
@pytest.mark.parametrize("scaled", [False, True])
def test_rewards_of_any_size_are_learned_from_as_they_are_unless_scaling_is_asked_for(algo, rng, scaled):
    """γ = 0: the value target is the reward."""
    config, state, rollout = one_rollout(algo, gamma=0.0, scale_rewards=scaled)
    seen = []
    spy = lambda batch, parts, rate: seen.append(batch) or {"losses/value": torch.zeros(())}  # noqa: E731
    setattr(state, "optimizer" if algo is a2c else "critic", spy)
    rollout = dataclasses.replace(rollout, reward=100 * torch.randn(8, 4, generator=rng) + 300)
    algo.update(config, state, rollout)
    expected = rollout.reward / rollout.reward.std(correction=0) if scaled else rollout.reward
    torch.testing.assert_close(seen[0].target, expected.flatten())


@EACH
def test_steps_shrink_to_nothing_where_they_are_told_to(algo):
    """The networks that a falling learning rate moves stay where they are at the end of the run, and only there."""
    field = "final_critic_learning_rate" if algo is trpo else "final_learning_rate"
    config, state, rollout = one_rollout(algo, **{field: 0.0})
    first = config.critic_learning_rate if algo is trpo else config.learning_rate
    part = {a2c: state.networks, reinforce: state.networks.policy, trpo: state.networks.value}[algo]
    for step, moves in ((0, True), (config.total_steps // 2, True), (config.total_steps, False)):
        state.step, before = step, [p.clone() for p in part.parameters()]
        rate = algo.update(config, state, rollout)["learning_rate"]
        assert rate == pytest.approx((1 - step / config.total_steps) * first)
        assert moves != all(torch.equal(a, b) for a, b in zip(before, part.parameters(), strict=True))


def slope(loss, module):
    """The gradient of a loss, as one vector."""
    gradients = torch.autograd.grad(loss, list(module.parameters()), materialize_grads=True)
    return torch.cat([gradient.flatten() for gradient in gradients])


@pytest.mark.parametrize("standardized", [False, True])
def test_weights_are_standardized_only_where_that_is_asked_for(standardized):
    """Then scale and shift of what weighs log π change nothing."""
    config, state, rollout = one_rollout(a2c, normalize_advantage=standardized, value_coef=0.0)
    batch = a2c.advantages(config, state, rollout)
    other = dataclasses.replace(batch, advantage=3 * batch.advantage + 5)
    a, b = (slope(a2c.loss(config, state.networks, x)[0], state.policy) for x in (batch, other))
    assert torch.allclose(a, b, rtol=1e-3, atol=1e-6) == standardized
    config, state, rollout = one_rollout(reinforce, standardize=standardized)
    a, b = (slope(reinforce.policy_loss(config, state.policy, x)[0], state.policy) for x in (batch, other))
    assert torch.allclose(a, b, rtol=1e-3, atol=1e-6) == standardized
    config, state, rollout = one_rollout(trpo, normalize_advantage=standardized)
    start = state.parameters.vector.clone()
    a, b = (_stepped(config, state, x, start) - start for x in (batch, other))
    assert torch.allclose(a, b, rtol=1e-3, atol=1e-5) == standardized


def test_the_entropy_bonus_pays_for_entropy():
    config, state, rollout = one_rollout(reinforce)
    batch = reinforce.outcomes(config, state, rollout)
    plain = slope(reinforce.policy_loss(config, state.policy, batch)[0], state.policy)
    paid = dataclasses.replace(config, entropy_coef=0.3)
    with_bonus = slope(reinforce.policy_loss(paid, state.policy, batch)[0], state.policy)
    entropy = slope(state.policy(batch.obs).entropy().mean(), state.policy)
    torch.testing.assert_close(with_bonus, plain - 0.3 * entropy)
    assert entropy.norm() > 0


def test_a2cs_gradient_is_clipped():
    """Adam forgets the length of a gradient, but for its ε: far below that, nothing moves."""
    config, state, rollout = one_rollout(a2c, max_grad_norm=1e-12)
    before = [p.clone() for p in state.networks.parameters()]
    a2c.update(config, state, rollout)
    for old, new in zip(before, state.networks.parameters(), strict=True):
        torch.testing.assert_close(old, new, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("attempts", "taken"), [(2, 0), (20, 0.5**3)])
def test_trpo_shortens_a_step_that_is_too_long(monkeypatch, attempts, taken):
    """Six times too long, by halves: an eighth of it is the first within the bound."""
    config, state, rollout = one_rollout(trpo, num_steps=64, shrink=0.5, attempts=attempts, damping=1e-3, max_kl=1e-4)
    natural_step = trpo.natural_step
    monkeypatch.setattr(trpo, "natural_step", lambda *a, **k: 6 * natural_step(*a, **k))
    batch = trpo.advantages(config, state, rollout)
    assert trpo.improve(config, state, batch, batch.obs)["step_fraction"] == taken


@EACH
def test_a_single_row_has_no_standard_deviation(algo):
    with pytest.raises(UserError, match=r"(standardize|normalize_advantage) needs batches of 2 rows"):
        small(algo, num_envs=1, num_steps=1, **({} if algo is reinforce else {"normalize_advantage": True}))
