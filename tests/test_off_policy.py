"""DDPG, TD3 and SAC on environments whose answers are known."""

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import environments  # noqa: F401  (registers Copy-box-v0)
import lemniscate as lem
from conftest import tiny_off_policy
from lemniscate.algos import ddpg, sac, td3
from lemniscate.envs import toy
from lemniscate.envs.gymnasium import GymnasiumBackend
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError
from lemniscate.run import checkpoint
from lemniscate.spec import Box, ObservationPart, Spec
from lemniscate.types import Transition

CPU = torch.device("cpu")
MODES = ["NEXT_STEP", "SAME_STEP", "DISABLED"]
EACH = pytest.mark.parametrize("algo", [ddpg, td3, sac], ids=["ddpg", "td3", "sac"])


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


class Greedy(Endless):
    """The reward is the action."""

    def _reward(self, actions):
        return actions[:, 0]


def small(algo=ddpg, env="Countdown-v0", **fields):
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
    if algo is sac:
        defaults |= {"initial_temperature": 1e-8}  # values are known without entropy
    return algo.Config(**{**defaults, **fields})


def ready(monkeypatch, algo, config, world=Levers, mode="DISABLED", **kwargs):
    """A State that has played 40 steps with random actions, and where."""
    monkeypatch.setattr(toy, "Countdown", world)
    torch.manual_seed(0)
    env = VecEnv(GymnasiumBackend("Countdown-v0", 4, CPU, mode=mode, **kwargs))
    env.restart(0)
    state = algo.init(config, env.spec, CPU)
    for _ in range(40):
        algo.play(config, state, env)
    return state, env


def learned_q(algo, state, config, obs):
    for _ in range(400):
        algo.update(config, state)
    return state.networks.critic(obs, torch.zeros(len(obs), 1)).view(-1, len(obs))  # [1 or 2, B]


@EACH
@pytest.mark.parametrize("mode", MODES)
def test_time_outs_bootstrap_and_reset_rows_teach_nothing(monkeypatch, algo, mode):
    config = small(algo, policy_delay=1)
    state, _ = ready(monkeypatch, algo, config, Endless, mode, length=None, horizon=4)
    assert state.replay.transitions.reward.max() == 1  # a reset row pays 100
    assert (learned_q(algo, state, config, torch.ones(1, 3)) - 10).abs().max() < 0.3


@EACH
def test_after_a_termination_nothing_follows(monkeypatch, algo):
    config = small(algo, critic_hidden=(32,), critic_learning_rate=0.01)
    state, _ = ready(monkeypatch, algo, config, length=5)
    obs = torch.tensor([[1.0, 3.0, t] for t in range(5)])
    expected = [(1 - 0.9**k) / 0.1 for k in (5, 4, 3, 2, 1)]
    assert (learned_q(algo, state, config, obs) - torch.tensor(expected)).abs().max() < 0.5


@EACH
@pytest.mark.parametrize("mode", MODES)
def test_what_is_remembered_is_what_happened(monkeypatch, algo, mode):
    """Observations are (copy, episode, step): the successor is of the same episode, and the deaths are at step 3."""
    state, _ = ready(monkeypatch, algo, small(algo), Levers, mode, length=3)
    rows = state.replay.transitions[: len(state.replay)]
    assert len(state.replay) == (120 if mode == "NEXT_STEP" else 160)
    assert torch.equal(rows.next_obs, rows.obs + torch.tensor([0.0, 0.0, 1.0]))
    assert torch.equal(rows.terminated, rows.next_obs[:, 2] == 3)


@pytest.fixture
def strangers(monkeypatch, rng):
    """config, state and a batch of an algorithm whose target networks have nothing to do with the others."""

    def make(algo, **fields):
        config = small(algo, critic_hidden=(8,), **fields)
        state, _ = ready(monkeypatch, algo, config)
        for parameter in state.targets.parameters():
            parameter.data = torch.randn(parameter.shape, generator=rng)
        return config, state, state.replay.transitions[:50]

    return make


def q(critic, obs, action):
    return critic.net(torch.cat([obs, action], dim=-1))[:, 0]


def half_square(value, target):
    return 0.5 * (value - target).square().mean()


def test_ddpgs_target_is_of_the_target_networks_alone(strangers):
    config, state, batch = strangers(ddpg)
    loss, watched = ddpg.critic_loss(config, state.targets, state.networks.critic, batch)
    next_action = torch.tanh(state.targets.policy.net(batch.next_obs))
    target = batch.reward + 0.9 * q(state.targets.critic, batch.next_obs, next_action) * (1 - batch.terminated.float())
    value = q(state.networks.critic, batch.obs, batch.action)
    torch.testing.assert_close(loss, half_square(value, target))
    torch.testing.assert_close(watched["q"], value.mean())


def test_td3s_target_is_the_lower_of_two_at_a_noisy_action(strangers, rng):
    config, state, batch = strangers(td3, target_noise=0.8, target_noise_clip=0.3)
    noise = torch.randn(50, 1, generator=rng)
    loss, _ = td3.critic_loss(config, state.targets, state.networks.critic, batch, noise)
    off = (0.8 * noise).clamp(-0.3, 0.3)
    assert 5 < (off.abs() == 0.3).sum() < 45
    next_action = (torch.tanh(state.targets.policy.net(batch.next_obs)) + off).clamp(-1, 1)
    both = [q(critic, batch.next_obs, next_action) for critic in (state.targets.critic.one, state.targets.critic.two)]
    assert 0 < (both[0] < both[1]).sum() < 50
    target = batch.reward + 0.9 * torch.min(*both) * (1 - batch.terminated.float())
    online = state.networks.critic
    values = [q(critic, batch.obs, batch.action) for critic in (online.one, online.two)]
    torch.testing.assert_close(loss, half_square(values[0], target) + half_square(values[1], target))


def test_sacs_target_is_the_lower_of_two_less_the_price_of_the_action(strangers, rng):
    config, state, batch = strangers(sac, initial_temperature=0.3)
    actor = state.networks.actor
    noise = torch.randn(50, 1, generator=rng)
    loss, _ = sac.critic_loss(config, state.targets, actor, state.networks.critic, batch, noise)
    next_action, log_prob = state.policy(batch.next_obs).sample_with_log_prob(noise)
    both = [q(critic, batch.next_obs, next_action) for critic in (state.targets.one, state.targets.two)]
    target = batch.reward + 0.9 * (torch.min(*both) - 0.3 * log_prob) * (1 - batch.terminated.float())
    online = state.networks.critic
    values = [q(critic, batch.obs, batch.action) for critic in (online.one, online.two)]
    torch.testing.assert_close(loss, half_square(values[0], target) + half_square(values[1], target))


def test_sacs_policy_is_paid_for_entropy_and_its_temperature_steers_it(strangers, rng):
    config, state, batch = strangers(sac, initial_temperature=0.3, target_entropy=0.7)
    actor, noise = state.networks.actor, torch.randn(50, 1, generator=rng)
    critic = state.networks.critic
    loss, watched = sac.actor_loss(config, critic, actor, batch, noise)
    action, log_prob = state.policy(batch.obs).sample_with_log_prob(noise)
    value = torch.min(q(critic.one, batch.obs, action), q(critic.two, batch.obs, action))
    torch.testing.assert_close(watched["losses/actor"], (0.3 * log_prob - value).mean())
    torch.testing.assert_close(watched["losses/entropy"], -log_prob.mean())
    (gradient,) = torch.autograd.grad(loss, state.networks.temperature.log)
    # d/d log α of −α (log π + H̄): where entropy is above H̄, α falls under descent
    torch.testing.assert_close(gradient, -0.3 * (log_prob.mean() + 0.7).detach())


def test_sacs_entropy_reaches_its_target(monkeypatch):
    """The best policy would be sure of itself; a uniform one has log 2 = 0.69."""
    fields = {"initial_temperature": 1.0, "actor_learning_rate": 0.01, "target_entropy": -0.5, "gamma": 0.5}
    config = small(sac, critic_hidden=(8,), **fields)
    state, _ = ready(monkeypatch, sac, config, Greedy, length=None, horizon=4)
    for _ in range(600):
        watched = sac.update(config, state)
    entropy = [sac.update(config, state)["losses/entropy"].item() for _ in range(50)]
    assert np.mean(entropy) == pytest.approx(-0.5, abs=0.2)
    assert 0 < watched["temperature"] < 1


@EACH
def test_it_learns_to_copy_what_it_sees(algo):
    """Bounds that lie asymmetrically: the policy must be right about the scale."""
    torch.manual_seed(0)
    config = small(
        algo,
        "Copy-box-v0",
        hidden=(32,),
        critic_hidden=(32,),
        gamma=0.5,
        actor_learning_rate=3e-3,
        critic_learning_rate=3e-3,
    )
    env = VecEnv(GymnasiumBackend(config.env, 4, CPU))
    env.restart(0)
    state, rewards = algo.init(config, env.spec, CPU), []
    for t in range(900):
        algo.play(config, state, env)
        if t > 50:
            algo.update(config, state)
        rewards.append(state.replay.transitions.reward[len(state.replay) - 1].item())
    assert np.mean(rewards[:40]) < 0.55
    assert np.mean(rewards[-100:]) > 0.8


def moved(before, module):
    return [not torch.equal(a, b) for a, b in zip(before, module.parameters(), strict=True)]


@EACH
@pytest.mark.parametrize("delay", [1, 2])
def test_each_step_moves_what_it_should(monkeypatch, algo, delay):
    config = small(algo, critic_hidden=(8,), policy_delay=delay)
    state, _ = ready(monkeypatch, algo, config)
    parts = (state.networks.policy, state.networks.critic, state.targets)
    seen = []
    for _ in range(2):
        before = [[p.clone() for p in part.parameters()] for part in parts]
        algo.update(config, state)
        seen.append([all(moved(was, part)) for was, part in zip(before, parts, strict=True)])
        none = [not any(moved(was, part)) for was, part in zip(before, parts, strict=True)]
        assert all(a != b for a, b in zip(seen[-1], none, strict=True))
    assert seen == ([[True] * 3, [True] * 3] if delay == 1 else [[False, True, False], [True] * 3])
    assert (state.critic_descent.steps, state.actor_descent.steps) == (2, 2 // delay)


@EACH
def test_the_targets_follow_and_share_the_normalizer(monkeypatch, algo):
    config = small(algo, tau=0.25, normalize_observations=True, critic_hidden=(8,), policy_delay=1)
    state, _ = ready(monkeypatch, algo, config)
    follower = state.targets.one if algo is sac else state.targets.policy
    assert follower.normalizer is state.networks.policy.normalizer
    assert state.networks.policy.normalizer.count == 160
    online = state.networks.critic if algo is sac else state.networks
    before = [p.clone() for p in state.targets.parameters()]
    algo.update(config, state)
    for was, now, led in zip(before, state.targets.parameters(), online.parameters(), strict=True):
        torch.testing.assert_close(now, 0.75 * was + 0.25 * led)


def test_the_actors_gradient_is_that_of_q_through_the_action(monkeypatch):
    """By finite differences in float64."""
    config = small(critic_hidden=(8,))
    state, _ = ready(monkeypatch, ddpg, config)
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


@EACH
@pytest.mark.parametrize("mode", MODES)
def test_an_episode_hears_a_sequence_from_its_beginning(monkeypatch, algo, mode):
    state, env = ready(monkeypatch, algo, small(algo, noise="ou"), mode=mode, length=3)
    action_noise, counted = state.action_noise, 0
    for _ in range(12):
        age, held, before = env.obs[:, 2].long(), len(state.replay), action_noise._position.clone()
        algo.play(small(algo), state, env)
        if len(state.replay) > held:  # else the action was ignored
            assert torch.equal(before % action_noise._length, age)  # at its end the next one begins
            counted += 1
    assert counted == (9 if mode == "NEXT_STEP" else 12)


@EACH
@pytest.mark.parametrize("mode", MODES)
def test_the_normalizer_learns_from_what_is_remembered_and_nothing_else(monkeypatch, algo, mode):
    state, _ = ready(monkeypatch, algo, small(algo, normalize_observations=True), mode=mode, length=3)
    seen, normalizer = state.replay.transitions.obs[: len(state.replay)].double(), state.policy.normalizer
    assert normalizer.count == len(seen)
    torch.testing.assert_close(normalizer.mean, seen.mean(0))
    torch.testing.assert_close(normalizer.var, seen.var(0, correction=0))


@EACH
@pytest.mark.parametrize(
    "rhythm",
    [
        {},
        {"num_envs": 4, "learning_starts": 33},
        {"update_every": 3},  # no divisor of the steps between two lines of metrics
        {"update_every": 20},  # more than those
        {"num_envs": 4, "num_updates": 3, "update_every": 2},
    ],
)
def test_as_many_gradient_steps_are_taken_as_announced(tmp_path, algo, rhythm):
    fields = tiny_off_policy(**{"num_envs": 1, "evaluate_episodes": 1, **rhythm})
    name = algo.__name__.rpartition(".")[2]
    config = lem.config_for(name, "Pendulum-v1", **fields)
    run = lem.train(name, "Pendulum-v1", run=tmp_path / "r", progress=False, **fields)
    taken = checkpoint.read(run.path / "checkpoints" / "step-256").numbers["updates"]
    assert taken == config.gradient_steps


@EACH
def test_learning_rates_fall_linearly_over_the_run(monkeypatch, algo):
    rates = {"actor_learning_rate": 0.02, "critic_learning_rate": 0.1}
    config = small(algo, total_steps=1000, final_learning_rate=0.2, policy_delay=1, **rates)
    for step in (160, 500, 1000):
        state, _ = ready(monkeypatch, algo, config)
        state.step = step
        parts = {0.1: state.networks.critic, 0.02: state.networks.policy}
        before = [[p.clone() for p in part.parameters()] for part in parts.values()]
        algo.update(config, state)
        for (rate, part), was in zip(parts.items(), before, strict=True):
            furthest = max((p - q).abs().max().item() for p, q in zip(part.parameters(), was, strict=True))
            assert furthest == pytest.approx(rate * (1 - 0.8 * step / 1000), rel=1e-4)  # Adam's first step is α


def remembering(algo, config):
    """A state for three numbers in and one out, with a memory of noise; always the same."""
    torch.manual_seed(0)
    state = algo.init(config, Spec("x", (ObservationPart((), (3,)),), Box((-1.0,), (1.0,))), CPU)
    rows = (torch.randn(50, 3), torch.randn(50, 1), torch.randn(50), torch.randn(50, 3), torch.rand(50) < 0.3)
    state.replay.extend(Transition(*rows))
    return state


def same_after(updates, algo, config, states, **close):
    for _ in range(updates):
        a, b = (algo.update(config, state) for state in states)
        assert a.keys() == b.keys()
        for key in a:
            torch.testing.assert_close(a[key], b[key], **close)
    for name in ("networks", "targets"):
        for p, q in zip(*(getattr(state, name).parameters() for state in states), strict=True):
            torch.testing.assert_close(p, q, **close)


def engines_agree(algo, delay=1, updates=1, matmul="float32"):
    """Native and eager, from the same memory and the same random numbers."""
    layers = {"hidden": (16, 16), "critic_hidden": (8, 8), "matmul": matmul}
    close = {"rtol": 1e-3, "atol": 1e-4} if matmul == "float32" else {"rtol": 2**-6, "atol": 2**-6}
    config = small(algo, policy_delay=delay, num_updates=updates, tau=0.3, critic_learning_rate=1e-3, **layers)
    states = [remembering(algo, config), remembering(algo, config)]
    states[1].joint.make_native()
    same_after(2 * delay, algo, config, states, **close)
    programs = states[1].joint._programs
    assert len(programs) == delay // updates
    assert all(program._chosen is program._compiled for program in programs.values())


@pytest.mark.parametrize("case", ["ddpg, delay=2, updates=2", "td3, delay=2", "sac", "ddpg, matmul='bfloat16'"])
def test_the_two_engines_agree(case):
    """In a process of its own: the shape checks of this one are not for the compiler."""
    code = f"from test_off_policy import *; engines_agree({case})"
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@EACH
def test_many_steps_are_several_calls_of_the_same_size(monkeypatch, algo):
    """Six steps, the policy's turn at every fourth of all: two calls of three, of turns that differ."""
    monkeypatch.setattr("lemniscate.nn.joint.Native", lambda function, otherwise, device: otherwise)
    config = small(algo, num_updates=6, policy_delay=4, tau=0.3)
    states = [remembering(algo, config), remembering(algo, config)]
    states[1].joint.make_native()
    same_after(2, algo, config, states)
    assert set(states[1].joint._programs) == {(i == 0, i == 1, i == 2) for i in range(4)}


@EACH
def test_actions_are_random_while_it_warms_up_and_the_policys_afterwards(monkeypatch, algo):
    config = small(algo, learning_starts=160, **({} if algo is sac else {"noise_std": 0.05}))
    state, env = ready(monkeypatch, algo, config)
    warm = state.replay.transitions.action[:160]
    assert warm.min() < -0.9
    assert warm.max() > 0.9
    assert warm.std().item() == pytest.approx(1 / 3**0.5, abs=0.05)
    drawn, action_noise = [], state.action_noise
    state.action_noise = lambda generator: drawn.append(action_noise(generator)) or drawn[-1]
    state.action_noise.cut, obs = action_noise.cut, env.obs
    algo.play(config, state, env)
    action = state.replay.transitions.action[160:164]
    if algo is sac:
        assert torch.equal(action, state.policy.act(obs, drawn[0]))
    else:
        assert 0 < (action - state.policy(obs).mode()).abs().max() < 0.25


@EACH
def test_what_it_will_take_is_said_before_it_is_taken(tmp_path, monkeypatch, capsys, algo):
    def refuse(*_):
        raise MemoryError

    monkeypatch.setattr(algo, "ReplayBuffer", refuse)
    monkeypatch.setattr("lemniscate.run.run.has_bfloat16", lambda _: False)
    fields = tiny_off_policy(matmul="bfloat16", buffer_size=200)
    with pytest.raises(MemoryError):
        lem.train(algo.__name__.rpartition(".")[2], "Pendulum-v1", run=tmp_path / "r", progress=True, **fields)
    said = capsys.readouterr().err
    assert "It will remember 200 transitions: 0.0 MB" in said  # 33 bytes each
    assert "no products in bfloat16" in said


@pytest.mark.parametrize("algorithm", ["ddpg", "td3", "sac"])
@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"env": "CartPole-v1"}, "has Discrete actions; this algorithm needs continuous ones"),
        ({"env": "Unbounded-v0"}, "has actions without bounds"),
        ({"learning_starts": 10_000, "total_steps": 10_000}, "learning_starts must be below total_steps"),
        ({"update_every": 2000, "total_steps": 1500}, "update_every 2,000 is so large that nothing is ever learned"),
        ({"architecture": "simba", "hidden": (64, 32)}, "SimBa's blocks have one width"),
        ({"architecture": "simba", "critic_hidden": ()}, "SimBa's blocks have one width"),
        ({"buffer_size": 100}, "buffer_size 100 .* below batch_size 128"),
        ({"buffer_size": 200, "num_envs": 201}, "buffer_size 200 .* below num_envs 201"),
        ({"buffer_size": 10**12, "total_steps": 10**12}, "choose buffer_size at most"),
    ],
)
def test_what_cannot_be_trained_gets_its_sentence_and_leaves_nothing(tmp_path, algorithm, fields, sentence):
    with pytest.raises(UserError, match=sentence):
        lem.train(algorithm, run=tmp_path / "run", progress=False, **{"env": "Pendulum-v1", **fields})
    assert not (tmp_path / "run").exists()
