"""A policy as a list of operations with static shapes, and the translation of a module into one, through torch.export.

The list is the one description that C and ONNX are both written from. Shapes are those of one observation: the batch
axis is left out, and every operation treats the rows of a batch alike. Operations have ONNX's names, except for
`Linear`, x Wᵀ + b, and `RoundBfloat16`, which rounds to 8 bits of mantissa. Reductions and `ArgMax` work along the last
axis, which a reduction keeps with length 1. What neither multiplies matrices nor moves numbers to other places works
number by number, with broadcasting.

torch takes a module apart into its own operations. Each of them that depends on the observation has a function here: of
the `Walk` that is at it and of the operation's own arguments, among which results are `Value`s and everything else is
constant. What does not depend on the observation, like the normalizer's standard deviation, is computed here, once.
"""

import math
import operator
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch._decomp import get_decompositions
from torch.export.graph_signature import InputKind
from torch.fx import GraphModule, Interpreter, Node
from torch.utils import _pytree as pytree

from lemniscate.errors import UserError

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
    """Operations in their order, from the flat observation to the action for `env.step`.

    Of a policy with a memory also from what it remembers before, `memory`, to the next one, `after`.
    """

    obs: Value
    operations: tuple[Operation, ...]
    action: Value
    memory: Value | None = None
    after: Value | None = None

    @property
    def memory_size(self) -> int:
        """K, the numbers that the policy remembers; 0 without a memory."""
        return self.memory.size if self.memory else 0

    @property
    def multiplications(self) -> int:
        """The number of multiplications in matrix products, for one observation."""
        linear = [operation for operation in self.operations if operation.name == "Linear"]
        return sum(operation.output.size * operation.weight.shape[1] for operation in linear)

    @property
    def is_rounded(self) -> bool:
        """Whether some products are rounded to bfloat16."""
        return any(operation.name == "RoundBfloat16" for operation in self.operations)


Translation = Callable[..., Any]

aten = torch.ops.aten
KEPT = (aten.linear.default, aten.layer_norm.default, aten.silu.default)
"""operations that torch would take apart, and that have a translation as they are"""
TAKEN_APART = (aten.gelu, aten.elu, aten.leaky_relu, aten._softmax, aten.addmm, aten.index_select)
"""operations that torch takes apart only on request"""
CHECKS = ("_assert_tensor_metadata", "_assert_scalar", "sym_constrain_range_for_size")
"""operations without a result"""

KINDS: dict[torch.dtype, Kind] = {
    torch.float32: "float",
    torch.bfloat16: "float",
    torch.bool: "bool",
    torch.int64: "int",
    torch.int32: "int",
}
BATCH = object()
"""the number of observations, where it stands in a shape"""


class UntranslatableError(UserError):
    """Something that has no translation."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"This network cannot be exported: {reason}.")


class Walk(Interpreter):
    """A walk through torch's graph, node by node, that collects `operations`.

    Attributes:
        name: of torch's operation at this node.
        fake: its result as torch.export describes it, with sizes and types but without numbers.
        batch: the symbol of the number of observations.
    """

    fake: Any

    def __init__(self, graph: GraphModule, batch: str) -> None:
        super().__init__(graph)
        self.extra_traceback = False  # torch would put the node in front of an error's message
        self.operations: list[Operation] = []
        self._known: dict[Any, Value] = {}
        """the results so far, by what they are computed from: nothing is computed twice"""
        self.batch = batch

    def run_node(self, n: Node) -> Any:
        """The result of a node: a `Value`, `BATCH`, or a constant."""
        if n.op != "call_function":
            return super().run_node(n)
        name, (args, kwargs) = _name_of(n), self.fetch_args_kwargs_from_env(n)
        if name in CHECKS:
            return None
        given = pytree.tree_leaves((args, kwargs))
        if not any(isinstance(leaf, Value) or leaf is BATCH for leaf in given):
            return super().run_node(n)
        if getattr(n.target, "__module__", "") == "_operator" and BATCH in given:  # on its way into a shape
            return BATCH
        if name not in TRANSLATIONS:
            raise UntranslatableError(f"{name} has no translation")
        self.name, self.fake = name, n.meta["val"]
        return TRANSLATIONS[name](self, *args, **kwargs)

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
        self, name: str, *inputs: Any, shape: tuple[int, ...] | None = None, kind: Kind | None = None, **settings: Any
    ) -> Value:
        """A new operation, whose shape and kind are those of the result unless they are given.

        Numbers and tensors among its inputs become constants, without a batch axis of length 1.
        """
        shape, kind = self.shape if shape is None else shape, kind or self.kind
        rank = 2 if name == "Linear" else len(shape)  # a weight [1, n] has no batch axis that could be dropped
        operands = list[Operand]()
        for given in inputs:
            operand = given if isinstance(given, Value) else array(given)
            if isinstance(operand, np.ndarray) and operand.ndim > rank and operand.shape[0] == 1:
                operand = operand[0]
            operands.append(operand)
        same = [x if isinstance(x, Value) else (x.dtype.str, x.shape, x.tobytes()) for x in operands]
        key = name, *same, shape, kind, *settings.items()
        if key not in self._known:
            self._known[key] = Value(f"v{len(self.operations)}", shape, kind)
            self.operations.append(Operation(name, tuple(operands), self._known[key], settings))
        return self._known[key]

    def as_kind(self, operand: Any, kind: Kind | None = None) -> Any:
        """The operand with numbers of a kind, by default that of the result."""
        kind = kind or self.kind
        if isinstance(operand, Value):
            return operand if operand.kind == kind else self.add("Cast", operand, shape=operand.shape, kind=kind)
        return array(operand).astype({"float": np.float32, "int": np.int64, "bool": np.bool_}[kind])

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


def _elementwise(name: str, kind: Kind | None = None) -> Translation:
    """An operation number by number, on operands of that kind, or else of the kind of its result."""

    def translation(walk: Walk, *operands: Any, alpha: float = 1, rounding_mode: str | None = None) -> Value:
        if rounding_mode is not None:
            raise UntranslatableError(f"{walk.name} with rounding has no translation")
        if walk.name.startswith("bitwise_") and walk.fake.dtype != torch.bool:
            raise UntranslatableError(f"{walk.name} of whole numbers has no translation")
        own = [walk.as_kind(operand, kind) for operand in operands]
        if alpha != 1:
            own[1] = walk.add("Mul", own[1], walk.as_kind(alpha))
        return walk.rounded(walk.add(name, *own))

    return translation


def _clamp(walk: Walk, x: Value, min: Any = None, max: Any = None) -> Value:
    for name, bound in (("Max", min), ("Min", max)):
        x = x if bound is None else walk.add(name, x, walk.as_kind(bound))
    return x


def _power(walk: Walk, x: Any, exponent: Any) -> Value:
    if not isinstance(x, Value) or exponent not in (1, 2, 3, 4, 0.5, -0.5, -1, -2):
        raise UntranslatableError(f"pow with the exponent {exponent} has no translation")
    y = walk.add("Sqrt", x) if abs(exponent) == 0.5 else x
    for _ in range(int(abs(exponent)) - 1):
        y = walk.add("Mul", y, x)
    return y if exponent > 0 else walk.add("Div", np.float32(1), y)


def _where(walk: Walk, condition: Any, a: Any, b: Any) -> Value:
    return walk.add("Where", walk.as_kind(condition, "bool"), walk.as_kind(a), walk.as_kind(b))


def _linear(walk: Walk, x: Value, weight: Any, bias: Any = None) -> Value:
    if not isinstance(x, Value) or isinstance(weight, Value) or isinstance(bias, Value) or weight.ndim != 2:
        raise UntranslatableError("a product of two results has no translation")
    biases = () if bias is None else (np.broadcast_to(array(bias), (len(weight),)),)
    return walk.rounded(walk.add("Linear", x, np.ascontiguousarray(array(weight)), *biases))


def _layer_norm(
    walk: Walk, x: Value, size: list[int], weight: Any = None, bias: Any = None, eps: float = 1e-5, *_: Any
) -> Value:
    if len(size) != 1:
        raise UntranslatableError("layer_norm over several axes has no translation")
    one = (*x.shape[:-1], 1)
    centred = walk.add("Sub", x, walk.add("ReduceMean", x, shape=one))
    variance = walk.add("ReduceMean", walk.add("Mul", centred, centred), shape=one)
    y = walk.add("Div", centred, walk.add("Sqrt", walk.add("Add", variance, np.float32(eps), shape=one), shape=one))
    y = y if weight is None else walk.add("Mul", y, weight)
    return y if bias is None else walk.add("Add", y, bias)


def _require_last(walk: Walk, x: Value, axes: list[int]) -> None:
    if [walk.axis(axis, len(x.shape)) for axis in axes] != [len(x.shape) - 1]:
        raise UntranslatableError(f"{walk.name} over another axis than the last has no translation")


def _reduction(name: str) -> Translation:
    def translation(walk: Walk, x: Value, axes: Any = None, keepdim: bool = False, **_: Any) -> Value:
        axes = [axes] if isinstance(axes, int) else list(axes or [0])
        _require_last(walk, x, axes)
        y = walk.add(name, walk.as_kind(x), shape=(*x.shape[:-1], 1))
        return y if keepdim else walk.add("Reshape", y)

    return translation


def _argmax(walk: Walk, x: Value, axis: int | None = None, keepdim: bool = False) -> Value:
    _require_last(walk, x, [0 if axis is None else axis])
    y = walk.add("ArgMax", x, shape=x.shape[:-1])
    return walk.add("Reshape", y) if keepdim else y


def _slice(walk: Walk, x: Value, axis: int = 0, start: int | None = None, end: Any = None, step: int = 1) -> Value:
    if axis % (len(x.shape) + 1) == 0 and not start and step == 1 and (end is None or end is BATCH or end > 2**60):
        return x
    if step != 1:
        raise UntranslatableError("a slice with steps has no translation")
    own = walk.axis(axis, len(x.shape))
    begin, _, _ = slice(start, None).indices(x.shape[own])
    return walk.add("Slice", x, axis=own, start=begin)


def _part(walk: Walk, x: Value, axis: int, start: int, size: int = 1) -> Value:
    """The `size` rows of x from `start` on, along an axis of a batch."""
    own = walk.axis(axis, len(x.shape))
    shape = (*x.shape[:own], size, *x.shape[own + 1 :])
    return walk.add("Slice", x, shape=shape, kind=x.kind, axis=own, start=start + x.shape[own] * (start < 0))


def _index(walk: Walk, x: Value, places: list[Any]) -> Value:
    """x[:, places], for constant places along one axis."""
    ((axis, indices), *others) = [(axis, index) for axis, index in enumerate(places) if index is not None]
    if others or isinstance(indices, Value) or indices.ndim != 1 or indices.dtype != torch.int64:
        raise UntranslatableError("index with more than constant places along one axis has no translation")
    rows = [_part(walk, x, axis, index) for index in indices.tolist()]
    return walk.add("Concat", *rows, axis=walk.axis(axis, len(x.shape)))


def _split(walk: Walk, x: Value, _sizes: Any, axis: int = 0) -> list[Value]:
    own = walk.axis(axis, len(x.shape))
    sizes = [walk.shape_of(fake)[own] for fake in walk.fake]
    return [_part(walk, x, axis, sum(sizes[:i]), size) for i, size in enumerate(sizes)]


def _shaped(name: str) -> Translation:
    def translation(walk: Walk, x: Any, *_: Any, **__: Any) -> Any:
        if not isinstance(x, Value):  # a constant: with a batch axis of length 1, as `_full`
            return (x.expand if name == "Expand" else x.reshape)(1, *walk.shape)
        return x if x.shape == walk.shape else walk.add(name, x)

    return translation


def _permute(walk: Walk, x: Value, axes: list[int]) -> Value:
    rank = len(x.shape) + 1
    if axes[0] % rank:
        raise UntranslatableError("permute mixes the observations of a batch")
    return walk.add("Transpose", x, axes=tuple(axis % rank - 1 for axis in axes[1:]))


def _cat(walk: Walk, parts: list[Any], axis: int = 0) -> Value:
    own = walk.axis(axis, len(walk.shape))
    first = next(part for part in parts if isinstance(part, Value))
    rows = [part if isinstance(part, Value) else _in_batch(walk, array(part), first, own) for part in parts]
    return walk.add("Concat", *map(walk.as_kind, rows), axis=own)


def _in_batch(walk: Walk, numbers: np.ndarray, x: Value, own: int) -> Value:
    """Constants as a result: ONNX joins nothing that has no batch axis to something that has one."""
    shape = (*walk.shape[:own], numbers.shape[own - len(walk.shape)], *walk.shape[own + 1 :])
    one = walk.as_kind(_part(walk, x, own + 1, 0), "float")
    zero = walk.add("Sub", one, one, shape=one.shape, kind="float")
    return walk.add("Add", zero, numbers, shape=shape, kind="float")


def _full(walk: Walk, _size: Any, number: float = 0.0, **_: Any) -> Tensor:
    return torch.full((1, *walk.shape), number, dtype=walk.fake.dtype)


TRANSLATIONS: dict[str, Translation] = {
    **{name: _elementwise(name.capitalize()) for name in ("exp", "log", "sqrt", "sin", "cos", "tanh", "sigmoid")},
    **{name: _elementwise(name.capitalize()) for name in ("erf", "floor", "neg", "abs", "add", "sub", "mul", "div")},
    "maximum": _elementwise("Max"),
    "minimum": _elementwise("Min"),
    "gt": _elementwise("Greater", "float"),
    "ge": _elementwise("GreaterOrEqual", "float"),
    "lt": _elementwise("Less", "float"),
    "le": _elementwise("LessOrEqual", "float"),
    "eq": _elementwise("Equal", "float"),
    "ne": lambda walk, a, b: walk.add("Not", _elementwise("Equal", "float")(walk, a, b)),
    **dict.fromkeys(("logical_and", "bitwise_and"), _elementwise("And", "bool")),
    **dict.fromkeys(("logical_or", "bitwise_or"), _elementwise("Or", "bool")),
    **dict.fromkeys(("logical_not", "bitwise_not"), _elementwise("Not", "bool")),
    "where": _where,
    **dict.fromkeys(("_to_copy", "to"), lambda walk, x, *_, **__: walk.rounded(walk.as_kind(x))),
    "relu": lambda walk, x: walk.add("Max", x, np.float32(0)),
    "silu": lambda walk, x: walk.add("Mul", x, walk.add("Sigmoid", x)),
    **dict.fromkeys(("clamp", "clamp_min"), _clamp),
    "hardtanh": lambda walk, x, low=-1.0, high=1.0: _clamp(walk, x, low, high),
    "pow": _power,
    "square": lambda walk, x: _power(walk, x, 2),
    "reciprocal": lambda walk, x: _power(walk, x, -1),
    "rsqrt": lambda walk, x: _power(walk, x, -0.5),
    "log1p": lambda walk, x: walk.add("Log", walk.add("Add", x, np.float32(1))),
    "expm1": lambda walk, x: walk.add("Sub", walk.add("Exp", x), np.float32(1)),
    "linear": _linear,
    "mm": lambda walk, x, weight: _linear(walk, x, weight if isinstance(weight, Value) else weight.T),
    "layer_norm": _layer_norm,
    "cat": _cat,
    "sum": _reduction("ReduceSum"),
    "mean": _reduction("ReduceMean"),
    "amax": _reduction("ReduceMax"),
    "amin": _reduction("ReduceMin"),
    "argmax": _argmax,
    "slice": _slice,
    "select": lambda walk, x, axis, index: walk.add("Reshape", _part(walk, x, axis, index)),
    "index": _index,
    **dict.fromkeys(("split", "chunk", "split_with_sizes"), _split),
    "permute": _permute,
    **dict.fromkeys(("view", "_unsafe_view", "reshape", "unsqueeze", "squeeze"), _shaped("Reshape")),
    "expand": _shaped("Expand"),
    **dict.fromkeys(("full", "full_like", "zeros", "zeros_like"), _full),
    "ones_like": lambda walk, x, **_: _full(walk, x, 1.0),
    "lerp": lambda walk, a, b, weight: walk.add("Add", a, walk.add("Mul", weight, walk.add("Sub", b, a))),
    "addcmul": lambda walk, x, a, b, value=1: TRANSLATIONS["add"](walk, x, walk.add("Mul", a, b), alpha=value),
    "sym_size": lambda walk, *_: BATCH,
    **dict.fromkeys(("alias", "clone", "detach", "contiguous"), lambda walk, x, *_, **__: x),
    "getitem": lambda walk, parts, index: parts[index],
}
"""by the name of torch's operation; what is not here has no translation"""


TRACING = Lock()
"""`torch.export` traces one module at a time in a process"""


def translate(module: nn.Module, inputs: int, memory: int = 0) -> Program:
    """The operations of a module from [B, inputs] to [B, …], for any B.

    With `memory` K, also from [B, K] to the next [B, K].

    Raises:
        UserError: an operation that has no translation, or a result that depends on more than one row.
    """
    with TRACING:
        exported = _exported(module, [inputs, memory] if memory else [inputs])
    signature, constants = exported.graph_signature, {**exported.state_dict, **exported.constants}
    nodes = [node for node in exported.graph.nodes if node.name in signature.user_inputs]
    values = [Value(name, tuple(n.meta["val"].shape[1:])) for name, n in zip(("obs", "memory"), nodes, strict=False)]
    walk, given = Walk(exported.graph_module, str(nodes[0].meta["val"].shape[0])), iter(values)
    specs = signature.input_specs
    places = [next(given) if spec.kind is InputKind.USER_INPUT else constants.get(spec.target or "") for spec in specs]
    results = walk.run(*places, enable_io_processing=False)
    for name, result in zip(("actions", "next memory"), results, strict=False):
        if not isinstance(result, Value):
            raise UntranslatableError(f"its {name} do not depend on the observation")
    (obs, *before), (action, *after) = values, results
    return Program(obs, _needed(walk.operations, *results), action, *before, *after)


def _exported(module: nn.Module, inputs: list[int]) -> torch.export.ExportedProgram:
    batch = {0: torch.export.Dim("batch", min=2)}  # a batch of 1 would be taken for a constant
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # torch warns of its own parts
            exported = torch.export.export(
                module, tuple(torch.zeros(3, n) for n in inputs), dynamic_shapes=(batch,) * len(inputs)
            )
            names = {_name_of(node) for node in exported.graph.nodes if node.op == "call_function"}
            # taking operations apart needs a second, and most networks here do without it
            if names <= {*TRANSLATIONS, *CHECKS}:
                return exported
            table = torch.export.default_decompositions()
            table.update(get_decompositions(TAKEN_APART))
            for operation in KEPT:
                table.pop(operation, None)
            return exported.run_decompositions(table)
    except Exception as error:  # whatever the code of a user's own network, or its tracing, raises
        if "Constraints violated" in str(error):
            raise UntranslatableError("it is made for one number of observations") from None
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise UntranslatableError((lines or [type(error).__name__])[0].rstrip(".:")) from None


def _name_of(node: Node) -> str:
    """The name of torch's operation without its overload; one that works in place ends in an underscore."""
    parts = str(node.target).split(".")
    return "getitem" if node.target is operator.getitem else parts[min(1, len(parts) - 1)]


def _needed(operations: list[Operation], *results: Value) -> tuple[Operation, ...]:
    """The operations that the results depend on, in their order; the mode needs no standard deviation, for example."""
    values, kept = set(results), list[Operation]()
    for operation in reversed(operations):
        if operation.output in values:
            values.update(operand for operand in operation.inputs if isinstance(operand, Value))
            kept.append(operation)
    return tuple(reversed(kept))
