"""A policy as a list of operations with static shapes: the one description that C and ONNX are both written from.

Shapes are those of one observation: the batch axis is left out, and every operation treats its rows alike. The names of
operations are ONNX's, but for `Linear`, x Wᵀ + b, and `RoundBfloat16`, to 8 bits of mantissa and back.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

Kind = Literal["float", "int", "bool"]
"""of numbers; in C all are float"""

UNARY = ("Neg", "Abs", "Exp", "Log", "Sqrt", "Sin", "Cos", "Tanh", "Sigmoid", "Erf", "Floor", "Not", "RoundBfloat16")
COMPARISONS = ("Greater", "GreaterOrEqual", "Less", "LessOrEqual", "Equal")
BINARY = ("Add", "Sub", "Mul", "Div", "Max", "Min", "And", "Or", *COMPARISONS)
ELEMENTWISE = (*UNARY, *BINARY, "Where", "Cast")
"""number by number, with broadcasting"""
VIEWS = ("Slice", "Reshape", "Transpose", "Expand")
"""the same numbers at other places"""
WHOLE = ("Linear", "Concat", "ArgMax", "ReduceSum", "ReduceMean", "ReduceMax", "ReduceMin")
"""need all of their inputs; reductions are over the last axis, which stays with length 1, and that of ArgMax goes"""


@dataclass(frozen=True, eq=False)
class Value:
    """A result of an operation, or the observation: its shape for one observation, and the kind of its numbers."""

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
    """One step: `name` from the tables above, its inputs and its output.

    `settings` are of `Slice` axis, start; of `Transpose` axes; of `Concat` axis; each of one observation's axes.
    """

    name: str
    inputs: tuple[Operand, ...]
    output: Value
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Program:
    """Operations in their order, from the flat observation to the action for `env.step`."""

    obs: Value
    operations: tuple[Operation, ...]
    action: Value

    @property
    def multiplications(self) -> int:
        """The multiplications in matrix products, for one observation."""
        linear = [operation for operation in self.operations if operation.name == "Linear"]
        return sum(operation.output.size * weight_of(operation).shape[1] for operation in linear)

    @property
    def is_rounded(self) -> bool:
        """Whether some products are of bfloat16."""
        return any(operation.name == "RoundBfloat16" for operation in self.operations)


def weight_of(operation: Operation) -> np.ndarray:
    """W [outputs, inputs] of a `Linear`."""
    weight = operation.inputs[1]
    assert isinstance(weight, np.ndarray)
    return weight
