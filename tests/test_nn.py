import torch

from lemniscate.maths import Categorical, Gaussian
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.networks import Bfloat16Linear, Layers, Tanh
from lemniscate.nn.normalizer import RewardScale, RunningNorm
from lemniscate.spec import Box, Discrete, ObservationPart, Spec
from lemniscate.types import Rollout

BOX = Spec("x", (ObservationPart((), (5,)),), Box((-1.0, -1.0), (1.0, 1.0)))
DISCRETE = Spec("x", (ObservationPart((), (5,)),), Discrete(3))


def test_orthogonal_layers_with_their_gains():
    first, _, last = Layers((4,)).network(6, 2, last_gain=0.01)
    torch.testing.assert_close(first.weight @ first.weight.T, 2 * torch.eye(4))
    torch.testing.assert_close(last.weight @ last.weight.T, 1e-4 * torch.eye(2))
    assert not first.bias.any()
    assert not last.bias.any()


def test_the_fast_tanh_is_tanh():
    x = torch.linspace(-20, 20, 10_001)
    torch.testing.assert_close(Tanh()(x), torch.tanh(x), atol=2e-7, rtol=0)
    y = torch.linspace(-5, 5, 101, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(Tanh(), y)


def test_a_policy_starts_near_the_centre_and_a_value_has_one_number():
    networks = ActorCritic(BOX, Layers(), initial_log_std=-0.5)
    policy, value = networks.policy, networks.value
    obs = torch.randn(20, 5)
    distribution = policy(obs)
    assert isinstance(distribution, Gaussian)
    assert distribution.mean.abs().max() < 0.1
    torch.testing.assert_close(distribution.log_std, torch.full((2,), -0.5))
    assert value(obs).shape == (20,)
    assert value(obs.view(4, 5, 5)).shape == (4, 5)
    assert isinstance(ActorCritic(DISCRETE, Layers()).policy(obs), Categorical)


def test_the_normalizer_standardizes_what_it_has_seen_and_clips():
    norm = RunningNorm(2, clip=5.0)
    data = torch.randn(5000, 2) * torch.tensor([3.0, 0.1]) + torch.tensor([10.0, -4.0])
    assert torch.equal(norm(data[:3]).clamp(-5, 5), data[:3].clamp(-5, 5))  # nothing seen: nothing changed
    for part in data.split(500):
        norm.update(part)
    out = norm(data)
    torch.testing.assert_close(out.mean(0), torch.zeros(2), atol=1e-3, rtol=0)
    torch.testing.assert_close(out.std(0), torch.ones(2), atol=1e-2, rtol=0)
    assert norm(torch.tensor([[1e6, -1e6]])).tolist() == [[5.0, -5.0]]


def test_looking_through_the_normalizer_never_moves_it():
    norm = RunningNorm(2)
    norm.update(torch.randn(10, 2))
    before = {k: v.clone() for k, v in norm.state_dict().items()}
    norm.train()(torch.randn(100, 2))
    norm.eval()(torch.randn(100, 2))
    assert all(torch.equal(v, before[k]) for k, v in norm.state_dict().items())


def test_policy_and_value_see_through_one_normalizer():
    networks = ActorCritic(BOX, Layers(), normalize_observations=True)
    assert networks.policy.normalizer is networks.value.normalizer


def test_rewards_are_divided_by_the_std_of_the_discounted_return(rng):
    reward = torch.randn(3, 40, 2, generator=rng) + 1
    done, ignored = (torch.rand(3, 40, 2, generator=rng) < share for share in (0.1, 0.05))
    scale, expected, running = RewardScale(2, gamma=0.9), [], [0.0, 0.0]
    assert torch.equal(scale(reward[0]), reward[0])
    for part in range(3):
        no = torch.zeros(40, 2, dtype=torch.bool)
        scale.follow(Rollout(no, no, reward[part], no, done[part], no, ~ignored[part]))
        for t in range(40):
            for n in range(2):
                if ignored[part, t, n]:
                    running[n] *= 0.9
                else:
                    running[n] = 0.9 * running[n] + reward[part, t, n].item()
                    expected.append(running[n])
                if done[part, t, n]:
                    running[n] = 0.0
    std = torch.tensor(expected, dtype=torch.float64).std(correction=0)
    torch.testing.assert_close(scale(reward[0]), reward[0] / std.float())
    assert scale(torch.tensor([1e6, -1e6])).tolist() == [10.0, -10.0]
    assert scale.running.any()
    scale.restart()
    assert not scale.running.any()


def test_a_bfloat16_layer_rounds_both_factors_and_the_product_there_and_back(rng):
    layer, x = Bfloat16Linear(40, 30), torch.randn(20, 40, generator=rng, requires_grad=True)
    out, back = layer(x), torch.randn(20, 30, generator=rng)
    out.backward(back)
    short = {name: tensor.detach().bfloat16().double() for name, tensor in (("x", x), ("w", layer.weight), ("g", back))}
    exact = {
        "out": short["x"] @ short["w"].T + layer.bias.detach().double(),
        "x": short["g"] @ short["w"],
        "w": short["g"].T @ short["x"],
        "b": back.double().sum(0),
    }
    product = layer(x) - layer.bias
    torch.testing.assert_close(product, product.bfloat16().float(), rtol=1e-6, atol=1e-7)
    for ours, name in ((out, "out"), (x.grad, "x"), (layer.weight.grad, "w"), (layer.bias.grad, "b")):
        assert ours.dtype == torch.float32
        torch.testing.assert_close(ours.double(), exact[name], rtol=2**-8, atol=2**-8)
    assert not torch.equal(out, torch.nn.functional.linear(x, layer.weight, layer.bias))


def test_only_products_between_hidden_layers_are_short():
    for architecture, count in (("mlp", 2), ("layer_norm", 2), ("simba", 6)):
        layers = Layers((8, 8, 8), "relu", architecture, "bfloat16").network(6, 2, last_gain=1.0)
        linear = [module for module in layers.modules() if isinstance(module, torch.nn.Linear)]
        short = [isinstance(module, Bfloat16Linear) for module in linear]
        assert short == [False, *[True] * count, False]


def test_layer_norm_stands_between_a_layer_and_its_activation():
    kinds = [type(layer).__name__ for layer in Layers((4, 5), "relu", "layer_norm").network(6, 2, last_gain=1.0)]
    assert kinds == ["Linear", "LayerNorm", "ReLU", "Linear", "LayerNorm", "ReLU", "Linear"]


def test_simba_is_residual_blocks_between_two_layers_and_a_norm(rng):
    first, one, two, norm, last = Layers((4, 4), "relu", "simba").network(6, 2, last_gain=0.01)
    x = torch.randn(7, 6, generator=rng)
    hidden = first(x)
    for block in (one, two):
        before, inner, _, outer = block.layers
        assert (inner.weight.shape, outer.weight.shape) == ((16, 4), (4, 16))
        hidden = hidden + torch.relu(before(hidden) @ inner.weight.T + inner.bias) @ outer.weight.T + outer.bias
    network_of_all = Layers((4, 4), "relu", "simba").network(6, 2, last_gain=0.01)
    network_of_all.load_state_dict(torch.nn.Sequential(first, one, two, norm, last).state_dict())
    torch.testing.assert_close(network_of_all(x), last(norm(hidden)))
    assert isinstance(norm, torch.nn.LayerNorm)
