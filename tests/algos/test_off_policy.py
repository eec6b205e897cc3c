"""DDPG, TD3 and SAC alike, on environments with known values."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch

import environments
import lemniscate as lem
from conftest import tiny_off_policy
from helpers import (
    COMPILERS,
    CPU,
    ONE_MODE,
    CompiledCalls,
    Loop,
    begin_off_policy,
    copy_of,
    equal,
    long,
    play,
    require_in_own_process,
    small_off_policy,
    spec_of,
    vectorize,
)
from lemniscate.algos import ddpg, sac, td3
from lemniscate.errors import UserError
from lemniscate.maths import uniform
from lemniscate.optim.compiled import Compiler
from lemniscate.run import checkpoint
from lemniscate.system.world import ALONE
from lemniscate.types import Transition

ALGORITHMS = {"ddpg": ddpg, "td3": td3, "sac": sac}
EACH = pytest.mark.parametrize("algo", ALGORITHMS.values(), ids=ALGORITHMS)


def learned_q(algo, state, config, obs):
    for _ in range(400):
        algo.update(config, state)
    return state.networks.critics(obs, torch.zeros(len(obs), 1))  # [C, B]


@EACH
@pytest.mark.parametrize("mode", ONE_MODE)
def test_values_are_bootstrapped_at_time_limits_and_ignore_reset_rows(algo, mode):
    config = small_off_policy(algo, "EndlessLevers-v0", policy_delay=1)
    state, _ = begin_off_policy(algo, config, mode, length=None, horizon=4)
    assert state.replay.transitions.reward.max() == 1  # a reset row pays 100
    assert (learned_q(algo, state, config, torch.ones(1, 3)) - 10).abs().max() < 0.3


@EACH
def test_values_end_at_terminations(algo):
    config = small_off_policy(algo, critic_hidden=(32,), critic_learning_rate=0.01)
    state, _ = begin_off_policy(algo, config, length=5)
    obs = torch.tensor([[1.0, 3.0, t] for t in range(5)])
    expected = [(1 - 0.9**k) / 0.1 for k in (5, 4, 3, 2, 1)]
    assert (learned_q(algo, state, config, obs) - torch.tensor(expected)).abs().max() < 0.5


@pytest.mark.parametrize("algo", [sac, *long(ddpg, td3)])
def test_learns_to_copy_its_observation(algo):
    """Bounds that lie asymmetrically: the policy must be right about the scale."""
    torch.manual_seed(0)
    widths, rates = {"hidden": (32,), "critic_hidden": (32,)}, ("actor_learning_rate", "critic_learning_rate")
    config = small_off_policy(algo, "Copy-box-v0", gamma=0.5, **widths, **dict.fromkeys(rates, 3e-3))
    env = vectorize(config.env)
    state, rewards = algo.init(config, env.spec, CPU), []
    for t in range(900):
        play(config, state, env)
        if t > 50:
            algo.update(config, state)
        rewards.append(state.replay.transitions.reward[len(state.replay) - 1].item())
    assert np.mean(rewards[:40]) < 0.55
    assert np.mean(rewards[-100:]) > 0.8


@EACH
@pytest.mark.parametrize("delay", [1, 2])
def test_policy_and_targets_move_at_every_dth_step_of_the_critics(algo, delay):
    config = small_off_policy(algo, critic_hidden=(8,), policy_delay=delay)
    state, _ = begin_off_policy(algo, config)
    parts = (state.networks.policy, state.networks.critics, state.targets)
    found = []
    for _ in range(2):
        before = [copy_of(part.parameters()) for part in parts]
        algo.update(config, state)
        same = [equal(was, part.parameters()) for was, part in zip(before, parts, strict=True)]
        assert all(all(part) or not any(part) for part in same)
        found.append([not any(part) for part in same])
    assert found == ([[True] * 3, [True] * 3] if delay == 1 else [[False, True, False], [True] * 3])
    assert (state.critic_optimizer.steps, state.actor_optimizer.steps) == (2, 2 // delay)
    if algo is sac:
        assert state.temperature_optimizer.steps == 2 // delay


@EACH
def test_targets_follow_and_share_the_normalizer(algo):
    config = small_off_policy(algo, tau=0.25, normalize_observations=True, critic_hidden=(8,), policy_delay=1)
    state, _ = begin_off_policy(algo, config)
    critics = state.targets if algo is sac else state.targets.critics
    assert critics.members[0].normalizer is state.networks.policy.normalizer
    if algo is not sac:
        assert state.targets.policy.normalizer is state.networks.policy.normalizer
    assert state.networks.policy.normalizer.count == 160
    online = state.networks.critics if algo is sac else state.networks
    before = copy_of(state.targets.parameters())
    algo.update(config, state)
    for was, now, followed in zip(before, state.targets.parameters(), online.parameters(), strict=True):
        torch.testing.assert_close(now, 0.75 * was + 0.25 * followed)


@EACH
def test_actions_are_random_before_learning_starts_and_those_of_the_policy_afterwards(algo):
    """In `train`; a twin of the state draws the same noise."""
    config = small_off_policy(algo, learning_starts=160, **({} if algo is sac else {"noise_std": 0.05}))
    env = vectorize("Levers-v0", mode="DISABLED", length=None)
    torch.manual_seed(0)
    twin = algo.init(config, env.spec, CPU)
    torch.manual_seed(0)
    state = algo.train(config, Loop(env, 5))
    noise = torch.stack([twin.action_noise(twin.rng.action) for _ in range(41)])
    actions, obs = (
        part[:164].unflatten(0, (41, 4)) for part in (state.replay.transitions.action, state.replay.transitions.obs)
    )
    random = actions[:40]
    assert torch.equal(random, uniform(noise[:40]))
    assert random.min() < -0.9
    assert random.max() > 0.9
    assert random.std().item() == pytest.approx(1 / 3**0.5, abs=0.05)
    assert state.step == 200
    assert state.updates == 10
    if algo is sac:
        assert torch.equal(actions[40], twin.policy.act(obs[40], noise[40]))
    else:
        assert torch.equal(actions[40], twin.policy.act(obs[40], 0.05 * noise[40]))
        assert 0 < (actions[40] - twin.policy(obs[40]).mode()).abs().max() < 0.25


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
def test_as_many_gradient_steps_are_taken_as_the_config_says(tmp_path, algo, rhythm):
    fields = tiny_off_policy(**{"num_envs": 1, "evaluate_episodes": 1, **rhythm})
    name = algo.__name__.rpartition(".")[2]
    config = lem.config_for(name, "Pendulum-v1", **fields)
    run = lem.train(name, "Pendulum-v1", run=tmp_path / "r", progress=False, **fields)
    taken = checkpoint.read(run.path / "checkpoints" / "step-256").numbers["updates"]
    assert taken == config.gradient_steps


@EACH
def test_learning_rates_fall_linearly_over_the_run(algo):
    rates = {"actor_learning_rate": 0.02, "critic_learning_rate": 0.1}
    rates |= {"initial_temperature": 0.1} if algo is sac else {}
    config = small_off_policy(algo, total_steps=1000, final_learning_rate=0.2, policy_delay=1, **rates)
    for step in (160, 500, 1000):
        state, _ = begin_off_policy(algo, config)
        state.step = step
        parts = [(0.1, state.networks.critics), (0.02, state.networks.policy)]
        if algo is sac:
            parts.append((0.02, state.networks.temperature))
        before = [copy_of(part.parameters()) for _, part in parts]
        algo.update(config, state)
        for (rate, part), was in zip(parts, before, strict=True):
            furthest = max((p - q).abs().max().item() for p, q in zip(part.parameters(), was, strict=True))
            assert furthest == pytest.approx(rate * (1 - 0.8 * step / 1000), rel=1e-4)  # Adam's first step is α


@EACH
def test_a_learning_rate_follows_its_schedule(algo):
    rates = {"actor_learning_rate": "0.02>0.01", "critic_learning_rate": "0.1>0"}
    config = small_off_policy(algo, total_steps=1000, policy_delay=1, **rates)
    state, _ = begin_off_policy(algo, config)
    state.step = 250
    parts = [(0.075, state.networks.critics), (0.0175, state.networks.policy)]
    before = [copy_of(part.parameters()) for _, part in parts]
    algo.update(config, state)
    for (rate, part), was in zip(parts, before, strict=True):
        furthest = max((p - q).abs().max().item() for p, q in zip(part.parameters(), was, strict=True))
        assert furthest == pytest.approx(rate, rel=1e-4)


@pytest.mark.parametrize("algo", [ddpg, td3])
def test_action_noise_follows_its_schedule(algo, tmp_path, monkeypatch):
    given = []
    interact = algo.interact

    def record(*args, noise_std, **rest):
        given.append(noise_std)
        return interact(*args, noise_std=noise_std, **rest)

    monkeypatch.setattr(algo, "interact", record)
    fields = tiny_off_policy(noise_std="0.4>0.2", total_steps=64, learning_starts=8, num_envs=2)
    lem.train(algo.__name__.rpartition(".")[2], "Pendulum-v1", run=tmp_path / "r", progress=False, **fields)
    assert given == pytest.approx([0.4 - 0.2 * step / 64 for step in range(0, 64, 2)])


def filled(algo, config):
    """A state for five numbers in and two out, with a replay buffer of noise; always the same."""
    torch.manual_seed(0)
    state = algo.init(config, spec_of("box"), CPU)
    rows = (torch.randn(50, 5), torch.rand(50, 2) * 2 - 1, torch.randn(50), torch.randn(50, 5), torch.rand(50) < 0.3)
    state.replay.extend(Transition(*rows))
    return state


def require_same_updates(updates, algo, config, states, **close):
    for _ in range(updates):
        a, b = (algo.update(config, state) for state in states)
        assert a.keys() == b.keys()
        for key in a:
            torch.testing.assert_close(a[key], b[key], **close)
    for name in ("networks", "targets"):
        for p, q in zip(*(getattr(state, name).parameters() for state in states), strict=True):
            torch.testing.assert_close(p, q, **close)


def compiled_equals_eager(algo, delay=1, updates=1, matmul="float32"):
    """From the same replay buffer and the same random numbers."""
    compiled = CompiledCalls()
    layers = {"hidden": (16, 16), "critic_hidden": (8, 8), "matmul": matmul}
    close = {"rtol": 1e-3, "atol": 1e-4} if matmul == "float32" else {"rtol": 2**-6, "atol": 2**-6}
    fields = {"policy_delay": delay, "num_updates": updates, "tau": 0.3, "critic_learning_rate": 1e-3}
    config = small_off_policy(algo, **fields, **layers)
    states = [filled(algo, config), filled(algo, config)]
    states[1].prepare(ALONE, Compiler())
    require_same_updates(2 * delay, algo, config, states, **close)
    _, *programs = compiled.calls  # the first one is `act`, which no update calls
    assert len(programs) == delay // updates
    assert sum(programs) == 2 * delay


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("case", long("ddpg, delay=2, updates=2", "td3, delay=2", "ddpg, matmul='bfloat16'"))
def test_traced_updates_equal_eager_ones(case, compiler):
    require_in_own_process(__name__, f"compiled_equals_eager({case})", compiler)


@pytest.mark.long
def test_compiled_updates_equal_eager_ones():
    require_in_own_process(__name__, "compiled_equals_eager(sac)")


@EACH
def test_many_steps_are_compiled_in_calls_of_one_size_with_the_flags_of_their_steps(monkeypatch, capsys, algo):
    """Six steps, the policy's at every fourth of all: two calls of three, with flags that differ."""
    flags = []

    def fails(*_, update_actor, **__):
        flags.append(update_actor)
        raise RuntimeError("no compiler")

    monkeypatch.setattr(torch, "compile", lambda *_, **__: fails)
    config = small_off_policy(algo, num_updates=6, policy_delay=4, tau=0.3)
    states = [filled(algo, config), filled(algo, config)]
    states[1].prepare(ALONE, Compiler())
    require_same_updates(2, algo, config, states)
    assert flags == [(i == 0, i == 1, i == 2) for i in (3, 0, 1, 2)]
    assert capsys.readouterr().err.count("torch.compile failed (no compiler)") == 4


@EACH
def test_a_warm_start_copies_the_loaded_networks_into_the_targets(algo):
    config = small_off_policy(algo, critic_hidden=(8,))
    state, _ = begin_off_policy(algo, config)
    loaded = copy.deepcopy(state.networks)
    with torch.no_grad():
        for parameter in loaded.parameters():
            parameter.add_(1.0)
    state.networks.load_state_dict(loaded.state_dict())
    state.on_warm_start()
    online = state.networks.critics if algo is sac else state.networks
    assert all(equal(online.parameters(), state.targets.parameters()))


@EACH
def test_the_size_of_the_replay_buffer_is_told_before_it_is_allocated(tmp_path, monkeypatch, capsys, algo):
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict)
    name, path = algo.__name__.rpartition(".")[2], tmp_path / "r"
    large = tiny_off_policy(buffer_size=10**11, total_steps=10**12)
    message = "3,300,000 MB are for buffer_size 100000000000; .* choose buffer_size at most"  # 33 bytes each
    with pytest.raises(UserError, match=message):
        lem.train(name, "Pendulum-v1", run=path, progress=True, **large)
    stop = [lambda *_: True]
    small = tiny_off_policy(matmul="bfloat16", buffer_size=10_000, total_steps=20_000)
    lem.train(name, "Pendulum-v1", run=path, progress=True, callbacks=stop, **small)
    printed = capsys.readouterr().err
    assert "10,000 transitions, 0.3 MB" in printed
    assert "no products in bfloat16" in printed


@pytest.mark.parametrize("algorithm", ["ddpg", "td3", "sac"])
@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"env": "CartPole-v1"}, "has Discrete actions; this algorithm needs continuous ones"),
        ({"env": "Unbounded-v0"}, "has actions without bounds"),
        ({"learning_starts": 10_000, "total_steps": 10_000}, "learning_starts must be below total_steps"),
        ({"update_every": 2000, "total_steps": 1500}, "update_every 2,000 is so large that nothing is ever learned"),
        ({"network": "simba", "hidden": (64, 32)}, "SimBa's blocks have one width"),
        ({"network": "simba", "critic_hidden": ()}, "SimBa's blocks have one width"),
        ({"buffer_size": 100}, "buffer_size 100 .* below the 128 rows of batch_size 128"),
        ({"buffer_size": 200, "num_envs": 201}, "buffer_size 200 .* below the 201 rows of num_envs 201"),
        (
            {"env": "Ant-v5", "symmetry": "on", "buffer_size": 256, "num_envs": 200},
            "buffer_size 256 .* below the 400 rows of num_envs 200",
        ),
        ({"buffer_size": 10**12, "total_steps": 10**12}, "choose buffer_size at most"),
    ],
)
def test_impossible_settings_are_an_error_and_leave_nothing(tmp_path, algorithm, fields, message):
    with pytest.raises(UserError, match=message):
        lem.train(algorithm, run=tmp_path / "run", progress=False, **{"env": "Pendulum-v1", **fields})
    assert not (tmp_path / "run").exists()


class Sight(environments.Pictures):
    """Pictures of a few bytes, which the signals look at as at numbers."""

    action_space = gym.spaces.Box(-1, 1, (1,))


@pytest.mark.parametrize("shape", [(4, 4, 3), (8, 8, 1)])
def test_small_images_are_learned_from(tmp_path, shape):
    fields = tiny_off_policy(total_steps=100) | {"env_kwargs": {"shape": shape}}
    run = lem.train("ddpg", Sight, run=tmp_path / "r", progress=False, **fields)
    assert run.policy.step >= 100
