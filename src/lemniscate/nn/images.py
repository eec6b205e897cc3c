"""The normalizer and the encoder of images."""

import torch
from torch import Tensor, nn

from lemniscate.nn.networks import orthogonal
from lemniscate.nn.normalizer import NoNorm


class ScaleBytes(NoNorm):
    """Bytes to numbers from -½ to ½."""

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O or more] uint8 to […, O]."""
        return super().forward(obs).float() / 255 - 0.5


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
