"""DDPG on environments whose answers are known."""

import gymnasium as gym
import numpy as np
import pytest
import torch

import lemniscate as lem
import worlds  # noqa: F401  (registers Copy-box-v0)
from lemniscate.algos import ddpg
from lemniscate.envs import toy
from lemniscate.envs.api import VecEnv
from lemniscate.envs.gymnasium import GymnasiumBackend
from lemniscate.errors import UserError
from lemniscate.types import Transition

CPU = torch.device("cpu")
MODES = ["NEXT_STEP", "SAME_STEP", "DISABLED"]


class Levers(toy.Countdown):
    """Countdown for those who act in numbers."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.single_action_space = gym.spaces.Box(-1, 1, (1,))
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, self.num_envs)


class Endless(Levers):
    """Reward 1 for ever, truncated every 4 steps, nothing to see: Q = 1 / (1 − γ)."""

    def _observe(self):
        return np.ones((self.num_envs, 3), dtype=np.float32)


def small(env="Countdown-v0", **fields):
    defaults = {
        "env": env,
        "num_envs": 4,
        "total_steps": 10_000,
        "learning_starts": 40,
        "batch_size": 32,
        "hidden": (16,),
        "critic_hidden": (),
        "critic_learning_rate": 0.05,
        "tau": 0.1,
        "gamma": 0.9,
        "num_steps": 10,
    }
    return ddpg.Config(**{**defaults, **fields})


def ready(monkeypatch, world, mode="DISABLED", *, config, **kwargs):
    """A State that has played 40 steps with random actions, and where."""
    monkeypatch.setattr(toy, "Countdown", world)
    torch.manual_seed(0)
    env = VecEnv(GymnasiumBackend("Countdown-v0", 4, CPU, mode=mode, **kwargs))
    env.restart(0)
    state = ddpg.init(config, env.spec, CPU)
    for _ in range(40):
        ddpg.play(config, state, env)
    return state, env


def learned_q(state, config, obs):
    for _ in range(400):
        ddpg.update(config, state)
    return state.networks.critic(obs, torch.zeros(len(obs), 1))


@pytest.mark.parametrize("mode", MODES)
def test_time_outs_bootstrap_and_reset_rows_teach_nothing(monkeypatch, mode):
    config = small()
    state, _ = ready(monkeypatch, Endless, mode, config=config, length=None, horizon=4)
    assert state.replay.transitions.reward.max() == 1  # a reset row pays 100
    assert learned_q(state, config, torch.ones(1, 3)).item() == pytest.approx(10, abs=0.3)


def test_after_a_termination_nothing_follows(monkeypatch):
    config = small(critic_hidden=(32,), critic_learning_rate=0.01)
    state, _ = ready(monkeypatch, Levers, config=config, length=5)
    obs = torch.tensor([[1.0, 3.0, t] for t in range(5)])
    expected = [(1 - 0.9**k) / 0.1 for k in (5, 4, 3, 2, 1)]
    assert (learned_q(state, config, obs) - torch.tensor(expected)).abs().max() < 0.5


@pytest.mark.parametrize("mode", MODES)
def test_what_is_remembered_is_what_happened(monkeypatch, mode):
    """Observations are (copy, episode, step): the successor is of the same episode, and the deaths are at step 3."""
    config = small()
    state, _ = ready(monkeypatch, Levers, mode, config=config, length=3)
    rows = state.replay.transitions[: len(state.replay)]
    assert len(state.replay) == (120 if mode == "NEXT_STEP" else 160)
    assert torch.equal(rows.next_obs, rows.obs + torch.tensor([0.0, 0.0, 1.0]))
    assert torch.equal(rows.terminated, rows.next_obs[:, 2] == 3)


def test_the_critics_target_is_of_the_target_networks_alone(monkeypatch, rng):
    config = small(critic_hidden=(8,))
    state, _ = ready(monkeypatch, Levers, config=config)
    for parameter in state.targets.parameters():
        parameter.data = torch.randn(parameter.shape, generator=rng)
    batch = state.replay.transitions[:50]
    loss, watched = ddpg.critic_loss(config, state.targets, state.networks.critic, batch)
    next_action = torch.tanh(state.targets.policy.net(batch.next_obs))
    next_value = state.targets.critic.net(torch.cat([batch.next_obs, next_action], dim=-1))[:, 0]
    value = state.networks.critic.net(torch.cat([batch.obs, batch.action], dim=-1))[:, 0]
    target = batch.reward + 0.9 * next_value * (1 - batch.terminated.float())
    torch.testing.assert_close(loss, 0.5 * (value - target).square().mean())
    torch.testing.assert_close(watched["q"], value.mean())


def test_it_learns_to_copy_what_it_sees():
    """Bounds that lie asymmetrically: the policy must be right about the scale."""
    torch.manual_seed(0)
    config = small(
        "Copy-box-v0", hidden=(32,), critic_hidden=(32,), gamma=0.5, actor_learning_rate=3e-3, critic_learning_rate=3e-3
    )
    env = VecEnv(GymnasiumBackend(config.env, 4, CPU))
    env.restart(0)
    state, rewards = ddpg.init(config, env.spec, CPU), []
    for t in range(900):
        ddpg.play(config, state, env)
        if t > 50:
            ddpg.update(config, state)
        rewards.append(state.replay.transitions.reward[len(state.replay) - 1].item())
    assert np.mean(rewards[:40]) < 0.55
    assert np.mean(rewards[-100:]) > 0.8


def moved(before, module):
    return [not torch.equal(a, b) for a, b in zip(before, module.parameters(), strict=True)]


@pytest.mark.parametrize("delay", [1, 2])
def test_each_step_moves_what_it_should(monkeypatch, delay):
    config = small(critic_hidden=(8,), policy_delay=delay)
    state, _ = ready(monkeypatch, Levers, config=config)
    parts = (state.networks.policy, state.networks.critic, state.targets)
    seen = []
    for _ in range(2):
        before = [[p.clone() for p in part.parameters()] for part in parts]
        ddpg.update(config, state)
        seen.append([all(moved(was, part)) for was, part in zip(before, parts, strict=True)])
        none = [not any(moved(was, part)) for was, part in zip(before, parts, strict=True)]
        assert all(a != b for a, b in zip(seen[-1], none, strict=True))
    assert seen == ([[True] * 3, [True] * 3] if delay == 1 else [[False, True, False], [True] * 3])


def test_the_targets_follow_and_share_the_normalizer(monkeypatch):
    config = small(tau=0.25, normalize_observations=True, critic_hidden=(8,))
    state, _ = ready(monkeypatch, Levers, config=config)
    assert state.targets.policy.normalizer is state.networks.policy.normalizer is state.networks.critic.normalizer
    assert state.networks.policy.normalizer.count == 160
    before = [p.clone() for p in state.targets.parameters()]
    ddpg.update(config, state)
    for was, now, online in zip(before, state.targets.parameters(), state.networks.parameters(), strict=True):
        torch.testing.assert_close(now, 0.75 * was + 0.25 * online)


def test_the_actors_gradient_is_that_of_q_through_the_action(monkeypatch):
    """By finite differences in float64."""
    config = small(critic_hidden=(8,))
    state, _ = ready(monkeypatch, Levers, config=config)
    networks = state.networks.double()
    policy, obs = networks.policy, torch.randn(5, 3, dtype=torch.float64)
    batch = Transition(obs, obs[:, :1], obs[:, 0], obs, obs[:, 0] > 0)
    loss = lambda: ddpg.actor_loss(networks.critic, policy, batch)[0]  # noqa: E731
    weight = policy.net[-1].weight
    (gradient,) = torch.autograd.grad(loss(), weight)
    with torch.no_grad():
        for i in range(weight.numel()):
            flat, kept = weight.data.view(-1), weight.data.view(-1)[i].item()
            flat[i] = kept + 1e-6
            up = -networks.critic(obs, policy(obs).mode()).mean()
            flat[i] = kept - 1e-6
            down = -networks.critic(obs, policy(obs).mode()).mean()
            flat[i] = kept
            assert gradient.view(-1)[i].item() == pytest.approx(((up - down) / 2e-6).item(), abs=1e-7)


def test_actions_are_random_while_it_warms_up_and_near_the_policys_afterwards(monkeypatch):
    config = small(learning_starts=160, noise_std=0.05)
    state, env = ready(monkeypatch, Levers, config=config)
    warm = state.replay.transitions.action[:160]
    assert warm.min() < -0.9
    assert warm.max() > 0.9
    assert warm.std().item() == pytest.approx(1 / 3**0.5, abs=0.05)
    obs = env.obs
    ddpg.play(config, state, env)
    off = state.replay.transitions.action[160:164] - state.policy(obs).mode()
    assert 0 < off.abs().max() < 0.25


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"env": "CartPole-v1"}, "has Discrete actions; ddpg, td3 and sac need continuous ones"),
        ({"env": "Unbounded-v0"}, "has actions without bounds"),
        ({"learning_starts": 10_000, "total_steps": 10_000}, "learning_starts must be below total_steps"),
        ({"buffer_size": 200}, "buffer_size 200 .* below batch_size 256"),
        ({"buffer_size": 10**12, "total_steps": 10**12}, "choose buffer_size at most"),
    ],
)
def test_what_cannot_be_trained_gets_its_sentence_and_leaves_nothing(tmp_path, fields, sentence):
    with pytest.raises(UserError, match=sentence):
        lem.train("ddpg", run=tmp_path / "run", progress=False, **{"env": "Pendulum-v1", **fields})
    assert not (tmp_path / "run").exists()
