"""The translation of each of torch's operations: a function of the call and of its arguments.

Results are `Value`s; what a call is given besides is constant: numbers, or tensors.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate.exporting.calls import BATCH, Call, UntranslatableError, array, constant
from lemniscate.exporting.operations import Kind, Value

Translation = Callable[..., Any]


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


def _not_equal(call: Call, a: Any, b: Any) -> Value:
    return call.add("Not", _comparison("Equal")(call, a, b), kind="bool")


def _clamp(call: Call, x: Value, low: Any = None, high: Any = None, *, min: Any = None, max: Any = None) -> Value:
    low, high = min if low is None else low, max if high is None else high
    for name, bound in (("Max", low), ("Min", high)):
        x = x if bound is None else call.add(name, x, call.as_kind(bound, call.kind), kind=call.kind)
    return x


def _relu(call: Call, x: Value) -> Value:
    return call.add("Max", x, np.float32(0))


def _leaky_relu(call: Call, x: Value, slope: float = 0.01) -> Value:
    return call.add("Where", _comparison("Greater")(call, x, 0.0), x, call.add("Mul", x, np.float32(slope)))


def _elu(call: Call, x: Value, alpha: float = 1, scale: float = 1, input_scale: float = 1) -> Value:
    below = call.add("Exp", call.add("Min", call.add("Mul", x, np.float32(input_scale)), np.float32(0)))
    below = call.add("Mul", call.add("Sub", below, np.float32(1)), np.float32(alpha * scale))
    above = x if scale == 1 else call.add("Mul", x, np.float32(scale))
    return call.add("Where", _comparison("Greater")(call, x, 0.0), above, below)


def _silu(call: Call, x: Value) -> Value:
    return call.add("Mul", x, call.add("Sigmoid", x))


def _gelu(call: Call, x: Value, *, approximate: str = "none") -> Value:
    if approximate == "none":
        share = call.add("Erf", call.add("Mul", x, np.float32(0.5**0.5)))
    else:
        cube = call.add("Mul", call.add("Mul", call.add("Mul", x, x), x), np.float32(0.044715))
        share = call.add("Tanh", call.add("Mul", call.add("Add", x, cube), np.float32((2 / np.pi) ** 0.5)))
    return call.add("Mul", call.add("Mul", x, np.float32(0.5)), call.add("Add", share, np.float32(1)))


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


def _cast(call: Call, x: Value, *_: Any, **__: Any) -> Value:
    return call.rounded(call.as_kind(x, call.kind))


def _linear(call: Call, x: Value, weight: Any, bias: Any = None) -> Value:
    if not isinstance(x, Value) or isinstance(weight, Value) or isinstance(bias, Value) or weight.ndim != 2:
        raise UntranslatableError("a product of two results has no translation")
    biases = () if bias is None else (np.broadcast_to(array(bias), (len(weight),)),)
    return call.rounded(call.add("Linear", x, np.ascontiguousarray(array(weight)), *biases))


def _mm(call: Call, x: Any, weight: Any) -> Value:
    return _linear(call, x, weight if isinstance(weight, Value) else weight.T)


def _addmm(call: Call, bias: Any, x: Any, weight: Any, *, beta: float = 1, alpha: float = 1) -> Value:
    if (beta, alpha) != (1, 1) or isinstance(weight, Value):
        raise UntranslatableError("a product of two results has no translation")
    return _linear(call, x, weight.T, bias)


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


def _softmax(call: Call, x: Value, axis: int, *_: Any) -> Value:
    _require_last(call, x, [axis])
    one = (*x.shape[:-1], 1)
    powers = call.add("Exp", call.add("Sub", x, call.add("ReduceMax", x, shape=one)))
    return call.add("Div", powers, call.add("ReduceSum", powers, shape=one))


def _require_last(call: Call, x: Value, axes: list[int]) -> None:
    if [call.axis(axis, len(x.shape) + 1) for axis in axes] != [len(x.shape) - 1]:
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
    own = call.axis(axis, len(x.shape) + 1)
    size = x.shape[own]
    begin = min(max((start or 0) + (size if (start or 0) < 0 else 0), 0), size)
    return call.add("Slice", x, kind=x.kind, axis=own, start=begin)


def _index(call: Call, x: Value, places: list[Any]) -> Value:
    """x[:, places], for constant places along one axis."""
    ((axis, indices), *others) = [(axis, index) for axis, index in enumerate(places) if index is not None]
    if others or isinstance(indices, Value) or indices.ndim != 1 or axis == 0 or indices.dtype != torch.int64:
        raise UntranslatableError("index with more than constant places along one axis has no translation")
    size, shape = x.shape[axis - 1], (*x.shape[: axis - 1], 1, *x.shape[axis:])
    starts = [index % size for index in indices.tolist()]
    rows = [call.add("Slice", x, shape=shape, kind=x.kind, axis=axis - 1, start=start) for start in starts]
    return call.add("Concat", *rows, kind=x.kind, axis=axis - 1)


def _select(call: Call, x: Value, axis: int, index: int) -> Value:
    own = call.axis(axis, len(x.shape) + 1)
    shape = (*x.shape[:own], 1, *x.shape[own + 1 :])
    row = call.add("Slice", x, shape=shape, kind=x.kind, axis=own, start=index % x.shape[own])
    return call.add("Reshape", row, kind=x.kind)


def _split(call: Call, x: Value, _sizes: Any, axis: int = 0) -> list[Value]:
    own, start, parts = call.axis(axis, len(x.shape) + 1), 0, []
    for shape in call.shapes:
        parts.append(call.add("Slice", x, shape=shape, kind=x.kind, axis=own, start=start))
        start += shape[own]
    return parts


def _reshape(call: Call, x: Value, *_: Any) -> Value:
    return x if x.shape == call.shape else call.add("Reshape", x, kind=x.kind)


def _expand(call: Call, x: Value, *_: Any, **__: Any) -> Value:
    return x if x.shape == call.shape else call.add("Expand", x, kind=x.kind)


def _permute(call: Call, x: Value, axes: list[int]) -> Value:
    rank = len(x.shape) + 1
    if axes[0] % rank:
        raise UntranslatableError("permute mixes the observations of a batch")
    return call.add("Transpose", x, kind=x.kind, axes=tuple(axis % rank - 1 for axis in axes[1:]))


def _cat(call: Call, parts: list[Any], axis: int = 0) -> Value:
    own, shape = call.axis(axis, len(call.shape) + 1), call.shape
    wide = []
    for part in parts:
        if isinstance(part, Tensor):
            row = constant(part, len(shape))
            assert isinstance(row, np.ndarray)
            part = np.broadcast_to(row, (*shape[:own], row.shape[own], *shape[own + 1 :]))
        wide.append(call.as_kind(part, call.kind))
    return call.add("Concat", *wide, kind=call.kind, axis=own)


def _full(call: Call, _size: Any, number: float = 0.0, **_: Any) -> Tensor:
    return torch.full(call.shape, number, dtype=call.fake.dtype)


def _same(call: Call, x: Value, *_: Any, **__: Any) -> Value:
    return x


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
    "ne": _not_equal,
    "logical_and": _comparison("And", "bool"),
    "logical_or": _comparison("Or", "bool"),
    "bitwise_and": _comparison("And", "bool"),
    "bitwise_or": _comparison("Or", "bool"),
    "logical_not": _unary("Not"),
    "bitwise_not": _unary("Not"),
    "where": _where,
    "_to_copy": _cast,
    "to": _cast,
    "relu": _relu,
    "leaky_relu": _leaky_relu,
    "elu": _elu,
    "silu": _silu,
    "gelu": _gelu,
    "_softmax": _softmax,
    "clamp": _clamp,
    "hardtanh": _clamp,
    "clamp_min": _clamp,
    "pow": _power,
    "square": lambda call, x: _power(call, x, 2),
    "reciprocal": lambda call, x: _power(call, x, -1),
    "rsqrt": lambda call, x: _power(call, x, -0.5),
    "log1p": lambda call, x: call.add("Log", call.add("Add", x, np.float32(1))),
    "expm1": lambda call, x: call.add("Sub", call.add("Exp", x), np.float32(1)),
    "linear": _linear,
    "mm": _mm,
    "addmm": _addmm,
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
    "index_select": lambda call, x, axis, indices: _index(call, x, [None] * (axis % (len(x.shape) + 1)) + [indices]),
    "split": _split,
    "chunk": _split,
    "split_with_sizes": _split,
    "permute": _permute,
    **{name: _reshape for name in ("view", "_unsafe_view", "reshape", "unsqueeze", "squeeze")},
    "expand": _expand,
    "full": _full,
    "full_like": _full,
    "zeros": _full,
    "sym_size": lambda call, *_: BATCH,
    **{name: _same for name in ("alias", "clone", "detach", "contiguous")},
    "getitem": lambda call, parts, index: parts[index],
}
"""by the name of torch's operation; what is not here has no translation"""
