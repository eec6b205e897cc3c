"""Multi-layer perceptrons, residual ones, and a small convolutional network to look at images with."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

Activation = Literal["tanh", "relu", "elu", "silu"]
Architecture = Literal["mlp", "layer_norm", "simba"]
"""layers with an activation between; the same with layer normalization before it; residual blocks of one width"""
Matmul = Literal["float32", "bfloat16"]
"""of products between hidden layers; the first and the last are always in float32"""


class Tanh(nn.Module):
    """tanh(x) = 2σ(2x) − 1, three times faster than `torch.tanh` on a CPU; the two differ by at most 2e-7."""

    def forward(self, x: Tensor) -> Tensor:
        """Any shape to the same shape."""
        return torch.sigmoid(x * 2) * 2 - 1


ACTIVATIONS = {"tanh": Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}


class Bfloat16Linear(nn.Linear):
    """x Wᵀ + b with both factors and their product rounded to bfloat16, 8 bits each, on the way there and back.

    The sums inside the product are of float32. Parameters and b keep their type, and so does what comes out.
    """

    def forward(self, input: Tensor) -> Tensor:
        """[…, inputs] to […, outputs]."""
        return nn.functional.linear(input.bfloat16(), self.weight.bfloat16()).to(input.dtype) + self.bias


def has_bfloat16(device: torch.device) -> bool:
    """Whether the processor multiplies in bfloat16 by itself; elsewhere it is emulated, and slow."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return any(able for name, able in torch.cpu.get_capabilities().items() if "bf16" in name)


@dataclass(frozen=True)
class Layers:
    """What stands between a network's inputs and its outputs."""

    hidden: tuple[int, ...] = (64, 64)
    activation: Activation = "tanh"
    architecture: Architecture = "mlp"
    matmul: Matmul = "float32"

    def network(self, inputs: int, outputs: int, last_gain: float) -> nn.Sequential:
        """[…, inputs] to […, outputs]; orthogonal weights, zero biases.

        The last layer has gain `last_gain`: 0.01 for a policy, so that it starts near the centre of its range whatever
        it sees (Andrychowicz et al. 2021, arXiv:2006.05990, section 3.2), 1 for a value; the others have √2.
        """
        kind = nn.Linear if self.matmul == "float32" else Bfloat16Linear
        last = self.hidden[-1] if self.hidden else inputs
        layers: list[nn.Module] = []
        if self.architecture == "simba":
            layers += [_orthogonal(nn.Linear(inputs, last), 1.0)]
            layers += [*(Residual(last, kind) for _ in self.hidden), nn.LayerNorm(last)]
        else:
            for i, (before, after) in enumerate(pairwise((inputs, *self.hidden))):
                layers += [_orthogonal((kind if i else nn.Linear)(before, after), 2**0.5)]
                layers += [nn.LayerNorm(after)] if self.architecture == "layer_norm" else []
                layers += [ACTIVATIONS[self.activation]()]
        return nn.Sequential(*layers, _orthogonal(nn.Linear(last, outputs), last_gain))


class Residual(nn.Module):
    """x + W₂ relu(W₁ LN(x)), four times as wide inside: a block of SimBa, Lee et al. 2025, arXiv:2410.09754, eq. 5."""

    def __init__(self, width: int, kind: type[nn.Linear] = nn.Linear) -> None:
        super().__init__()
        inner, outer = kind(width, 4 * width), kind(4 * width, width)
        self.layers = nn.Sequential(
            nn.LayerNorm(width), _orthogonal(inner, 2**0.5), nn.ReLU(), _orthogonal(outer, 2**0.5)
        )

    def forward(self, x: Tensor) -> Tensor:
        """[…, width] to the same shape."""
        return x + self.layers(x)


class ImageEncoder(nn.Module):
    """Three strided 3 × 3 convolutions with ReLU (16, 32, 32 channels), each halving height and width."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.shape = shape
        channels = (shape[2], 16, 32, 32)
        layers: list[nn.Module] = []
        for i in range(3):
            convolution = nn.Conv2d(channels[i], channels[i + 1], kernel_size=3, stride=2, padding=1)
            layers += [_orthogonal(convolution, 2**0.5), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Flatten())
        height, width, _ = shape
        for _ in range(3):
            height, width = (height + 1) // 2, (width + 1) // 2
        self.size = channels[-1] * height * width
        """length of what comes out"""

    def forward(self, pixels: Tensor) -> Tensor:
        """[…, H · W · C] in [0, 1] to […, `size`]."""
        images = pixels.reshape(-1, *self.shape).movedim(-1, 1)
        return self.layers(images).reshape(*pixels.shape[:-1], self.size)


def _orthogonal(layer: nn.Linear | nn.Conv2d, gain: float) -> nn.Module:
    nn.init.orthogonal_(layer.weight, gain)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer
