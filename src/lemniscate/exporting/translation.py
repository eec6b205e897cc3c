"""The translation of a module into a list of operations, through torch.export.

torch takes a module apart into its own operations. Each of them that depends on the observation has a function here: of
the `Call` and of the arguments of torch's operation, among which results are `Value`s and everything else is constant.
What does not depend on the observation, like the normalizer's standard deviation, is computed here, once.
"""

import operator
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch._decomp import get_decompositions
from torch.export.graph_signature import InputKind
from torch.fx import GraphModule, Interpreter, Node
from torch.utils import _pytree as pytree

from lemniscate.errors import UserError
from lemniscate.exporting.operations import BATCH, Call, Kind, Operation, Program, UntranslatableError, Value, array

Translation = Callable[..., Any]

aten = torch.ops.aten
KEPT = (aten.linear.default, aten.layer_norm.default, aten.silu.default)
"""operations that torch would take apart, and that have a translation as they are"""
TAKEN_APART = (aten.gelu, aten.elu, aten.leaky_relu, aten._softmax, aten.addmm, aten.index_select)
"""operations that torch takes apart only on request"""
CHECKS = ("_assert_tensor_metadata", "_assert_scalar", "sym_constrain_range_for_size")
"""operations without a result"""


def _unary(name: str) -> Translation:
    def translation(call: Call, x: Value) -> Value:
        return call.rounded(call.add(name, call.as_kind(x, "bool" if name == "Not" else "float"), kind=call.kind))

    return translation


def _arithmetic(name: str) -> Translation:
    def translation(call: Call, a: Any, b: Any, *, alpha: float = 1, rounding_mode: str | None = None) -> Value:
        if rounding_mode is not None:
            raise UntranslatableError(f"{call.name} with rounding has no translation")
        a, b = call.as_kind(a, call.kind), call.as_kind(b, call.kind)
        b = b if alpha == 1 else call.add("Mul", b, call.as_kind(alpha, call.kind), kind=call.kind)
        return call.rounded(call.add(name, a, b, kind=call.kind))

    return translation


def _comparison(name: str, kind: Kind = "float") -> Translation:
    return lambda call, a, b: call.add(name, call.as_kind(a, kind), call.as_kind(b, kind), kind="bool")


def _clamp(call: Call, x: Value, low: Any = None, high: Any = None, *, min: Any = None, max: Any = None) -> Value:
    low, high = min if low is None else low, max if high is None else high
    for name, bound in (("Max", low), ("Min", high)):
        x = x if bound is None else call.add(name, x, call.as_kind(bound, call.kind), kind=call.kind)
    return x


def _power(call: Call, x: Any, exponent: Any) -> Value:
    if not isinstance(x, Value) or exponent not in (1, 2, 3, 4, 0.5, -0.5, -1, -2):
        raise UntranslatableError(f"pow with the exponent {exponent} has no translation")
    if abs(exponent) == 0.5:
        y = call.add("Sqrt", x)
    else:
        y = x
        for _ in range(int(abs(exponent)) - 1):
            y = call.add("Mul", y, x)
    return y if exponent > 0 else call.add("Div", np.float32(1), y)


def _where(call: Call, condition: Any, a: Any, b: Any) -> Value:
    chosen = (call.as_kind(condition, "bool"), call.as_kind(a, call.kind), call.as_kind(b, call.kind))
    return call.add("Where", *chosen, kind=call.kind)


def _linear(call: Call, x: Value, weight: Any, bias: Any = None) -> Value:
    if not isinstance(x, Value) or isinstance(weight, Value) or isinstance(bias, Value) or weight.ndim != 2:
        raise UntranslatableError("a product of two results has no translation")
    biases = () if bias is None else (np.broadcast_to(array(bias), (len(weight),)),)
    return call.rounded(call.add("Linear", x, np.ascontiguousarray(array(weight)), *biases))


def _layer_norm(
    call: Call, x: Value, size: list[int], weight: Any = None, bias: Any = None, eps: float = 1e-5, *_: Any
) -> Value:
    if len(size) != 1:
        raise UntranslatableError("layer_norm over several axes has no translation")
    one = (*x.shape[:-1], 1)
    centred = call.add("Sub", x, call.add("ReduceMean", x, shape=one))
    variance = call.add("ReduceMean", call.add("Mul", centred, centred), shape=one)
    y = call.add("Div", centred, call.add("Sqrt", call.add("Add", variance, np.float32(eps), shape=one), shape=one))
    y = y if weight is None else call.add("Mul", y, weight)
    return y if bias is None else call.add("Add", y, bias)


def _require_last(call: Call, x: Value, axes: list[int]) -> None:
    if [call.axis(axis, len(x.shape)) for axis in axes] != [len(x.shape) - 1]:
        raise UntranslatableError(f"{call.name} over another axis than the last has no translation")


def _reduction(name: str) -> Translation:
    def translation(call: Call, x: Value, axes: Any = None, keepdim: bool = False, **_: Any) -> Value:
        axes = [axes] if isinstance(axes, int) else list(axes or [0])
        _require_last(call, x, axes)
        y = call.add(name, call.as_kind(x, call.kind), shape=(*x.shape[:-1], 1), kind=call.kind)
        return y if keepdim else call.add("Reshape", y, kind=call.kind)

    return translation


def _argmax(call: Call, x: Value, axis: int | None = None, keepdim: bool = False) -> Value:
    _require_last(call, x, [0 if axis is None else axis])
    y = call.add("ArgMax", x, shape=x.shape[:-1], kind="int")
    return call.add("Reshape", y, kind="int") if keepdim else y


def _slice(call: Call, x: Value, axis: int = 0, start: int | None = None, end: Any = None, step: int = 1) -> Value:
    if axis % (len(x.shape) + 1) == 0 and not start and step == 1 and (end is None or end is BATCH or end > 2**60):
        return x
    if step != 1:
        raise UntranslatableError("a slice with steps has no translation")
    own = call.axis(axis, len(x.shape))
    size = x.shape[own]
    begin = min(max((start or 0) + (size if (start or 0) < 0 else 0), 0), size)
    return call.add("Slice", x, kind=x.kind, axis=own, start=begin)


def _part(call: Call, x: Value, own: int, start: int, size: int) -> Value:
    """The `size` rows of x from `start` on, along an axis of one observation."""
    shape = (*x.shape[:own], size, *x.shape[own + 1 :])
    return call.add("Slice", x, shape=shape, kind=x.kind, axis=own, start=start)


def _index(call: Call, x: Value, places: list[Any]) -> Value:
    """x[:, places], for constant places along one axis."""
    ((axis, indices), *others) = [(axis, index) for axis, index in enumerate(places) if index is not None]
    if others or isinstance(indices, Value) or indices.ndim != 1 or indices.dtype != torch.int64:
        raise UntranslatableError("index with more than constant places along one axis has no translation")
    own = call.axis(axis, len(x.shape))
    rows = [_part(call, x, own, index % x.shape[own], 1) for index in indices.tolist()]
    return call.add("Concat", *rows, kind=x.kind, axis=own)


def _select(call: Call, x: Value, axis: int, index: int) -> Value:
    own = call.axis(axis, len(x.shape))
    return call.add("Reshape", _part(call, x, own, index % x.shape[own], 1), kind=x.kind)


def _split(call: Call, x: Value, _sizes: Any, axis: int = 0) -> list[Value]:
    own = call.axis(axis, len(x.shape))
    sizes = [call.shape_of(fake)[own] for fake in call.fake]
    return [_part(call, x, own, sum(sizes[:i]), size) for i, size in enumerate(sizes)]


def _shaped(name: str) -> Translation:
    return lambda call, x, *_, **__: x if x.shape == call.shape else call.add(name, x, kind=x.kind)


def _permute(call: Call, x: Value, axes: list[int]) -> Value:
    rank = len(x.shape) + 1
    if axes[0] % rank:
        raise UntranslatableError("permute mixes the observations of a batch")
    return call.add("Transpose", x, kind=x.kind, axes=tuple(axis % rank - 1 for axis in axes[1:]))


def _cat(call: Call, parts: list[Any], axis: int = 0) -> Value:
    own = call.axis(axis, len(call.shape))
    first = next(part for part in parts if isinstance(part, Value))
    rows = [part if isinstance(part, Value) else _in_batch(call, array(part), first, own) for part in parts]
    return call.add("Concat", *(call.as_kind(row, call.kind) for row in rows), kind=call.kind, axis=own)


def _in_batch(call: Call, numbers: np.ndarray, x: Value, own: int) -> Value:
    """Constants as a result: ONNX joins nothing that has no batch axis to something that has one."""
    shape = (*call.shape[:own], numbers.shape[own - len(call.shape)], *call.shape[own + 1 :])
    one = call.as_kind(_part(call, x, own, 0, 1), "float")
    return call.add("Add", call.add("Sub", one, one, shape=one.shape), numbers, shape=shape)


def _full(call: Call, _size: Any, number: float = 0.0, **_: Any) -> Tensor:
    return torch.full(call.shape, number, dtype=call.fake.dtype)


TRANSLATIONS: dict[str, Translation] = {
    **{name: _unary(name.capitalize()) for name in ("neg", "abs", "exp", "log", "sqrt", "sin", "cos", "tanh")},
    **{name: _unary(name.capitalize()) for name in ("sigmoid", "erf", "floor")},
    **{name: _arithmetic(name.capitalize()) for name in ("add", "sub", "mul", "div")},
    "maximum": _arithmetic("Max"),
    "minimum": _arithmetic("Min"),
    "gt": _comparison("Greater"),
    "ge": _comparison("GreaterOrEqual"),
    "lt": _comparison("Less"),
    "le": _comparison("LessOrEqual"),
    "eq": _comparison("Equal"),
    "ne": lambda call, a, b: call.add("Not", _comparison("Equal")(call, a, b), kind="bool"),
    **dict.fromkeys(("logical_and", "bitwise_and"), _comparison("And", "bool")),
    **dict.fromkeys(("logical_or", "bitwise_or"), _comparison("Or", "bool")),
    **dict.fromkeys(("logical_not", "bitwise_not"), _unary("Not")),
    "where": _where,
    **dict.fromkeys(("_to_copy", "to"), lambda call, x, *_, **__: call.rounded(call.as_kind(x, call.kind))),
    "relu": lambda call, x: call.add("Max", x, np.float32(0)),
    "silu": lambda call, x: call.add("Mul", x, call.add("Sigmoid", x)),
    **dict.fromkeys(("clamp", "hardtanh", "clamp_min"), _clamp),
    "pow": _power,
    "square": lambda call, x: _power(call, x, 2),
    "reciprocal": lambda call, x: _power(call, x, -1),
    "rsqrt": lambda call, x: _power(call, x, -0.5),
    "log1p": lambda call, x: call.add("Log", call.add("Add", x, np.float32(1))),
    "expm1": lambda call, x: call.add("Sub", call.add("Exp", x), np.float32(1)),
    "linear": _linear,
    "mm": lambda call, x, weight: _linear(call, x, weight if isinstance(weight, Value) else weight.T),
    "layer_norm": _layer_norm,
    "cat": _cat,
    "sum": _reduction("ReduceSum"),
    "mean": _reduction("ReduceMean"),
    "amax": _reduction("ReduceMax"),
    "amin": _reduction("ReduceMin"),
    "argmax": _argmax,
    "slice": _slice,
    "select": _select,
    "index": _index,
    **dict.fromkeys(("split", "chunk", "split_with_sizes"), _split),
    "permute": _permute,
    **dict.fromkeys(("view", "_unsafe_view", "reshape", "unsqueeze", "squeeze"), _shaped("Reshape")),
    "expand": _shaped("Expand"),
    **dict.fromkeys(("full", "full_like", "zeros"), _full),
    "sym_size": lambda call, *_: BATCH,
    **dict.fromkeys(("alias", "clone", "detach", "contiguous"), lambda call, x, *_, **__: x),
    "getitem": lambda call, parts, index: parts[index],
}
"""by the name of torch's operation; what is not here has no translation"""


def translate(module: nn.Module, inputs: int) -> Program:
    """The operations of a module from [B, inputs] to [B, …], for any B.

    Raises:
        UserError: an operation that has no translation, or a result that depends on more than one row.
    """
    try:
        return _program(_exported(module, inputs))
    except UntranslatableError as error:
        raise UserError(f"This network cannot be exported: {error}.") from None


def _program(exported: torch.export.ExportedProgram) -> Program:
    signature, constants = exported.graph_signature, {**exported.state_dict, **exported.constants}
    (given,) = (node for node in exported.graph.nodes if node.name in signature.user_inputs)
    batch, *shape = given.meta["val"].shape
    obs, translator = Value("obs", tuple(shape)), _Translator(exported.graph_module, str(batch))
    specs = signature.input_specs
    inputs = [obs if spec.kind is InputKind.USER_INPUT else constants.get(spec.target or "") for spec in specs]
    (action,) = translator.run(*inputs, enable_io_processing=False)
    if not isinstance(action, Value):
        raise UntranslatableError("its actions do not depend on the observation")
    return Program(obs, _needed(translator.operations, action), action)


def _exported(module: nn.Module, inputs: int) -> torch.export.ExportedProgram:
    batch = {0: torch.export.Dim("batch", min=2)}  # a batch of 1 would be taken for a constant
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # torch warns of its own parts
            exported = torch.export.export(module, (torch.zeros(3, inputs),), dynamic_shapes=(batch,))
            names = {_name_of(node) for node in exported.graph.nodes if node.op == "call_function"}
            # taking operations apart needs a second, and most networks here do without it
            return exported if names <= {*TRANSLATIONS, *CHECKS} else exported.run_decompositions(_decompositions())
    except Exception as error:  # whatever the code of a user's own network, or its tracing, raises
        if "Constraints violated" in str(error):
            raise UntranslatableError("it is made for one number of observations") from error
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise UntranslatableError((lines or [type(error).__name__])[0].rstrip(".:")) from error


def _decompositions() -> Any:
    """Everything that torch takes apart by default and `TAKEN_APART`, without `KEPT`."""
    table = torch.export.default_decompositions()
    table.update(get_decompositions(TAKEN_APART))
    for operation in KEPT:
        table.pop(operation, None)
    return table


def _name_of(node: Node) -> str:
    """The name of torch's operation without its overload; one that works in place ends in an underscore."""
    parts = str(node.target).split(".")
    return "getitem" if node.target is operator.getitem else parts[min(1, len(parts) - 1)]


def _needed(operations: list[Operation], action: Value) -> tuple[Operation, ...]:
    """The operations that the action depends on, in their order; the mode needs no standard deviation, for example."""
    values, kept = {action}, list[Operation]()
    for operation in reversed(operations):
        if operation.output in values:
            values.update(operand for operand in operation.inputs if isinstance(operand, Value))
            kept.append(operation)
    return tuple(reversed(kept))


class _Translator(Interpreter):
    """A walk through a graph, node by node, that collects operations."""

    def __init__(self, graph: GraphModule, batch: str) -> None:
        super().__init__(graph)
        self.extra_traceback = False  # torch would put the node in front of an error's message
        self.operations: list[Operation] = []
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
        return TRANSLATIONS[name](Call(self.operations, n.meta["val"], name, self.batch), *args, **kwargs)
