"""One call of a traced graph, on its way into operations."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate.exporting.operations import Kind, Operand, Operation, Value

KINDS: dict[torch.dtype, Kind] = {
    torch.float32: "float",
    torch.bfloat16: "float",
    torch.bool: "bool",
    torch.int64: "int",
    torch.int32: "int",
}
BATCH = object()
"""the number of observations, in the place of a shape's number"""


class UntranslatableError(Exception):
    """The name of what has no translation."""


class Call:
    """One call of the graph: makes operations, and the values that they result in."""

    def __init__(self, operations: list[Operation], fake: Any, name: str, batch: str) -> None:
        self.operations, self.name, self.batch = operations, name, batch
        self.fake = fake
        """the result as torch.export describes it: sizes and types, no numbers"""

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the result for one observation."""
        return self._own(self.fake)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """The shape of each result for one observation, where there are several."""
        return [self._own(fake) for fake in self.fake]

    @property
    def kind(self) -> Kind:
        """The kind of the result's numbers. Raises `UntranslatableError` for a type without one."""
        if self.fake.dtype not in KINDS:
            raise UntranslatableError(f"it computes in {str(self.fake.dtype).removeprefix('torch.')}")
        return KINDS[self.fake.dtype]

    @property
    def is_bfloat16(self) -> bool:
        """Whether the result is rounded to bfloat16."""
        return self.fake.dtype is torch.bfloat16

    def _own(self, fake: Tensor) -> tuple[int, ...]:
        first, *others = fake.shape if fake.shape else (0,)
        if str(first) != self.batch or not all(isinstance(size, int) for size in others):
            raise UntranslatableError(f"{self.name} mixes the observations of a batch")
        return tuple(others)

    def add(
        self, name: str, *inputs: Any, shape: tuple[int, ...] | None = None, kind: Kind = "float", **settings: Any
    ) -> Value:
        """A new operation; numbers and tensors among its inputs become constants."""
        shape = self.shape if shape is None else shape
        rank = 2 if name == "Linear" else len(shape)  # of constants: a weight [1, n] has no batch axis
        operands = tuple(constant(operand, rank) for operand in inputs)
        value = Value(f"v{len(self.operations)}", shape, kind)
        self.operations.append(Operation(name, operands, value, settings))
        return value

    def as_kind(self, operand: Any, kind: Kind) -> Any:
        """The operand in numbers of another kind."""
        if isinstance(operand, Value):
            return operand if operand.kind == kind else self.add("Cast", operand, shape=operand.shape, kind=kind)
        numbers = {"float": np.float32, "int": np.int64, "bool": np.bool_}[kind]
        return array(operand).astype(numbers)

    def rounded(self, value: Value) -> Value:
        """The value, rounded where torch's has the type bfloat16."""
        return self.add("RoundBfloat16", value, shape=value.shape) if self.is_bfloat16 else value

    def axis(self, axis: int, rank: int) -> int:
        """The axis of one observation that is `axis` of a batch with `rank` axes."""
        axis %= rank
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
    """An operand beside results of `rank` axes: a constant with a batch axis, of length 1, loses it."""
    if isinstance(operand, Value):
        return operand
    numbers = array(operand)
    if numbers.ndim > rank and numbers.shape[0] == 1:
        numbers = numbers[0]
    return numbers
