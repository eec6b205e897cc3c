"""Hidden layers: initialization, layer norm, SimBa, products in bfloat16, activations."""

import math

import pytest
import torch
from torch import nn

from lemniscate.errors import UserError
from lemniscate.nn.networks import Bfloat16Linear, ImageEncoder, Layers, OwnNetwork, Tanh
from lemniscate.optim.adam import ParameterVector
from lemniscate.system.named import name_of


def test_layers_are_orthogonal_with_their_gains():
    first, _, last = Layers((4,)).network(6, 2, last_gain=0.01)
    torch.testing.assert_close(first.weight @ first.weight.T, 2 * torch.eye(4))
    torch.testing.assert_close(last.weight @ last.weight.T, 1e-4 * torch.eye(2))
    assert not first.bias.any()
    assert not last.bias.any()


def test_the_fast_tanh_equals_tanh():
    x = torch.linspace(-20, 20, 10_001)
    torch.testing.assert_close(Tanh()(x), torch.tanh(x), atol=2e-7, rtol=0)
    y = torch.linspace(-5, 5, 101, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(Tanh(), y)


def test_a_bfloat16_layer_rounds_both_factors_and_the_product_in_both_directions(rng):
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


def test_only_products_between_hidden_layers_are_in_bfloat16():
    for kind, count in (("mlp", 2), ("layer_norm", 2), ("simba", 6)):
        layers = Layers((8, 8, 8), "relu", kind, "bfloat16").network(6, 2, last_gain=1.0)
        linear = [module for module in layers.modules() if isinstance(module, torch.nn.Linear)]
        short = [isinstance(module, Bfloat16Linear) for module in linear]
        assert short == [False, *[True] * count, False]


def test_layer_norm_is_between_a_layer_and_its_activation():
    kinds = [type(layer).__name__ for layer in Layers((4, 5), "relu", "layer_norm").network(6, 2, last_gain=1.0)]
    assert kinds == ["Linear", "LayerNorm", "ReLU", "Linear", "LayerNorm", "ReLU", "Linear"]


def test_simba_is_residual_blocks_between_a_layer_and_a_norm(rng):
    first, one, two, norm, last = Layers((4, 4), "relu", "simba").network(6, 2, last_gain=0.01)
    x = torch.randn(7, 6, generator=rng)
    hidden = first(x)
    for block in (one, two):
        before, inner, _, outer = block.layers
        assert (inner.weight.shape, outer.weight.shape) == ((16, 4), (4, 16))
        hidden = hidden + torch.relu(before(hidden) @ inner.weight.T + inner.bias) @ outer.weight.T + outer.bias
    network = Layers((4, 4), "relu", "simba").network(6, 2, last_gain=0.01)
    network.load_state_dict(torch.nn.Sequential(first, one, two, norm, last).state_dict())
    torch.testing.assert_close(network(x), last(norm(hidden)))
    assert isinstance(norm, torch.nn.LayerNorm)


@pytest.mark.parametrize(
    ("shape", "size"), [((84, 84, 4), 32 * 9 * 9), ((96, 60, 3), 32 * 10 * 6), ((7, 7, 3), 32 * 4 * 4)]
)
def test_images_of_any_size_become_normalized_features(shape, size):
    """Adam could not silence them: what two images differ in stays of the size of a normalized number."""
    torch.manual_seed(0)
    encoder = ImageEncoder(shape)
    image = torch.full((2, 5, math.prod(shape)), 0.4)
    image[:, :, -1] = -0.5
    features = encoder(image)
    assert features.shape == (2, 5, size) == (2, 5, encoder.size)
    torch.testing.assert_close(features.var(-1, correction=0), torch.ones(2, 5), atol=1e-3, rtol=0)
    with torch.no_grad():
        encoder.layers[0].bias.fill_(-1e-3)
    moved = image.clone()
    moved[:, :, : shape[2]] = -0.5
    assert (encoder(moved) - features).abs().max() > 1e-3


def test_the_layout_of_an_image_is_height_width_channels():
    """A bright column of the second channel reaches the convolution as a column of that channel."""
    encoder = ImageEncoder((40, 44, 2))
    pixels = torch.zeros(40, 44, 2)
    pixels[:, 7, 1] = 1
    seen = []
    encoder.layers[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    encoder(pixels.flatten())
    assert seen[0].shape == (1, 2, 40, 44)
    assert seen[0][0, 1, :, 7].eq(1).all()
    assert seen[0].sum() == 40


class Own(nn.Module):
    """Two layers; others have `between` to change."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.first, self.last = nn.Linear(inputs, 8), nn.Linear(8, outputs)
        self.between = nn.Identity()
        self.change()

    def change(self):
        pass

    def forward(self, x):
        assert x.dim() == 2
        return self.last(self.between(torch.tanh(self.first(x))))


def kind(**methods):
    return type("Changed", (Own,), methods)


def changed(change):
    return kind(change=change)


def own(network, inputs=5, outputs=3):
    return Layers(kind=name_of(network)).network(inputs, outputs, last_gain=1.0)


def test_a_network_of_ones_own_gets_rows_whatever_dimensions_lead(rng):
    network, x = own(Own), torch.randn(4, 6, 5, generator=rng)
    assert network(x).shape == (4, 6, 3)
    torch.testing.assert_close(network(x)[1, 2], network(x[1, 2]))
    torch.testing.assert_close(network(x).flatten(0, 1), network(x.flatten(0, 1)))


def count_calls(self):
    self.register_buffer("calls", torch.tensor(0))
    self.between.register_forward_hook(lambda *_: self.calls.add_(1) and None)


@pytest.mark.parametrize(
    ("network", "said"),
    [
        (changed(lambda self: setattr(self, "between", nn.BatchNorm1d(8))), "changes between.running_mean in forward.*L"),
        (changed(lambda self: setattr(self, "between", nn.LazyBatchNorm1d())), "changes between.num_batches_tracked in"),
        (changed(count_calls), "changes calls in forward"),
        (changed(lambda self: nn.utils.parametrizations.spectral_norm(self.first)), "changes first.param.* in forward"),
        (changed(lambda self: setattr(self, "between", nn.Dropout(0.1))), "is random: two calls with the same rows"),
        (changed(lambda self: self.requires_grad_(False)), "has no parameter to learn"),
        (kind(forward=torch.no_grad()(Own.forward)), "outputs that do not depend on its parameters"),
        (changed(lambda self: self.register_buffer("mask", torch.tensor(-math.inf))), "number in mask that is not fini"),
        (kind(forward=lambda self, x: (Own.forward(self, x), x)), r"takes \[B, 5\] to \[B, 3\], in float32; .* to a tup"),
        (kind(forward=lambda self, x: Own.forward(self, x).double()), r"to \[64, 3\] of torch.float64"),
        (kind(forward=lambda self, x: self.first(x)), r"to \[64, 8\] of torch.float32"),
        (changed(lambda self: self.double()), r"takes \[B, 5\] to \[B, 3\]: RuntimeError: "),
        (kind(forward=lambda self, x: Own.forward(self.double(), x.double()).float()), "parameters of torch.float64"),
        (kind(forward=lambda self, x: {}["no"]), "KeyError: 'no'"),
        (kind(get_extra_state=lambda self: {"a": 1}), "must make a module"),
        (lambda inputs, outputs: lambda x: x[:, :outputs], "network must make a torch module, and .* makes lambda"),
        (kind(forward=lambda self, x: Own.forward(self, x) / 0), "has outputs that are not finite"),
        (kind(forward=lambda self, x: Own.forward(self, x - x.mean(0))), "has an output at one row that depends on the other rows"),
        (kind(forward=lambda self, x: Own.forward(self, x) + x[:1, :1]), "has an output at one row that depends on the other rows"),
        (
            changed(lambda self: setattr(self, "between", nn.BatchNorm1d(8, track_running_stats=False))),
            "cannot take one row: Expected more than 1 value.*; LayerNorm takes the place of batch normalization",
        ),
        (kind(forward=lambda self, x: Own.forward(self, x) + (not self.training)), r"other outputs after eval\(\), in wh"),
        (kind(forward=lambda self, x: Own.forward(self, x) if self.training else (x,)), "outputs after eval"),
        (kind(forward=lambda self, x: Own.forward(self, x).squeeze(0)), r"one row, \[1, 5\], to \[3\]; it must be \[1, 3"),
        (kind(forward=lambda self, x: self.last((y := self.first(x)).sin() + y.mul_(2))), "RuntimeError: one of the"),
        (kind(memory_size="7"), "memory_size of Changed is '7'; in the class it must be a whole number, such as 64"),
        (kind(memory_size=property(lambda self: 7)), "memory_size of Changed is .*; in the class it must be a whole num"),
    ],
)  # fmt: skip
def test_a_network_that_could_not_be_trained_again_is_one_sentence(network, said):
    with pytest.raises(UserError, match=said) as error:
        own(network)
    assert "\n" not in str(error.value)


def test_a_network_may_write_into_the_rows_that_it_gets(rng):
    network, x = own(kind(forward=lambda self, x: Own.forward(self, x.clamp_(-0.5, 0.5)))), torch.randn(4, 5)
    before = x.clone()
    out = network(x)
    assert torch.equal(x, before)
    torch.testing.assert_close(out, Own.forward(network.module, x.clamp(-0.5, 0.5)))


def test_a_network_of_ones_own_is_looked_at_with_gradients_wherever_it_is_made():
    with torch.no_grad():
        assert own(Own)(torch.zeros(2, 5)).shape == (2, 3)


def test_parameters_that_need_no_gradient_are_not_in_the_vector():
    network = own(changed(lambda self: self.first.requires_grad_(False)))
    before = network.module.first.weight.clone()
    vector = ParameterVector(network)
    assert vector.vector.shape == (8 * 3 + 3,)
    vector.vector.zero_()
    assert not network.module.last.weight.any()
    assert torch.equal(network.module.first.weight, before)


class Unlisted(nn.Module):
    """Layers in a list, which torch does not know of."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.layers, self.head = [nn.Linear(inputs, 8)], nn.Linear(8, outputs)

    def forward(self, x):
        return self.head(self.layers[0](x))


class Loose(nn.Linear):
    """A tensor that is no buffer."""

    def __init__(self, inputs, outputs):
        super().__init__(inputs, outputs)
        self.scale = torch.rand(outputs)

    def forward(self, x):
        return self.scale * super().forward(x)


@pytest.mark.parametrize("name", ["Unlisted", "Loose"])
def test_numbers_that_would_not_be_saved_are_refused(name):
    with pytest.raises(UserError, match="has numbers that its state_dict has not, so that they would be neither"):
        OwnNetwork(f"test_networks:{name}", 3, 2)


def test_the_look_at_a_network_of_ones_own_draws_nothing():
    torch.manual_seed(0)
    OwnNetwork("torch.nn:Linear", 3, 2)
    drawn = torch.rand(())
    torch.manual_seed(0)
    nn.Linear(3, 2)
    assert torch.equal(drawn, torch.rand(()))


class Sequence(nn.Module):
    """A GRU, which takes the rows of a batch for one sequence."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.gru = nn.GRU(inputs, outputs)

    def forward(self, x):
        return self.gru(x)[0]


class Forgetful(nn.Linear):
    """It says that it remembers nothing."""

    memory_size = 0


class Single(nn.Linear):
    """It can be made once."""

    made = 0

    def __init__(self, inputs, outputs):
        Single.made += 1
        if Single.made > 1:
            raise RuntimeError("in use")
        super().__init__(inputs, outputs)


def test_rows_are_no_sequence_and_what_is_made_is_made_again():
    with pytest.raises(UserError, match="on the other rows: it takes them for one sequence"):
        OwnNetwork("test_networks:Sequence", 3, 2)
    OwnNetwork("test_networks:Forgetful", 3, 2)
    with pytest.raises(UserError, match="cannot be made again, to be loaded: RuntimeError: in use"):
        OwnNetwork("test_networks:Single", 3, 2)
