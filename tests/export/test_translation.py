"""The translated policy acts as the policy does: in C on this machine and in onnxruntime."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from exported import BOX, exported, needs_compiler, observations_for, policy_for
from torch import nn

from lemniscate.algos import a2c, ddpg, ppo, pqn, reinforce, reppo, sac, shac, td3, trpo
from lemniscate.errors import UserError
from lemniscate.exporting.deployed import Deployed, act_with, safe_action
from lemniscate.exporting.translation import translate
from lemniscate.spec import Box, Discrete, MultiBinary, MultiDiscrete

pytestmark = needs_compiler
INFINITY = float("inf")

KINDS = {
    "bounded": BOX,
    "one coordinate": Box((-2.0,), (2.0,)),
    "one bound": Box((-INFINITY, 0.0, -INFINITY, -1.0), (INFINITY, INFINITY, 2.0, 1.0)),
    "shaped": Box((-1.0,) * 4, (1.0, 2.0, 3.0, 4.0), (2, 2), "float64"),
    "discrete": Discrete(5, start=-2),
    "masked": Discrete(4, masked=True),
    "multi-discrete": MultiDiscrete((2, 3), (1, 0)),
    "masked components": MultiDiscrete((3, 4), (1, 0), masked=True),
    "multi-binary": MultiBinary(4, (2, 2)),
}
SAFE = {
    "bounded": [0, 0, 0.25],
    "one coordinate": [0],
    "one bound": [0, 1, 1, 0],
    "shaped": [0, 0.5, 1, 1.5],
    "discrete": [-2],
    "masked": [0],
    "multi-discrete": [1, 0],
    "masked components": [1, 0],
    "multi-binary": [0, 0, 0, 0],
}

MASKED = {"masked": ([0, 0, 1, 1], [2]), "masked components": ([0, 0, 1, 0, 1, 0, 1], [3, 1])}
"""a mask, and the first action that it permits in each component"""


def require_parity(copy, tolerance=1e-5):
    """C and ONNX act as torch, which does not act the same everywhere."""
    assert np.ptp(copy.true, axis=0).max() > 0.1
    host = copy.host()
    assert np.abs(host.act(copy.obs) - copy.true).max() <= tolerance
    assert host.self_test() <= tolerance
    pytest.importorskip("onnxruntime")
    assert np.abs(copy.onnx(copy.obs) - copy.true).max() <= tolerance
    assert copy.onnx(copy.obs[:1]).shape == copy.true[:1].shape  # the batch axis is free


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.one_in(2)
def test_every_kind_of_actions(kind):
    copy = exported(policy_for(KINDS[kind], normalize_observations=True, spread=0.5))
    require_parity(copy)
    assert np.array_equal(safe_action(KINDS[kind]), np.float32(SAFE[kind]))
    bad = np.repeat(copy.obs[:1], 3, axis=0)
    bad[:, 2] = [np.nan, np.inf, -np.inf]
    mask, first = MASKED.get(kind, ([], SAFE[kind]))
    bad[:, bad.shape[1] - len(mask) :] = mask
    # Of -ffast-math this is what matters here; linked with all of it, the library would flush subnormals everywhere.
    for flags in [("-O0",), *([("-O3", "-ffinite-math-only")] if mask else [])]:
        host = copy.host(*flags)
        assert np.array_equal(host.act(bad), [first] * 3)
        assert host.flags == 3
        host.act(copy.obs)
        assert host.flags == 0


@pytest.mark.parametrize(
    "algo", [reinforce, a2c, trpo, ppo, reppo, pqn, shac, ddpg, td3, sac], ids=lambda algo: algo.__name__[16:]
)
def test_every_algorithm(algo):
    action = Discrete(3) if algo is pqn else BOX
    require_parity(exported(policy_for(action, algo=algo, normalize_observations=True)))


@pytest.mark.parametrize(
    ("network", "activation"),
    [("mlp", "relu"), ("mlp", "elu"), ("layer_norm", "silu"), ("layer_norm", "tanh"), ("simba", "relu")],
)
def test_every_network_and_activation(network, activation):
    require_parity(exported(policy_for(network=network, activation=activation)))


def test_products_of_bfloat16_are_rounded_as_in_training():
    fields = {"network": "simba", "matmul": "bfloat16", "hidden": (32, 32)}
    copy = exported(policy_for(algo=sac, **fields))
    assert copy.program.is_rounded
    require_parity(copy, tolerance=0.02)
    differences = np.abs(copy.host().act(copy.obs) - copy.true)
    assert np.median(differences) < 1e-6  # but where a sum in another order is rounded the other way


def test_what_the_action_does_not_need_is_left_out():
    text = exported(policy_for(algo=sac)).files()["policy.c"]
    assert text.count("policy_tanh(") == 1 + 1  # its definition and the squash, none for the standard deviation


def test_a_policy_without_hidden_layers():
    require_parity(exported(policy_for(hidden=())))


class Odd(nn.Module):
    """A little of everything that has a translation."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.register_buffer("frequencies", torch.randn(inputs, 6))
        self.first, self.last = nn.Linear(12, 12), nn.Linear(24, outputs)
        self.queries, self.norm = nn.Linear(4, 4), nn.LayerNorm(4, elementwise_affine=False)
        self.token = nn.Parameter(torch.randn(1, 2))

    def forward(self, x):
        phases = x @ self.frequencies
        y = self.first(torch.cat([phases.sin(), phases.cos()], dim=-1))
        rows = self.queries(y.reshape(-1, 3, 4)).transpose(1, 2)  # [B, 4, 3]
        weights = rows.softmax(-1) * rows.mean(-1, keepdim=True).sigmoid()
        y = (
            nn.functional.gelu(y, approximate="tanh")
            + weights.permute(0, 2, 1).flatten(1)
            - rows.amax(-1).repeat_interleave(3, -1)
        )
        a, b = self.norm(nn.functional.gelu(y).unflatten(-1, (3, 4))).flatten(1).chunk(2, -1)
        a = a[:, [5, 0, 1, 2, 3, 4]]
        c = torch.where(a > b, nn.functional.softplus(a), nn.functional.leaky_relu(b)) / (1 + a**2)
        d = (
            (a.abs() + 1e-3).sqrt() * torch.exp(-(b.square()))
            + torch.log(a.abs() + 1)
            - torch.minimum(a, b).clamp(min=-1)
        )
        e = torch.stack([a[:, 0], b.sum(-1), b.argmax(-1).float()], dim=1) * 0.1
        e = torch.cat([e, ((a[:, :3] >= 0) & ~(b[:, :3] == 0)).float()], dim=-1)
        e = torch.cat([e[:, :3], x.new_full((x.shape[0], 1), 0.5), e[:, 3:5]], dim=-1)
        e = e + torch.cat([self.token.expand(x.shape[0], -1), x.new_zeros(x.shape[0], 2, 4).sum(1)], dim=-1)
        e = torch.addcmul(e, nn.functional.hardtanh(3 * e), e.detach(), value=2)
        return self.last(torch.cat([c, d, e, nn.functional.elu(a)], dim=-1).tanh())


def test_a_network_of_ones_own():
    require_parity(exported(policy_for(network="test_translation:Odd", spread=0)))


def refused(function):
    class Network(nn.Module):
        def __init__(self):
            super().__init__()
            self.lstm = nn.LSTM(7, 3)

        def forward(self, x):
            return function(self, x)

    with pytest.raises(UserError) as error:
        translate(Network().eval(), 7)
    return str(error.value)


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda self, x: x - x.mean(0), "mean mixes the observations of a batch"),
        (lambda self, x: x.flip(0), "flip"),
        (lambda self, x: x.repeat(2, 1), "repeat"),
        (lambda self, x: x[x[:, 0].argmax()].expand_as(x), ""),
        (lambda self, x: torch.linalg.inv(x[:, :4].reshape(-1, 2, 2)).flatten(1), " has no translation"),
        (lambda self, x: x if x.sum() > 0 else -x, "data-dependent"),
        (lambda self, x: (x.double() * 2).float(), "it computes in float64"),
        (lambda self, x: x.unsqueeze(1) @ x.unsqueeze(2), "has no translation"),
        (lambda self, x: x**2.5, "pow with the exponent 2.5 has no translation"),
        (lambda self, x: torch.zeros(len(x), 2), "it is made for one number of observations"),
        (lambda self, x: torch.from_numpy(x.numpy()), ""),
    ],
)  # fmt: skip
def test_what_cannot_be_translated_is_refused_with_a_sentence(function, said):
    sentence = refused(function)
    assert sentence.startswith("This network cannot be exported: ")
    assert said in sentence
    assert "\n" not in sentence
    assert len(sentence) < 250


def test_memory_is_shared_by_what_is_not_needed_at_once():
    copy = exported(policy_for(observations=43, hidden=(64, 64), normalize_observations=True))
    assert "static float scratch[128];" in copy.files()["policy.c"]


class Twice(nn.Linear):
    """A result that is used twice, and one that is the same for all numbers of another."""

    def forward(self, x):
        y = x.sin()
        return super().forward(y * y / x.abs().sum(-1, keepdim=True).exp())


def test_what_is_used_twice_is_computed_once():
    copy = exported(policy_for(network="test_translation:Twice"))
    text = copy.files()["policy.c"]
    assert text.count("policy_sin(") == 1 + 1  # its definition, and a call in a loop
    assert "[0] = policy_exp(" in text  # no loop
    assert np.abs(copy.host().act(copy.obs) - copy.true).max() <= 1e-5


def test_the_same_policy_is_written_in_the_same_words():
    policy = policy_for()
    assert exported(policy).files() == exported(policy).files()


def test_a_dictionary_is_seen_in_the_order_of_its_parts(tmp_path):
    from lemniscate.api.policy import TrainedPolicy
    from lemniscate.envs import registry

    env = registry.make("environments:Copy", 2, kwargs={"kind": "tuple"})
    config = ppo.Config(env="environments:Copy", env_kwargs={"kind": "tuple"}, hidden=(8,))
    torch.manual_seed(0)
    policy = TrainedPolicy(config.networks(env.spec), env.spec, config, 0)
    raw = (1, {"a": np.array([1], dtype=np.int8), "z": np.array([0.5, -1, 2], dtype=np.float32)})
    flat = np.float32([[0, 1, 1, 0.5, -1, 2]])
    program = translate(Deployed(policy).eval(), 6)
    assert program.obs.size == 6
    assert act_with(policy)(flat)[0, 0] == policy.act(raw)
    env.close()


def test_observations_are_seen_as_they_are_stored():
    policy = policy_for()
    obs = observations_for(policy)
    assert np.array_equal(exported(policy).obs, obs)


def test_threads_translate_one_after_the_other():
    policies = [policy_for(seed=seed) for seed in range(4)]
    with ThreadPoolExecutor(4) as threads:
        programs = list(threads.map(lambda policy: translate(Deployed(policy).eval(), 7), policies))
    assert len(programs) == 4
