"""Networks with a memory: what is remembered, when it is forgotten, and what gradients go through."""

import json
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn

import environments  # noqa: F401  (registers Copy)
import lemniscate as lem
from conftest import tiny_fields
from helpers import long
from lemniscate.algos import a2c, ppo, reppo, trpo
from lemniscate.api.policy import TrainedPolicy
from lemniscate.data.rollout import collect, epoch_minibatches, rows_of
from lemniscate.envs import registry
from lemniscate.errors import UserError
from lemniscate.exporting import compiled, parity
from lemniscate.exporting import export as exporting
from lemniscate.exporting.compiled import host_compiler
from lemniscate.exporting.deployed import act_with, memory_size
from lemniscate.exporting.parity import compare, fly
from lemniscate.nn.memory import GRU, Carrier, OwnCell, Remembering
from lemniscate.run.evaluate import play_episodes
from lemniscate.testing import check_resume

ALGORITHMS = {"ppo": ppo, "a2c": a2c, "trpo": trpo, "reppo": reppo}
L = 4
SETTINGS = {"network": "gru", "hidden": (8,), "num_envs": 4, "num_steps": 8, "sequence_length": L, "total_steps": 64}


class Leaky(nn.Module):
    """A module of one's own with a memory: a running mean of features."""

    memory_size = 3

    def __init__(self, inputs, outputs):
        super().__init__()
        self.features, self.head = nn.Linear(inputs, 3), nn.Linear(3, outputs)

    def forward(self, x, memory):
        after = 0.9 * memory + 0.1 * torch.tanh(self.features(x))
        return self.head(after), after


class Recite(gym.Env):
    """Shows one of two letters at the first step; the last action must repeat it. Without a memory the return is 0."""

    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(2)

    def __init__(self, length=4):
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.letter, self.t = int(self.np_random.integers(2)), 0
        return self._show(), {}

    def step(self, action):
        self.t += 1
        over = self.t == self.length
        return self._show(), float(over) * (1.0 if action == self.letter else -1.0), over, False, {}

    def _show(self):
        return np.array([2 * self.letter - 1 if self.t == 0 else 0, self.t == self.length - 1], np.float32)


def begin(algo, env="CartPole-v1", **fields):
    """A state, and environments that carry its memory, restarted."""
    minibatch = {ppo: "minibatch_size", reppo: "minibatch_size", trpo: "critic_minibatch_size"}.get(algo)
    config = algo.Config(env="x", **{**SETTINGS, **({minibatch: 16} if minibatch else {}), **fields})
    made = registry.make(env, config.num_envs)
    torch.manual_seed(0)
    state = algo.init(config, made.spec, torch.device("cpu"))
    with torch.no_grad():
        for parameter in state.networks.parameters():
            parameter += 0.3 * torch.randn(parameter.shape)
    made.carrier = Carrier(state.networks.memory, state.networks.remember)
    made.restart(0)
    return config, state, made


def kept_of(memory, rows):
    """The columns of the policy's memory and of the critic's, marks included."""
    sizes = [memory.observation, memory.policy, memory.privileged, memory.critic]
    _, own, _, critics, _ = rows.split([*sizes, rows.shape[-1] - sum(sizes)], dim=-1)
    return own, critics


# The recurrence


def test_a_gru_is_torchs():
    torch.manual_seed(0)
    mine, theirs = GRU(nn.Identity(), 5, 6).double(), nn.GRUCell(5, 6).double()
    theirs.load_state_dict(
        {
            "weight_ih": mine.input.weight,
            "weight_hh": mine.state.weight,
            "bias_ih": torch.randn(18, out=mine.input.bias.data),
            "bias_hh": torch.randn(18, out=mine.state.bias.data),
        }
    )
    x, h = torch.randn(7, 5, dtype=torch.float64), torch.randn(7, 6, dtype=torch.float64)
    torch.testing.assert_close(mine.step(mine.prepare(x), h)[0], theirs(x, h), rtol=0, atol=1e-14)


def random_pieces(dtype=torch.float64):
    torch.manual_seed(1)
    gru = GRU(nn.Identity(), 5, 6).to(dtype)
    nn.init.normal_(gru.state.bias)
    prepared = torch.randn(3, 7, 18, dtype=dtype, requires_grad=True)
    return gru, prepared, torch.rand(3, 7, 1) > 0.3, torch.randn(3, 7, 6, dtype=dtype)


def test_pieces_are_the_steps_one_after_the_other_and_so_are_their_derivatives():
    """To the second, which the Fisher product of trpo takes; the plain loop of one's own modules is the oracle."""
    gru, prepared, goes_on, memory = random_pieces()
    inputs, weight = [prepared, *gru.state.parameters()], torch.randn(3, 7, 6, dtype=torch.float64)
    found = []
    for over in (gru.over, partial(OwnCell.over, gru)):
        out = over(prepared, goes_on, memory)
        first = torch.autograd.grad((weight * out + out**2).sum(), inputs, create_graph=True)
        mixed = sum((gradient * torch.sin(1 + gradient)).sum() for gradient in first)
        found.append([out, *first, *torch.autograd.grad(mixed, inputs)])
    for mine, plain in zip(*found, strict=True):
        torch.testing.assert_close(mine, plain, rtol=1e-12, atol=1e-12)


def test_gradients_of_pieces_are_differences():
    gru, prepared, goes_on, memory = random_pieces()

    def over(prepared, weight, bias):
        return torch.func.functional_call(
            gru, {"state.weight": weight, "state.bias": bias}, (prepared, goes_on, memory)
        )

    gru.forward = gru.over
    inputs = prepared, gru.state.weight, gru.state.bias
    assert torch.autograd.gradcheck(over, inputs, check_forward_ad=True, fast_mode=True, raise_exception=False)


@pytest.mark.parametrize("fields", [{}, {"critic_hidden": (6,)}, {"shared_memory": True}])
@pytest.mark.parametrize("in_pieces", [False, True])
def test_a_policy_and_a_value_side_by_side_say_what_each_says_alone(fields, in_pieces):
    _, state, env = begin(ppo, **fields)
    rollout, networks = collect(env, state.policy, 8, state.rng.action), state.networks
    obs = rollout.obs.flatten(0, 1)
    if in_pieces:
        obs = obs[rows_of(rollout, L)]
    weights, found = torch.randn(2, *obs.shape[:-1]), []
    for policy, value in (networks(obs), (networks.policy(obs), networks.value(obs))):
        total = (weights[0] * policy.log_prob(torch.ones(obs.shape[:-1], dtype=torch.int64)) + weights[1] * value).sum()
        found.append([policy.logits, value, *torch.autograd.grad(total, [*networks.parameters()])])
    for together, alone in zip(*found, strict=True):
        torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-5)


def test_a_row_with_a_zero_in_front_starts_from_its_own_memory():
    gru, prepared, goes_on, memory = random_pieces()
    goes_on[:] = True
    goes_on[:, 3] = False
    whole = gru.over(prepared, goes_on, memory)
    torch.testing.assert_close(whole[:, 3:], gru.over(prepared[:, 3:], goes_on[:, 3:], memory[:, 3:]), rtol=0, atol=0)
    gradient = torch.autograd.grad(whole[:, 3:].sum(), prepared)[0]
    assert not gradient[:, :3].any()
    assert gradient[:, 3:].all()


# What is carried


@pytest.mark.parametrize("algo", ALGORITHMS.values(), ids=ALGORITHMS)
def test_what_is_carried_is_what_the_episode_says_alone(algo):
    """A recurrence over each episode from zeros, in another program; at an end, V's row has the memory of the old one."""
    _, state, env = begin(algo, "Pendulum-v1" if algo is reppo else "CartPole-v1")
    rollout, networks = collect(env, state.policy, 40, state.rng.action), state.networks
    memory, cells = networks.memory, [networks.policy.net, (networks.critic if algo is reppo else networks.value).net]
    assert rollout.done.any() or algo is reppo
    for i in range(4):
        h = [torch.zeros(1, cell.cell.size) for cell in cells]
        for t in range(40):
            row, after = rollout.obs[t, i : i + 1], rollout.next_obs[t, i : i + 1]
            for j, (kept, next_kept) in enumerate(zip(kept_of(memory, row), kept_of(memory, after), strict=True)):
                torch.testing.assert_close(kept[:, 1:], h[j], rtol=0, atol=1e-6)
                assert kept[0, 0] == (t % L != 0 and not (t and rollout.done[t - 1, i]))
                normalizer = networks.policy.normalizer
                obs = normalizer(row)[:, : memory.observation]
                h[j] = cells[j].cell.step(cells[j].cell.prepare(cells[j].encoder(obs)), h[j])[1].detach()
                torch.testing.assert_close(next_kept[:, 1:], h[j], rtol=0, atol=1e-6)
            if rollout.done[t, i] or not rollout.valid[t, i]:
                h = [torch.zeros_like(x) for x in h]


def test_the_memory_goes_on_from_one_rollout_to_the_next():
    _, state, env = begin(ppo)
    first = collect(env, state.policy, 8, state.rng.action)
    second = collect(env, state.policy, 8, state.rng.action)
    own = kept_of(state.networks.memory, second.obs)[0]
    assert torch.equal(second.obs[0, :, 5:13][~first.done[-1]], first.next_obs[-1, :, 5:13][~first.done[-1]])
    assert own[0, :, 1:].any()


@pytest.mark.parametrize("algo", [ppo, a2c, trpo], ids=["ppo", "a2c", "trpo"])
def test_in_pieces_the_policy_says_what_it_said_when_it_acted(algo):
    """So every probability ratio is 1 at first; where pieces are as many as environments, to the last bit."""
    _, state, env = begin(algo, num_envs=8)
    rollout = collect(env, state.policy, 40, state.rng.action)
    assert rollout.done.any()
    networks, rows = state.networks, rows_of(rollout, L)
    value, _ = networks.estimates(rollout.obs, rollout.next_obs)
    log_prob = networks.log_prob(rollout.obs, rollout.action)
    flat = rollout.obs.flatten(0, 1)
    valid = rollout.valid.flatten()[rows]
    again = networks.policy(flat[rows]).log_prob(rollout.action.flatten(0, 1)[rows])
    torch.testing.assert_close(again[valid], log_prob.flatten()[rows][valid], rtol=0, atol=1e-6)
    torch.testing.assert_close(networks.value(flat[rows])[valid], value.flatten()[rows][valid], rtol=0, atol=1e-5)


def test_pieces_are_whole_steps_of_one_environment():
    _, state, env = begin(ppo)
    rollout = collect(env, state.policy, 8, state.rng.action)
    rows = rows_of(rollout, L)
    assert rows.shape == (8, L)
    assert torch.equal(rows % 4, rows[:, :1].expand(-1, L) % 4)
    assert sorted(rows.flatten().tolist()) == list(range(32))
    shuffled = epoch_minibatches(rows, 32, 16, torch.Generator().manual_seed(0))
    assert shuffled.shape == (2, 4, L)
    assert sorted(map(tuple, shuffled.flatten(0, 1).tolist())) == sorted(map(tuple, rows.tolist()))
    assert not torch.equal(shuffled.flatten(0, 1), rows)


def test_a_piece_with_a_reset_row_has_its_first_valid_row_in_the_place():
    _, state, env = begin(ppo, "toy:Countdown-v0")
    rollout = collect(env, state.policy, 40, state.rng.action)
    rows = rows_of(rollout, L)
    assert rollout.valid.flatten()[rows].all()
    assert (rollout.valid.all()) == (sorted(rows.flatten().tolist()) == list(range(rows.numel())))


def test_the_normalizer_sees_each_row_once_and_no_memory():
    config, state, env = begin(ppo)
    rollout = collect(env, state.policy, 8, state.rng.action)
    ppo.update(config, state, rollout)
    own, remembered = state.policy.normalizer.parts
    assert own.count == pytest.approx(rollout.valid.sum().item(), abs=1)
    torch.testing.assert_close(own.mean.float(), rollout.obs[..., :4].flatten(0, 1).mean(0), rtol=1e-3, atol=1e-3)
    assert remembered.size == 9
    assert not list(remembered.buffers())


@pytest.mark.parametrize("shared", [False, True])
def test_policy_and_value_have_memories_of_their_own_or_share_one(shared):
    _, state, env = begin(ppo, shared_memory=shared)
    networks = state.networks
    assert isinstance(networks.value.net, Remembering) != shared
    assert networks.memory.critic == (0 if shared else 9)
    rollout = collect(env, state.policy, 8, state.rng.action)
    other = rollout.obs.clone()
    other[..., 5:13] += 1  # the policy's
    assert torch.equal(networks.value(rollout.obs), networks.value(other)) != shared


# Learning


@pytest.mark.parametrize("algo", ["a2c", *long("ppo", "trpo")])
def test_with_a_memory_the_letter_is_recited(algo):
    """A memoryless policy cannot do better than chance; it is shown beside."""
    settings = {"num_envs": 16, "num_steps": 16, "hidden": (16,), "sequence_length": 4, "normalize_observations": False}
    settings |= {"ppo": {"minibatch_size": 64, "learning_rate": 3e-3}, "trpo": {"critic_minibatch_size": 64}}.get(
        algo, {"learning_rate": 3e-3}
    )
    found = {}
    for network in ("gru", "mlp"):
        steps = 20_000 if algo == "a2c" else 10_000
        run = lem.train(algo, Recite, total_steps=steps, network=network, seed=1, progress=False, **settings)
        found[network] = lem.evaluate(run.policy, episodes=40, seed=0).mean_return
    assert found["gru"] == 1
    assert abs(found["mlp"]) < 0.6


@pytest.mark.parametrize("algo", ["ppo", *long("a2c", "trpo")])
@pytest.mark.parametrize("kind", ["box", "discrete", "multi-discrete", "multi-binary", "tuple", "image", "masked"])
def test_every_kind_of_observation_and_action_is_learned_from(kind, algo, tmp_path):
    minibatch = {"ppo": {"minibatch_size": 16}, "trpo": {"critic_minibatch_size": 16}}.get(algo, {})
    run = lem.train(algo, f"Copy-{kind}-v0", run=tmp_path / "r", progress=False, **SETTINGS, **minibatch)
    scores = lem.evaluate(run.policy, episodes=3, seed=0)
    assert scores == lem.evaluate(lem.load(run.path), episodes=3, seed=0)
    assert min(scores.returns) > -50  # in "masked", no action that is ruled out


@pytest.mark.parametrize(
    ("algo", "network"),
    [
        ("ppo", "gru"),
        *(
            pytest.param(algo, network, marks=pytest.mark.long)
            for algo in ALGORITHMS
            for network in ("gru", "test_memory:Leaky")
            if (algo, network) != ("ppo", "gru")
        ),
    ],
)
def test_a_resumed_run_ends_in_the_bits_of_one_that_was_not_stopped(algo, network, tmp_path):
    env = "Pendulum-v1" if algo == "reppo" else "CartPole-v1"
    minibatch = {"ppo": "minibatch_size", "reppo": "minibatch_size", "trpo": "critic_minibatch_size"}.get(algo)
    fields = SETTINGS | {"network": network, "total_steps": 256} | ({minibatch: 16} if minibatch else {})
    check_resume(algo, tmp_path, env=env, **fields, checkpoint_every=64, evaluate_episodes=2)


def test_a_module_of_ones_own_that_forgets_to_return_its_memory_is_refused():
    for name, said in (("Forgets", "memory_size"), ("Short", "memory")):
        with pytest.raises(UserError, match=said):
            lem.train(
                "ppo",
                "CartPole-v1",
                **{**SETTINGS, "network": f"test_memory:{name}"},
                minibatch_size=16,
                progress=False,
            )


class InPlace(Leaky):
    def forward(self, x, memory):
        memory.mul_(0.9).add_(0.1 * torch.tanh(self.features(x)))
        return self.head(memory), memory


def test_a_module_may_write_its_memory_in_place(tmp_path):
    found = []
    for name in ("Leaky", "InPlace"):
        fields = SETTINGS | {"network": f"test_memory:{name}", "minibatch_size": 16, "progress": False}
        policy = lem.train("ppo", "CartPole-v1", run=tmp_path / name, **fields).policy
        found.append([p for p in policy.networks.state_dict().values()])
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


class Forgets(Leaky):
    def forward(self, x, memory):
        return self.head(torch.tanh(self.features(x)))


class Short(Leaky):
    def forward(self, x, memory):
        out, after = super().forward(x, memory)
        return out, after[:, :2]


@pytest.mark.parametrize(
    ("algorithm", "env", "fields", "said"),
    [
        ("sac", "Pendulum-v1", {}, "gru has a memory, with which a2c, ppo, trpo and reppo learn"),
        ("pqn", "CartPole-v1", {}, "gru has a memory, with which a2c, ppo, trpo and reppo learn"),
        ("reinforce", "CartPole-v1", {}, "gru has a memory, with which a2c, ppo, trpo and reppo learn"),
        ("ppo", "CartPole-v1", {"num_steps": 40}, "num_steps 40 is no multiple of sequence_length 16"),
        ("ppo", "CartPole-v1", {"minibatch_size": 40}, "minibatch_size 40 is no multiple of sequence_length 16"),
        ("ppo", "CartPole-v1", {"hidden": ()}, "A gru needs a width"),
    ],
)
def test_what_cannot_have_a_memory_is_refused_in_a_sentence(algorithm, env, fields, said, tmp_path):
    with pytest.raises(UserError, match=said):
        lem.train(algorithm, env, network="gru", run=tmp_path / "r", progress=False, **fields)
    assert not (tmp_path / "r").exists()


# Acting


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    fields = tiny_fields("CartPole-v1", network="gru", num_steps=8, sequence_length=4, hidden=(8,), total_steps=512)
    fields["backend"] = "gymnasium"  # whose episodes a video has too
    return lem.train("ppo", "CartPole-v1", run=tmp_path_factory.mktemp("memory") / "r", progress=False, **fields)


def test_act_remembers_and_reset_forgets(trained):
    policy, rng = lem.load(trained.path), np.random.default_rng(0)
    obs = rng.normal(size=(6, 3, 4)).astype(np.float32)

    def odds(policy, obs):
        found = policy.distribution(obs).probabilities
        policy.act(obs)
        return found

    together = np.stack([odds(policy, row) for row in obs])
    policy.reset()
    alone = []
    for i in range(3):
        alone.append(np.stack([odds(policy, row) for row in obs[:, i]]))
        policy.reset()
    np.testing.assert_allclose(together, np.stack(alone, axis=1), atol=1e-6)
    fresh = np.stack([odds(lem.load(trained.path), row) for row in obs])
    np.testing.assert_allclose(fresh[0], together[0], atol=1e-6)
    assert np.abs(fresh[1:] - together[1:]).max() > 1e-4
    policy.reset()
    odds(policy, obs[0])
    policy.reset(np.array([False, True, False]))
    after = odds(policy, obs[1])
    np.testing.assert_allclose(after[[0, 2]], together[1, [0, 2]], atol=1e-6)
    np.testing.assert_allclose(after[1], fresh[1, 1], atol=1e-6)
    assert np.isfinite(policy.value(obs[2])).all()


@pytest.mark.parametrize("done", ["x", [0.5, None], [2, 0], 1j])
def test_reset_takes_flags(trained, done):
    with pytest.raises(UserError, match="done must be True or False for each episode of the batch, not"):
        lem.load(trained.path).reset(done)


def test_act_says_what_is_wrong_with_another_number_of_episodes(trained):
    policy = lem.load(trained.path)
    policy.act(np.zeros((3, 4), np.float32))
    with pytest.raises(UserError, match="remembers 3 episodes, and is given 2 observations"):
        policy.act(np.zeros((2, 4), np.float32))
    with pytest.raises(UserError, match=r"done has the shape \(2,\), of 3 episodes"):
        policy.reset([True, False])
    policy.reset()
    policy.value(np.zeros((3, 4), np.float32))  # a question begins no episode
    policy.act(np.zeros(4))
    policy.reset(True)  # of one episode
    assert policy.act(np.zeros(4, np.float32)).shape == ()


def test_evaluation_carries_the_memory_as_act_does(trained):
    """Of several environments at once, episode by episode, to the ends."""
    policy = lem.load(trained.path)
    env = registry.make("CartPole-v1", 3)
    played = 0
    for obs, action, step, counts in play_episodes(policy.module, env, episodes=9, seed=3):
        chosen = policy.act(obs[:, :4].numpy())
        assert np.array_equal(chosen, action.numpy())
        done = (step.terminated | step.truncated) | ~step.valid
        policy.reset(done.numpy())
        played += int((done & counts).sum())
    assert played == 9
    env.close()


def test_a_film_and_a_preflight_begin_each_episode_without_memory(trained, tmp_path):
    pytest.importorskip("pygame")
    scores = lem.evaluate(trained.policy, episodes=2, seed=4, video=tmp_path / "video.gif")
    np.testing.assert_allclose(scores.returns, lem.evaluate(trained.policy, episodes=2, seed=4).returns)
    assert (tmp_path / "video.gif").stat().st_size > 1000


def test_a_stored_policy_and_a_warm_start_have_the_same_memory(trained, tmp_path):
    stored = lem.save(trained.policy, tmp_path / "policy")
    assert lem.evaluate(stored, episodes=3, seed=0) == lem.evaluate(trained.policy, episodes=3, seed=0)
    fields = tiny_fields("CartPole-v1", network="gru", num_steps=8, sequence_length=4, hidden=(8,), total_steps=32)
    fields |= {"learning_rate": 1e-12, "warm_start": str(stored), "backend": "gymnasium"}
    run = lem.train("ppo", "CartPole-v1", run=tmp_path / "r", progress=False, **fields)
    assert lem.evaluate(run.policy, episodes=3, seed=0).lengths == lem.evaluate(stored, episodes=3, seed=0).lengths


# Exports


@pytest.mark.skipif(not host_compiler(), reason="there is no C compiler")
@pytest.mark.parametrize(
    ("algorithm", "env", "network"),
    [
        ("ppo", "Copy-box-v0", "gru"),
        ("ppo", "Copy-masked-v0", "gru"),
        ("a2c", "Copy-multi-discrete-v0", "test_memory:Leaky"),
        ("trpo", "Copy-tuple-v0", "gru"),
        ("reppo", "Pendulum-v1", "gru"),
    ],
)
@pytest.mark.one_in(2)
def test_exports_carry_the_memory_over_whole_episodes(algorithm, env, network, tmp_path, monkeypatch):
    monkeypatch.setattr(exporting, "fly", partial(fly, rows=500))
    monkeypatch.setattr(parity, "nanoseconds", lambda call: call() is None or 1.0)
    if algorithm != "reppo":  # one is enough on the simulated core
        monkeypatch.setattr(compiled, "missing_target_tools", lambda: [compiled.TARGET_COMPILER])
    minibatch = {"ppo": "minibatch_size", "reppo": "minibatch_size", "trpo": "critic_minibatch_size"}.get(algorithm)
    fields = SETTINGS | {"network": network} | ({minibatch: 16} if minibatch else {})
    run = lem.train(algorithm, env, run=tmp_path / "r", progress=False, **fields)
    folder = lem.export(run)
    record, manifest = (json.loads((folder / f"{name}.json").read_text()) for name in ("parity", "manifest"))
    for name in ("c_host", "onnx") if record["onnx"] else ("c_host",):
        assert record[name]["max_difference"] <= 1e-5
        assert record[name]["over_episodes"] <= 1e-4
    assert record["c_host"]["self_test"] <= 1e-4
    assert manifest["memory"] == (3 if "Leaky" in network else 8)
    header = (folder / "policy.h").read_text()
    assert f"#define POLICY_MEMORY {manifest['memory']}" in header
    assert "void policy_reset(policy_state *state);" in header


def test_an_export_that_forgets_is_seen_in_the_parity_over_episodes():
    """And one that never forgets: both are right row by row."""
    _, state, env = begin(ppo, "Copy-box-v0")
    config = ppo.Config(env="Copy-box-v0", **{**SETTINGS, "minibatch_size": 16})
    policy = TrainedPolicy(state.networks, env.spec, config, 0)
    true, size = act_with(policy), memory_size(policy)
    flights, _ = fly(policy, true, rows=400)

    def forgets(rows):
        return np.hstack([true(rows)[:, :-size], np.zeros((len(rows), size), np.float32)])

    own, never = flights.actions(true, size), replace(flights, begins=np.zeros_like(flights.begins))
    for wrong in (flights.actions(forgets, size), never.actions(true, size)):
        assert compare(wrong, own, np.ones(own.shape[1]), 1e-5)["max_difference"] > 0.01
