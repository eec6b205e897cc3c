"""A policy as a list of operations with static shapes: the one description that C and ONNX are both written from.

Shapes are those of one observation: the batch axis is left out, and every operation treats the rows of a batch alike.
Operations have ONNX's names, except for `Linear`, x Wᵀ + b, and `RoundBfloat16`, which rounds to 8 bits of mantissa.
Reductions and `ArgMax` work along the last axis, which a reduction keeps with length 1. What neither multiplies
matrices nor moves numbers to other places works number by number, with broadcasting.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

Kind = Literal["float", "int", "bool"]
"""the kind of a value's numbers; in C all of them are floats"""


@dataclass(frozen=True, eq=False)
class Value:
    """The observation or the result of an operation: its shape for one observation, and the kind of its numbers."""

    name: str
    shape: tuple[int, ...]
    kind: Kind = "float"

    @property
    def size(self) -> int:
        """The number of its numbers."""
        return math.prod(self.shape)


Operand = Value | np.ndarray
"""a result, or constants without a batch axis"""


@dataclass(frozen=True, eq=False)
class Operation:
    """One operation with its inputs and its output.

    `settings` hold `axis` and `start` of `Slice`, `axes` of `Transpose`, `axis` of `Concat`: axes of one observation.
    """

    name: str
    inputs: tuple[Operand, ...]
    output: Value
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def weight(self) -> np.ndarray:
        """W [outputs, inputs] of a `Linear`."""
        weight = self.inputs[1]
        assert isinstance(weight, np.ndarray)
        return weight


@dataclass(frozen=True, eq=False)
class Program:
    """Operations in their order, from the flat observation to the action for `env.step`."""

    obs: Value
    operations: tuple[Operation, ...]
    action: Value

    @property
    def multiplications(self) -> int:
        """The number of multiplications in matrix products, for one observation."""
        linear = [operation for operation in self.operations if operation.name == "Linear"]
        return sum(operation.output.size * operation.weight.shape[1] for operation in linear)

    @property
    def is_rounded(self) -> bool:
        """Whether some products are rounded to bfloat16."""
        return any(operation.name == "RoundBfloat16" for operation in self.operations)
