"""REPPO: its target, its losses, and the weights of its two constraints."""

import dataclasses

import pytest
import torch
from torch.nn.functional import cross_entropy

import environments  # noqa: F401  (registers Copy-box-v0)
import helpers
from helpers import CPU, ONE_MODE, begin, copy_of, equal, slope, spec_of, vectorize
from lemniscate.algos import reppo
from lemniscate.data.rollout import SoftBatch, collect
from lemniscate.errors import UserError
from lemniscate.maths import Gaussian, hl_gauss, soft_lambda_return


def small(env="Levers-v0", **fields):
    """A Config that takes an update in a moment."""
    return helpers.small(reppo, env, **{"epochs": 2, **fields})


def set_multipliers(state, *values):
    with torch.no_grad():
        state.networks.multipliers.log.copy_(torch.tensor(values).log())


def numbers(rng, state, size=50):
    """A batch of random rows, at whose observations the policy that collected was another one."""
    obs, action = torch.randn(size, 5, generator=rng), torch.rand(size, 2, generator=rng) * 2 - 1
    value, target = torch.randn(2, size, generator=rng)
    with torch.no_grad():
        policy = state.policy(obs)
    moved = torch.linspace(0, 1, size)[:, None] * torch.randn(size, 2, generator=rng)
    return SoftBatch(obs, action, value, target, policy.mean + moved, policy.log_std - moved)


@pytest.fixture
def ready(rng):
    """Config, state and a batch."""
    config = small(max_kl=0.2, value_range=3.0)
    torch.manual_seed(0)
    state = reppo.init(config, spec_of("box"), CPU)
    set_multipliers(state, 0.3, 0.7)
    return config, state, numbers(rng, state)


def test_the_target_is_the_soft_return_of_the_policy_that_collected():
    config = small("Pendulum-v1", td_lambda=0.8, gamma=0.9)
    state, env = begin(reppo, config)
    set_multipliers(state, 0.3, 0.01)
    rollout = collect(env, state.policy, 8, state.rng.action)
    twin, _ = begin(reppo, config)
    collect(vectorize("Pendulum-v1"), twin.policy, 8, twin.rng.action)  # draws as much
    batch = reppo.targets(config, state, rollout)
    noise = twin.policy.draw_noise((8, 4), twin.rng.action)
    action, log_prob = state.policy(rollout.next_obs).sample_with_log_prob(noise)
    ends = rollout.terminated, rollout.done
    value = state.networks.critic(rollout.next_obs, action)
    target = soft_lambda_return(rollout.reward, value, -0.3 * log_prob, *ends, gamma=0.9, lam=0.8)
    torch.testing.assert_close(batch.target, target.flatten())
    torch.testing.assert_close(batch.value, state.networks.critic(batch.obs, batch.action))
    torch.testing.assert_close(batch.mean, state.policy(batch.obs).mean)
    torch.testing.assert_close(batch.log_std, state.policy(batch.obs).log_std)


def test_q_learns_the_probabilities_of_its_target(ready):
    _, state, batch = ready
    critic = state.networks.critic
    loss, metrics = reppo.critic_loss(critic, batch)
    probabilities = hl_gauss(batch.target, torch.linspace(-3, 3, 102))
    torch.testing.assert_close(loss, cross_entropy(critic.logits(batch.obs, batch.action), probabilities))
    torch.testing.assert_close(metrics["losses/critic"], loss.detach())


def test_q_is_the_mean_of_its_distribution(ready):
    _, state, batch = ready
    critic = state.networks.critic
    inputs = torch.cat([batch.obs, (5 / 2) ** 0.5 * batch.action], dim=1)
    centres = torch.tensor([-3 + 6 / 101 * (k + 0.5) for k in range(101)])
    expected = (critic.net(inputs).softmax(1) * centres).sum(1)
    torch.testing.assert_close(critic(batch.obs, batch.action), expected)


def test_rows_within_the_bound_climb_and_the_others_come_back(ready, rng):
    config, state, batch = ready
    noise = torch.randn(50, 2, generator=rng)
    loss, metrics = reppo.actor_loss(config, state, state.policy, batch, noise)
    policy = state.policy(batch.obs)
    action, log_prob = policy.sample_with_log_prob(noise)
    old_std, std = batch.log_std.exp(), policy.log_std.exp()
    kl = (policy.log_std - batch.log_std + (old_std**2 + (batch.mean - policy.mean) ** 2) / (2 * std**2) - 0.5).sum(1)
    inside = kl < 0.2
    assert 5 < inside.sum() < 45
    climb = (0.3 * log_prob - state.networks.critic(batch.obs, action))[inside].sum()
    expected = (climb + 0.7 * kl[~inside].sum()) / 50
    torch.testing.assert_close(loss, expected)
    torch.testing.assert_close(slope(loss, state.policy), slope(expected, state.policy))
    torch.testing.assert_close(metrics["kl"], kl.mean().detach())
    torch.testing.assert_close(metrics["beyond_max_kl"], (~inside).float().mean())
    torch.testing.assert_close(metrics["losses/entropy"], -log_prob.mean().detach())


def test_the_policys_loss_moves_neither_q_nor_the_multipliers(ready, rng):
    config, state, batch = ready
    loss, _ = reppo.actor_loss(config, state, state.policy, batch, torch.randn(50, 2, generator=rng))
    assert not slope(loss, state.networks.multipliers).any()
    before = copy_of(state.networks.critic.parameters())
    state.actor_optimizer.learning_rate = 0.1
    state.actor_optimizer.step(lambda policy: reppo.actor_loss(config, state, policy, batch, torch.zeros(50, 2)))
    assert all(equal(before, state.networks.critic.parameters()))


@pytest.mark.parametrize(("entropy", "alpha_grows"), [(-1.5, False), (-2.5, True)])
@pytest.mark.parametrize(("kl", "beta_grows"), [(0.1, False), (0.3, True)])
def test_a_multiplier_grows_while_its_constraint_is_broken(ready, entropy, alpha_grows, kl, beta_grows):
    config, state, _ = ready
    multipliers = state.networks.multipliers
    numbers = torch.tensor(entropy), torch.tensor(kl)
    loss, metrics = reppo.multiplier_loss(config, multipliers, *numbers, 2)  # H̄ = −A = −2
    (gradient,) = torch.autograd.grad(loss, multipliers.log)
    torch.testing.assert_close(gradient, torch.tensor([0.3 * (entropy + 2), 0.7 * (0.2 - kl)]))
    assert [bool(g < 0) for g in gradient] == [alpha_grows, beta_grows]
    torch.testing.assert_close(metrics["temperature"], torch.tensor(0.3))
    torch.testing.assert_close(metrics["kl_weight"], torch.tensor(0.7))
    given, _ = reppo.multiplier_loss(config.replace(target_entropy=0.5), multipliers, *numbers, 2)
    torch.testing.assert_close(given - loss, torch.tensor(-0.3 * 2.5))


@pytest.mark.parametrize("least", [0.0, 0.2])
def test_the_temperature_stops_at_its_least_and_can_grow_again(ready, rng, least):
    config, state, batch = ready
    config = config.replace(min_temperature=least, max_kl=1e6)
    state.multiplier_optimizer.learning_rate = 0.2

    def multipliers_after(steps, target_entropy):
        minibatches, noise = torch.arange(50).expand(steps, 50), torch.randn(steps, 50, 2, generator=rng)
        reppo.learn(config.replace(target_entropy=target_entropy), state, batch, minibatches, noise)
        return state.networks.multipliers().tolist()

    alpha, beta = multipliers_after(20, -50.0)
    assert beta < 0.1, "only the temperature has a floor"
    assert alpha == pytest.approx(0.2) if least else alpha < 0.1
    alpha, _ = multipliers_after(40, 50.0)
    assert alpha > 1.5 * least


def learned_q(mode="DISABLED", spoil=lambda rollout: rollout, env="EndlessLevers-v0", **kwargs):
    """Q(s, 0) after enough updates with γ = 0.9 and no entropy; the truth of the endless one is 10."""
    plain = {"normalize_observations": False, "scale_rewards": False}
    widths = {"hidden": (), "value_range": 20.0, "learning_rate": 0.05, "max_grad_norm": None}
    config = small(env, gamma=0.9, epochs=10, final_learning_rate=1.0, **plain, **widths)
    torch.manual_seed(0)
    env = vectorize(env, mode=mode, **kwargs)
    state = reppo.init(config, env.spec, CPU)
    for _ in range(60):
        set_multipliers(state, 1e-8, 0.01)
        reppo.update(config, state, spoil(collect(env, state.policy, config.num_steps, state.rng.action)))
    return state.networks.critic(torch.ones(1, 3), torch.zeros(1, 1)).item()


@pytest.mark.parametrize("mode", ONE_MODE)
def test_values_are_bootstrapped_at_time_limits_and_ignore_reset_rows(mode):
    assert learned_q(mode, length=None, horizon=4) == pytest.approx(10, abs=0.5)


@pytest.mark.long
def test_without_the_bootstrap_the_value_is_wrong():
    assert learned_q(spoil=lambda r: dataclasses.replace(r, terminated=r.truncated), length=None, horizon=4) < 6


@pytest.mark.long
def test_the_entropy_reaches_its_target():
    """The best policy would be deterministic; a uniform one has log 2 = 0.69."""
    fields = {"target_entropy": -0.5, "gamma": 0.5, "learning_rate": 0.01, "epochs": 4}
    config = small("Greedy-v0", num_envs=16, final_learning_rate=1.0, **fields)
    torch.manual_seed(0)
    env = vectorize("Greedy-v0", 16, mode="DISABLED", length=None, horizon=4)
    state = reppo.init(config, env.spec, CPU)
    entropies = []
    for _ in range(60):
        rollout = collect(env, state.policy, config.num_steps, state.rng.action)
        entropies.append(reppo.update(config, state, rollout)["losses/entropy"])
    assert sum(entropies[-20:]) / 20 == pytest.approx(-0.5, abs=0.25)
    assert rollout.reward.mean() > 0.4


@pytest.mark.long
def test_the_policy_stays_within_its_bound():
    """After an update the KL is about what is allowed, however much the rewards ask for."""
    config = small(
        "Greedy-v0", num_envs=16, num_steps=32, max_kl=0.05, learning_rate=0.01, epochs=20, scale_rewards=False
    )
    torch.manual_seed(0)
    env = vectorize("Greedy-v0", 16, mode="DISABLED", length=None, horizon=4)
    state = reppo.init(config, env.spec, CPU)
    for _ in range(5):
        rollout = collect(env, state.policy, config.num_steps, state.rng.action)
        old = state.policy(rollout.obs)
        reppo.update(config, state, rollout)
        new = state.policy(rollout.obs)
        kl = Gaussian(old.mean, old.log_std).kl(Gaussian(new.mean, new.log_std))
        assert 0.001 < kl.mean() < 0.15


@pytest.mark.long
def test_learns_to_copy_its_observation():
    """Bounds that lie asymmetrically: the policy must be right about the scale."""
    config = small("Copy-box-v0", num_envs=16, num_steps=16, minibatch_size=64, gamma=0.5, learning_rate=3e-3, epochs=8)
    torch.manual_seed(0)
    env = vectorize("Copy-box-v0", 16)
    state, means = reppo.init(config, env.spec, CPU), []
    for _ in range(30):
        rollout = collect(env, state.policy, config.num_steps, state.rng.action)
        reppo.update(config, state, rollout)
        means.append(rollout.reward.mean().item())
    assert means[0] < 0.65
    assert sum(means[-5:]) / 5 > 0.8


def test_actions_that_are_not_numbers_have_their_sentence():
    with pytest.raises(UserError, match="continuous"):
        reppo.init(small("Countdown-v0"), spec_of("discrete"), CPU)
