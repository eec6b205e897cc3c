"""C99 from a list of operations.

Results that are computed number by number are expressions of an index `i`, and are written into an array only where
something needs them whole or twice. Arrays share one static scratch memory: each has its place there as long as
something still reads it.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from lemniscate.exporting.operations import ELEMENTWISE, VIEWS, Operand, Operation, Program, Value, weight_of

LARGEST = "3.402823466e+38F"
"""float32's, in the place of infinity, which has no name in C99 without math.h"""

INFIX = {"Add": "+", "Sub": "-", "Mul": "*", "Div": "/", "And": "&&", "Or": "||"}
INFIX |= {"Greater": ">", "GreaterOrEqual": ">=", "Less": "<", "LessOrEqual": "<=", "Equal": "=="}


@dataclass(frozen=True)
class Numbers:
    """A result as C: `at(index)` is the expression of one number of it, which reads `arrays`.

    `whole` is a pointer to all of it, where these stand in a row in memory.
    """

    at: Callable[[str], str]
    arrays: frozenset[str]
    whole: str | None = None


@dataclass(frozen=True)
class Statement:
    """A statement, the arrays that it reads, and the one that it writes."""

    text: str
    reads: frozenset[str]
    writes: str


@dataclass
class Body:
    """The parts of `policy_act`: constant arrays, statements, sizes of arrays, names of the functions that it calls."""

    constants: list[str]
    statements: list[Statement]
    sizes: dict[str, int]
    functions: set[str]

    def places(self) -> tuple[dict[str, int], int]:
        """The place of each array in the scratch memory, and its size.

        First fit, the largest first, over the statements from the first that writes an array to the last that reads it.
        """
        lives = {name: (self._first(name), self._last(name)) for name in self.sizes}
        places: dict[str, int] = {}
        for name, (born, dead) in sorted(lives.items(), key=lambda life: (-self.sizes[life[0]], life[1])):
            others = [other for other in places if lives[other][0] <= dead and born <= lives[other][1]]
            taken = sorted((places[other], places[other] + self.sizes[other]) for other in others)
            place = 0
            for begin, end in taken:
                if place + self.sizes[name] <= begin:
                    break
                place = max(place, end)
            places[name] = place
        return places, max((places[name] + size for name, size in self.sizes.items()), default=0)

    def _first(self, name: str) -> int:
        return min(i for i, statement in enumerate(self.statements) if statement.writes == name)

    def _last(self, name: str) -> int:
        return max(i for i, statement in enumerate(self.statements) if name in {statement.writes, *statement.reads})


def body_of(program: Program) -> Body:
    """The statements that a program is in C."""
    writer = _Writer(program)
    for operation in program.operations:
        writer.add(operation)
    writer.write(program.action, "action")
    return writer.body


class _Writer:
    def __init__(self, program: Program) -> None:
        self.body = Body([], [], {}, set())
        self.results = {program.obs: Numbers(lambda index: f"obs[{index}]", frozenset(), "obs")}
        self.uses = Counter(x for operation in program.operations for x in operation.inputs if isinstance(x, Value))

    def add(self, operation: Operation) -> None:
        """Translate one operation."""
        output = operation.output
        if operation.name in VIEWS:
            self.results[output] = self._view(operation)
        elif operation.name in ELEMENTWISE:
            self.results[output] = self._elementwise(operation)
            if self.uses[output] > 1:
                self.results[output] = self._array(output)
        else:
            {"Linear": self._linear, "Concat": self._concat}.get(operation.name, self._reduce)(operation)

    def write(self, value: Value, array: str) -> None:
        """A loop that writes a result into an array."""
        numbers, number = self.results[value], "0" if value.size == 1 else "i"
        expression = numbers.at(number)
        text = f"{array}[{number}] = {_bare(_float(expression, value))};"
        self._say(_loop(text, value.size), numbers.arrays, array)

    def _say(self, text: str, reads: Iterable[str], writes: str) -> None:
        self.body.statements.append(Statement(text, frozenset(reads), writes))

    def _new(self, value: Value) -> Numbers:
        """A new array for a result."""
        name = value.name
        self.body.sizes[name] = value.size
        test = " != 0.0F" if value.kind == "bool" else ""
        return Numbers(
            lambda index: f"({name}[{index}]{test})" if test else f"{name}[{index}]", frozenset({name}), name
        )

    def _array(self, value: Value) -> Numbers:
        """The result in an array: where it is already, or a new one."""
        if self.results[value].whole:
            return self.results[value]
        new = self._new(value)
        self.write(value, value.name)
        self.results[value] = new
        return new

    def _numbers(self, operand: Operand) -> Numbers:
        if isinstance(operand, Value):
            return self.results[operand]
        if operand.size == 1:
            return Numbers(lambda _: _literal(operand.reshape(-1)[0]), frozenset())
        name = self._constant(operand)
        return Numbers(lambda index: f"{name}[{index}]", frozenset(), name)

    def _constant(self, numbers: np.ndarray, kind: str = "constant") -> str:
        name = f"{kind}_{len(self.body.constants)}"
        self.body.constants.append(f"static const float {name}[{numbers.size}] = {braces(numbers)};")
        return name

    def _elementwise(self, operation: Operation) -> Numbers:
        output = operation.output
        for operand in operation.inputs:
            if isinstance(operand, Value) and operand.size < output.size:
                self._array(operand)  # once for all numbers that need it
        inputs = [self._broadcast(operand, output.shape) for operand in operation.inputs]
        kinds = [operand.kind if isinstance(operand, Value) else "float" for operand in operation.inputs]
        self.body.functions |= _functions(operation.name)

        def at(index: str) -> str:
            return _expression(operation, [x.at(index) for x in inputs], kinds)

        return Numbers(at, frozenset().union(*(x.arrays for x in inputs)))

    def _broadcast(self, operand: Operand, shape: tuple[int, ...]) -> Numbers:
        strides = _strides(operand.shape)
        strides = [0] * (len(shape) - len(strides)) + [
            0 if size == 1 else stride for size, stride in zip(operand.shape, strides, strict=True)
        ]
        return _strided(self._numbers(operand), shape, strides)

    def _view(self, operation: Operation) -> Numbers:
        (x,), settings, shape = operation.inputs, operation.settings, operation.output.shape
        numbers = self._numbers(x)
        if operation.name == "Reshape":
            return numbers
        if operation.name == "Expand":
            return self._broadcast(x, shape)
        strides = _strides(x.shape)
        if operation.name == "Transpose":
            return _strided(numbers, shape, [strides[axis] for axis in settings["axes"]])
        return _strided(numbers, shape, strides, settings["start"] * strides[settings["axis"]])

    def _linear(self, operation: Operation) -> None:
        x, *parameters = operation.inputs
        assert isinstance(x, Value)
        self.body.functions.add("linear")
        source, target = self._array(x), self._new(operation.output)
        weight, bias = self._constant(weight_of(operation), "weight"), "0"
        if len(parameters) == 2:
            assert isinstance(parameters[1], np.ndarray)
            bias = self._constant(parameters[1], "bias")
        outputs, inputs = weight_of(operation).shape
        for row in range(x.size // inputs):
            sizes = f"{inputs}, {outputs}"
            arrays = f"{_plus(source.whole, row * inputs)}, {sizes}, {_plus(target.whole, row * outputs)}"
            self._say(f"policy_linear({weight}, {bias}, {arrays});", source.arrays, operation.output.name)
        self.results[operation.output] = target

    def _concat(self, operation: Operation) -> None:
        axis, output = operation.settings["axis"], operation.output
        target, strides, start = self._new(output), _strides(output.shape), 0
        for part in operation.inputs:
            numbers, size = self._numbers(part), int(np.prod(part.shape))
            place = _place("i", part.shape, strides, start * strides[axis])
            value = part if isinstance(part, Value) else Value("", part.shape)
            text = f"{output.name}[{place}] = {_bare(_float(numbers.at('i'), value))};"
            self._say(_loop(text, size, always=True), numbers.arrays, output.name)
            start += part.shape[axis]
        self.results[output] = target

    def _reduce(self, operation: Operation) -> None:
        (x,) = operation.inputs
        assert isinstance(x, Value)
        self.body.functions |= _functions(operation.name)
        source, target, size = self._array(x), self._new(operation.output), x.shape[-1]
        call = f"policy_{operation.name.lower()}({source.whole} + i * {size}, {size})"
        text = _loop(f"{target.whole}[i] = {call};", operation.output.size, always=True)
        self._say(text, source.arrays, operation.output.name)
        self.results[operation.output] = target


def _functions(name: str) -> set[str]:
    known = {"RoundBfloat16": "bfloat16", **{n: n.lower() for n in ("Abs", "Exp", "Log", "Sqrt", "Sin", "Cos", "Tanh")}}
    known |= {name: name.lower() for name in ("Sigmoid", "Erf", "Floor", "Max", "Min", "ArgMax")}
    known |= {name: name.lower() for name in ("ReduceSum", "ReduceMean", "ReduceMax", "ReduceMin")}
    return {known[name]} if name in known else set()


def _expression(operation: Operation, inputs: list[str], kinds: list[str]) -> str:
    """One number of an elementwise operation."""
    name = operation.name
    if name in INFIX:
        return f"({inputs[0]} {INFIX[name]} {inputs[1]})"
    if name == "Neg":
        return f"(-{inputs[0]})"
    if name == "Not":
        return f"(!{inputs[0]})"
    if name == "Where":
        return f"({inputs[0]} ? {inputs[1]} : {inputs[2]})"
    if name == "Cast":
        return _cast(inputs[0], kinds[0], operation.output.kind)
    (function,) = _functions(name)
    return f"policy_{function}({', '.join(map(_bare, inputs))})"


def _bare(expression: str) -> str:
    """The expression without brackets around all of it."""
    depth = 0
    for place, character in enumerate(expression):
        depth += (character == "(") - (character == ")")
        if not depth and place < len(expression) - 1:
            return expression
    return expression[1:-1] if expression.startswith("(") else expression


def _cast(number: str, before: str, after: str) -> str:
    if after == "bool":
        return f"({number} != 0.0F)"
    if before == "bool":
        return f"({number} ? 1.0F : 0.0F)"
    return f"(float)(int32_t)({number})" if after == "int" else number


def _float(expression: str, value: Value) -> str:
    return f"({expression} ? 1.0F : 0.0F)" if value.kind == "bool" else expression


def _loop(text: str, size: int, *, always: bool = False) -> str:
    if size == 1 and not always:
        return text
    return f"for (i = 0; i < {size}; ++i) {{\n        {text}\n    }}"


def _plus(pointer: str | None, offset: int) -> str:
    return f"{pointer} + {offset}" if offset else str(pointer)


def _strides(shape: tuple[int, ...]) -> list[int]:
    """The strides of an array in C's order."""
    return [int(np.prod(shape[axis + 1 :])) for axis in range(len(shape))]


def _strided(numbers: Numbers, shape: tuple[int, ...], strides: list[int], offset: int = 0) -> Numbers:
    """The numbers at other places: those that `strides` and `offset` lead to."""
    in_a_row = _in_a_row(shape, strides)
    whole = _plus(numbers.whole, offset) if numbers.whole and in_a_row else None
    return Numbers(lambda index: numbers.at(_place(index, shape, strides, offset)), numbers.arrays, whole)


def _in_a_row(shape: tuple[int, ...], strides: list[int]) -> bool:
    expected = _strides(shape)
    return all(size == 1 or mine == its for size, mine, its in zip(shape, strides, expected, strict=True))


def _place(index: str, shape: tuple[int, ...], strides: list[int], offset: int = 0) -> str:
    """The expression of the place at which number `index` of an array of this shape is."""
    if _in_a_row(shape, strides):
        return f"{index} + {offset}" if offset else index
    terms = []
    for axis, (size, stride, inner) in enumerate(zip(shape, strides, _strides(shape), strict=True)):
        if size > 1 and stride:
            coordinate = index if inner == 1 else f"({index}) / {inner}"
            coordinate = coordinate if not any(n > 1 for n in shape[:axis]) else f"({coordinate}) % {size}"
            terms.append(coordinate if stride == 1 else f"({coordinate}) * {stride}")
    terms += [str(offset)] if offset or not terms else []
    return " + ".join(terms)


def braces(numbers: np.ndarray, indent: str = "    ") -> str:
    """An array's initializer."""
    literals = [_literal(number).strip("()") for number in np.ravel(numbers)]
    rows = [", ".join(literals[i : i + 8]) for i in range(0, len(literals), 8)]
    return "{\n" + "".join(f"{indent}{row},\n" for row in rows) + "}"


def _literal(number: np.generic | float) -> str:
    """A number in C, as short as float32 allows."""
    value = np.float32(number)
    if not np.isfinite(value):
        return LARGEST if value > 0 else f"(-{LARGEST})"
    text = f"{np.format_float_positional(value, trim='0')}" if 1e-4 <= abs(value) < 1e6 or value == 0 else f"{value!s}"
    text = text if "." in text or "e" in text else f"{text}.0"
    return f"{text}F" if not text.startswith("-") else f"({text}F)"
