"""Activation functions."""

from typing import Literal

from torch import nn

from lemniscate.maths import tanh

Activation = Literal["tanh", "relu", "elu", "silu"]


class Tanh(nn.Module):
    """`lemniscate.maths.tanh`, any shape to the same shape."""

    forward = staticmethod(tanh)


ACTIVATIONS = {"tanh": Tanh, "relu": nn.ReLU, "elu": nn.ELU, "silu": nn.SiLU}
