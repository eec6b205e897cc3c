"""A policy as a list of operations with static shapes: the one description that C and ONNX are both written from.

Shapes are those of one observation: the batch axis is left out, and every operation treats the rows of a batch alike.
Operations have ONNX's names, except for `Linear`, x Wᵀ + b, and `RoundBfloat16`, which rounds to 8 bits of mantissa.
Reductions and `ArgMax` work along the last axis, which a reduction keeps with length 1.
"""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

Kind = Literal["float", "int", "bool"]
"""the kind of a value's numbers; in C all of them are floats"""

ELEMENTWISE = {"Neg", "Abs", "Exp", "Log", "Sqrt", "Sin", "Cos", "Tanh", "Sigmoid", "Erf", "Floor", "RoundBfloat16"}
ELEMENTWISE |= {"Add", "Sub", "Mul", "Div", "Max", "Min", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "Equal"}
ELEMENTWISE |= {"Not", "And", "Or", "Where", "Cast"}
"""operations that work number by number, with broadcasting"""
VIEWS = {"Slice", "Reshape", "Transpose", "Expand"}
"""operations whose result has the same numbers at other places"""

KINDS: dict[torch.dtype, Kind] = {
    torch.float32: "float",
    torch.bfloat16: "float",
    torch.bool: "bool",
    torch.int64: "int",
    torch.int32: "int",
}
BATCH = object()
"""the number of observations, where it stands in a shape"""


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


class UntranslatableError(Exception):
    """Something that has no translation; the message names it."""


class Call:
    """One call of torch's in a traced graph: appends the operations that it becomes to `operations`.

    Args:
        operations: the list so far.
        fake: the result as torch.export describes it, with sizes and types but without numbers.
        name: of torch's operation.
        batch: the symbol of the number of observations.
    """

    def __init__(self, operations: list[Operation], fake: Any, name: str, batch: str) -> None:
        self.operations, self.fake, self.name, self.batch = operations, fake, name, batch

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the result for one observation."""
        return self.shape_of(self.fake)

    def shape_of(self, fake: Tensor) -> tuple[int, ...]:
        """The shape of a result without its batch axis. Raises `UntranslatableError` where that is not the first."""
        first, *others = fake.shape if fake.shape else (0,)
        if str(first) != self.batch or not all(isinstance(size, int) for size in others):
            raise UntranslatableError(f"{self.name} mixes the observations of a batch")
        return tuple(others)

    @property
    def kind(self) -> Kind:
        """The kind of the result's numbers. Raises `UntranslatableError` for other types than those of `KINDS`."""
        if self.fake.dtype not in KINDS:
            raise UntranslatableError(f"it computes in {str(self.fake.dtype).removeprefix('torch.')}")
        return KINDS[self.fake.dtype]

    def add(
        self, name: str, *inputs: Any, shape: tuple[int, ...] | None = None, kind: Kind = "float", **settings: Any
    ) -> Value:
        """A new operation; numbers and tensors among its inputs become constants."""
        shape = self.shape if shape is None else shape
        rank = 2 if name == "Linear" else len(shape)  # a weight [1, n] has no batch axis that could be dropped
        operands = tuple(constant(operand, rank) for operand in inputs)
        value = Value(f"v{len(self.operations)}", shape, kind)
        self.operations.append(Operation(name, operands, value, settings))
        return value

    def as_kind(self, operand: Any, kind: Kind) -> Any:
        """The operand with numbers of another kind."""
        if isinstance(operand, Value):
            return operand if operand.kind == kind else self.add("Cast", operand, shape=operand.shape, kind=kind)
        numbers = {"float": np.float32, "int": np.int64, "bool": np.bool_}[kind]
        return array(operand).astype(numbers)

    def rounded(self, value: Value) -> Value:
        """The value, rounded where torch's result has the type bfloat16."""
        is_bfloat16 = self.fake.dtype is torch.bfloat16
        return self.add("RoundBfloat16", value, shape=value.shape) if is_bfloat16 else value

    def axis(self, axis: int, rank: int) -> int:
        """The axis of one observation, which has `rank` axes, that is `axis` of a batch."""
        axis %= rank + 1
        if axis == 0:
            raise UntranslatableError(f"{self.name} mixes the observations of a batch")
        return axis - 1


def array(operand: Any) -> np.ndarray:
    """A number or a tensor as an array."""
    if isinstance(operand, Tensor):
        operand = operand.detach()
        return (operand.float() if operand.is_floating_point() else operand).numpy()
    return np.asarray(operand, dtype=np.float32 if isinstance(operand, float) else None)


def constant(operand: Any, rank: int) -> Operand:
    """An operand of an operation whose result has `rank` axes; a constant loses its batch axis, of length 1."""
    if isinstance(operand, Value):
        return operand
    numbers = array(operand)
    return numbers[0] if numbers.ndim > rank and numbers.shape[0] == 1 else numbers
