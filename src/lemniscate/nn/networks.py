"""Networks: perceptrons, residual blocks, modules of one's own; and the encoder of images."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

from lemniscate.errors import UserError, unknown_name
from lemniscate.maths import tanh
from lemniscate.system.named import find_callable

Activation = Literal["tanh", "relu", "elu", "silu"]


class Tanh(nn.Module):
    """`lemniscate.maths.tanh`, any shape to the same shape."""

    forward = staticmethod(tanh)


ACTIVATIONS = {"tanh": Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}

Matmul = Literal["float32", "bfloat16"]
"""of products between hidden layers; the first and the last are always in float32"""


class Bfloat16Linear(nn.Linear):
    """x Wᵀ + b with both factors and their product rounded to bfloat16, 8 bits each, on the way there and back.

    The sums inside the product are of float32. Parameters and b keep their type, and so does what comes out.
    """

    def forward(self, input: Tensor) -> Tensor:
        """[…, inputs] to […, outputs]."""
        return nn.functional.linear(input.bfloat16(), self.weight.bfloat16()).to(input.dtype) + self.bias


@dataclass(frozen=True)
class Layers:
    """The settings of a network between its inputs and its outputs.

    Args:
        hidden: widths of the hidden layers.
        activation: between the layers.
        kind: a name in `NETWORKS`, or one's own as `module:Class` or `module:Class(key=value, …)`: called with the
            numbers of inputs and outputs it makes a module that takes [B, inputs] to [B, outputs].
        matmul: precision of the products between hidden layers.
    """

    hidden: tuple[int, ...] = (64, 64)
    activation: Activation = "tanh"
    kind: str = "mlp"
    matmul: Matmul = "float32"

    def check(self) -> None:
        """Raise `UserError` if no network can have these layers."""
        if self.kind not in NETWORKS and ":" not in self.kind:
            raise unknown_name("network", self.kind, [*NETWORKS, "module:Class"])
        if self.kind == "simba" and len(set(self.hidden)) != 1:
            raise UserError(f"SimBa's blocks have one width, such as (256, 256), not {self.hidden}.")

    def network(self, inputs: int, outputs: int, last_gain: float) -> nn.Module:
        """A new network, […, inputs] to […, outputs]; orthogonal weights, zero biases.

        The last layer has gain `last_gain`: 0.01 for a policy, so that it starts near the centre of its range whatever
        it observes (Andrychowicz et al. 2021, arXiv:2006.05990, section 3.2), 1 for a value; the others have √2.
        """
        if self.kind not in NETWORKS:
            return _own_network(self.kind, inputs, outputs)
        layers, width = NETWORKS[self.kind](self, inputs)
        return nn.Sequential(*layers, orthogonal(nn.Linear(width, outputs), last_gain))

    @property
    def linear(self) -> type[nn.Linear]:
        """The class of the products between hidden layers."""
        return nn.Linear if self.matmul == "float32" else Bfloat16Linear


def _mlp(layers: Layers, inputs: int, normalized: bool = False) -> tuple[list[nn.Module], int]:
    modules: list[nn.Module] = []
    for i, (before, after) in enumerate(pairwise((inputs, *layers.hidden))):
        modules += [orthogonal((layers.linear if i else nn.Linear)(before, after), 2**0.5)]
        modules += [nn.LayerNorm(after)] if normalized else []
        modules += [ACTIVATIONS[layers.activation]()]
    return modules, layers.hidden[-1] if layers.hidden else inputs


def _layer_norm(layers: Layers, inputs: int) -> tuple[list[nn.Module], int]:
    return _mlp(layers, inputs, normalized=True)


def _simba(layers: Layers, inputs: int) -> tuple[list[nn.Module], int]:
    width = layers.hidden[-1]
    blocks = (Residual(width, layers.linear) for _ in layers.hidden)
    return [orthogonal(nn.Linear(inputs, width), 1.0), *blocks, nn.LayerNorm(width)], width


NETWORKS: dict[str, Callable[[Layers, int], tuple[list[nn.Module], int]]] = {
    "mlp": _mlp,
    "layer_norm": _layer_norm,
    "simba": _simba,
}
"""The layers before the last one, and the number of their outputs."""


def _own_network(name: str, inputs: int, outputs: int) -> nn.Module:
    try:
        network = find_callable(name)(inputs, outputs)
        shape = network(torch.zeros(2, inputs)).shape
    except (TypeError, RuntimeError, AttributeError) as error:
        raise UserError(f"{name}({inputs}, {outputs}) must make a module for [2, {inputs}]: {error}") from None
    if shape != (2, outputs):
        raise UserError(f"{name} must take [2, {inputs}] to [2, {outputs}]; it returns {list(shape)}.")
    return network


class Residual(nn.Module):
    """x + W₂ relu(W₁ LN(x)), four times as wide inside: a block of SimBa, Lee et al. 2025, arXiv:2410.09754, eq. 5."""

    def __init__(self, width: int, kind: type[nn.Linear] = nn.Linear) -> None:
        super().__init__()
        inner, outer = kind(width, 4 * width), kind(4 * width, width)
        self.layers = nn.Sequential(
            nn.LayerNorm(width), orthogonal(inner, 2**0.5), nn.ReLU(), orthogonal(outer, 2**0.5)
        )

    def forward(self, x: Tensor) -> Tensor:
        """[…, width] to the same shape."""
        return x + self.layers(x)


def orthogonal(layer: nn.Linear | nn.Conv2d, gain: float) -> nn.Module:
    """The layer with orthogonal weights of this gain, and zero biases."""
    nn.init.orthogonal_(layer.weight, gain)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer


class ImageEncoder(nn.Module):
    """Two convolutions with ReLU, 16 and 32 channels, and layer normalization.

    8 × 8 pixels in steps of 4, then 4 × 4 in steps of 2 (Mnih et al. 2013, arXiv:1312.5602, section 4.1); in images
    with a side below 36 pixels, such as a grid world's, 3 × 3 in steps of 1, then of 2. Without the normalization a
    policy's encoder, which learns from the advantage alone, may end with the same output for every image.
    """

    def __init__(self, shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.shape = height, width, channels = shape
        if min(height, width) < 36:
            first = nn.Conv2d(channels, 16, kernel_size=3, padding=1)
            second = nn.Conv2d(16, 32, kernel_size=3, stride=2, padding=1)
        else:
            first = nn.Conv2d(channels, 16, kernel_size=8, stride=4)
            second = nn.Conv2d(16, 32, kernel_size=4, stride=2)
        convolutions = [orthogonal(first, 2**0.5), nn.ReLU(), orthogonal(second, 2**0.5), nn.ReLU(), nn.Flatten()]
        with torch.no_grad():
            self.size = nn.Sequential(*convolutions)(torch.zeros(1, channels, height, width)).shape[-1]
        """length of what comes out"""
        self.layers = nn.Sequential(*convolutions, nn.LayerNorm(self.size))

    def forward(self, pixels: Tensor) -> Tensor:
        """[…, H · W · C] in [-½, ½] to […, `size`]."""
        images = pixels.reshape(-1, *self.shape).movedim(-1, 1)
        return self.layers(images).reshape(*pixels.shape[:-1], self.size)
