"""`policy.c` and `policy.h`, C99 from a list of operations; and the folder that the Crazyflie's firmware takes.

Results that are computed number by number are expressions of an index, `#`, and are written into an array only where
something needs them whole or twice. Arrays share one static scratch memory: each has its place there as long as
something still reads it.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lemniscate.envs.backend import Interface, Quantity
from lemniscate.errors import UserError
from lemniscate.exporting.deployed import choices, difference_units, safe_action, safe_sentence
from lemniscate.exporting.translation import Operand, Operation, Program, Value
from lemniscate.spec import Action, Box
from lemniscate.system.files import filled
from lemniscate.system.machine import version

TEMPLATES = Path(__file__).parent / "templates"
LARGEST = "3.402823466e+38F"
"""float32's largest number, in the place of infinity, which has no name in C99 without math.h"""

OPERATORS = {"Add": "({} + {})", "Sub": "({} - {})", "Mul": "({} * {})", "Div": "({} / {})", "Neg": "(-{})"}
OPERATORS |= {"Greater": "({} > {})", "GreaterOrEqual": "({} >= {})", "Less": "({} < {})", "LessOrEqual": "({} <= {})"}
OPERATORS |= {"Equal": "({} == {})", "And": "({} && {})", "Or": "({} || {})", "Not": "(!{})", "Where": "({} ? {} : {})"}
"""the operations that C has operators for; others are functions of templates/functions.c, with the operation's name"""


def c_files(
    program: Program,
    action: Action,
    observations: np.ndarray,
    actions: np.ndarray,
    *,
    title: str,
    origin: str,
    period: float | None = None,
    wrappers: Sequence[str] = (),
) -> dict[str, str]:
    """The texts of `policy.c` and `policy.h`.

    Args:
        program: the policy.
        action: its kind of actions.
        observations: rows of the self-test, [S, O + K].
        actions: the true rows at these, [S, A + K].
        title: what the policy is for.
        origin: where the observations are from.
        period: seconds between two actions, where known.
        wrappers: what stands between the environment and the policy in training, and is not in the program.
    """
    context = {
        "title": title,
        "origin": origin,
        "version": version(),
        "period": None if period is None else np.float32(period),
        "program": program,
        "action": action,
        "is_box": isinstance(action, Box),
        "masked": () if isinstance(action, Box) or not action.mask_size else zip(*choices(action), strict=True),
        "safe": safe_action(action),
        "safe_sentence": safe_sentence(action),
        "observations": observations,
        "actions": actions,
        "bound": "0.05F" if program.is_rounded else "1e-4F",  # ten times the effect of another order of sums
        "units": difference_units(action, actions)[: program.action.size],
        "wrappers": wrappers,
        "body": Body(program),
    }
    filters = {"braces": braces, "comment": comment, "functions": functions}
    return {name: filled(TEMPLATES / name, filters, **context) for name in ("policy.c", "policy.h")}


def comment(text: str) -> str:
    """Text that cannot end the comment in C in which it stands; anyone may have written the run that it comes from."""
    return " ".join(text.replace("\\", "/").replace("*/", "* /").replace("/*", "/ *").split())


def functions(text: str) -> str:
    """The functions in functions.c that `text` calls, and those that they call, in the order of their file.

    A block of that file begins with a line `// name`.
    """
    blocks = f"\n{(TEMPLATES / 'functions.c').read_text('utf-8')}".split("\n// ")[1:]
    found = ""
    for block in reversed(blocks):  # C defines a function before it is called, so one pass finds all of them
        name, _, block_text = block.partition("\n")
        if f"policy_{name}(" in text + found:
            found = f"{block_text.strip()}\n\n{found}"
    return found


@dataclass(frozen=True)
class Numbers:
    """A result as C: `text` is the expression of number `#` of it.

    `whole` is a pointer to all of them, where they stand in a row in memory.
    """

    text: str
    whole: str | None = None


class Body:
    """The parts of `policy_act` that depend on the policy.

    Attributes:
        constants: the definitions of constant arrays.
        statements: in their order.
        places: of the arrays in the scratch memory, by name.
        scratch: the size of that memory.
    """

    def __init__(self, program: Program) -> None:
        self.constants: list[str] = []
        self.statements: list[str] = []
        self._sizes: dict[str, int] = {}
        self._results = {program.obs: Numbers("obs[#]", "obs")}
        if program.memory:
            self._results[program.memory] = Numbers("memory[#]", "memory")
        self._uses = Counter(x for operation in program.operations for x in operation.inputs if isinstance(x, Value))
        for operation in program.operations:
            self._add(operation)
        if program.after:
            self._array(program.after)  # whole, before the memory that it comes from is replaced
        self._write(program.action, "action")
        if program.after:
            self._write(program.after, "memory")
        self.places = self._places()
        self.scratch = max((self.places[name] + size for name, size in self._sizes.items()), default=0)

    def _places(self) -> dict[str, int]:
        """First fit, the largest first; an array lives from the first statement that names it to the last."""
        words = [set(re.findall(r"\w+", statement)) for statement in self.statements]
        at = {name: [i for i, named in enumerate(words) if name in named] for name in self._sizes}
        lives = {name: (numbers[0], numbers[-1]) for name, numbers in at.items()}
        places = dict.fromkeys(self._sizes, 0)
        placed = list[str]()
        for name, (born, dead) in sorted(lives.items(), key=lambda life: (-self._sizes[life[0]], life[1])):
            others = [other for other in placed if lives[other][0] <= dead and born <= lives[other][1]]
            for begin, other in sorted((places[other], other) for other in others):
                if places[name] + self._sizes[name] <= begin:
                    break
                places[name] = max(places[name], begin + self._sizes[other])
            placed.append(name)
        return places

    def _add(self, operation: Operation) -> None:
        """Translate one operation; those that are not named here are computed number by number."""
        x, output, settings = operation.inputs[0], operation.output, operation.settings
        places = _places(x.shape)
        match operation.name:
            case "Reshape":
                self._results[output] = self._reordered(x, places.reshape(output.shape))
            case "Expand":
                self._results[output] = self._reordered(x, np.broadcast_to(places, output.shape))
            case "Transpose":
                self._results[output] = self._reordered(x, places.transpose(settings["axes"]))
            case "Slice":
                view = _part(places, settings["axis"], settings["start"], output.shape[settings["axis"]])
                self._results[output] = self._reordered(x, view)
            case "Linear":
                self._linear(operation)
            case "Concat":
                self._concat(operation)
            case "ArgMax" | "ReduceSum" | "ReduceMean" | "ReduceMax" | "ReduceMin":
                self._reduce(operation)
            case _:
                self._results[output] = self._elementwise(operation)
                if self._uses[output] > 1:
                    self._array(output)

    def _new(self, value: Value) -> Numbers:
        """A new array for a result."""
        self._sizes[value.name] = value.size
        number = f"{value.name}[#]"
        return Numbers(f"({number} != 0.0F)" if value.kind == "bool" else number, value.name)

    def _array(self, value: Value) -> str:
        """The array of a result: the one where it is already, or a new one."""
        if not self._results[value].whole:
            self._write(value, value.name)
            self._results[value] = self._new(value)
        return str(self._results[value].whole)

    def _write(self, value: Value, array: str) -> None:
        """Write a result into an array."""
        text = f"{array}[#] = {self._stored(value)};"
        self.statements.append(text.replace("#", "0") if value.size == 1 else _loop(text, value.size))

    def _stored(self, value: Value) -> str:
        """A number of a result, as it stands in an array of floats."""
        return _bare(_cast(self._results[value].text, value.kind, "float"))

    def _reordered(self, operand: Operand, view: np.ndarray) -> Numbers:
        """The numbers of an operand in another order: those at the places in `view`."""
        if isinstance(operand, Value):
            numbers = self._results[operand]
        elif operand.size == 1:
            numbers = Numbers(literal(operand.item()))
        else:
            name = self._constant(operand)
            numbers = Numbers(f"{name}[#]", name)
        whole = _place(numbers.whole, view) if numbers.whole and view.flags.c_contiguous else None
        return Numbers(numbers.text.replace("#", _place("#", view)), whole)

    def _constant(self, numbers: np.ndarray, kind: str = "constant") -> str:
        """The name of a new constant array."""
        name = f"{kind}_{len(self.constants)}"
        self.constants.append(f"static const float {name}[{numbers.size}] = {braces(numbers)};")
        return name

    def _elementwise(self, operation: Operation) -> Numbers:
        output = operation.output
        for operand in operation.inputs:
            if isinstance(operand, Value) and operand.size < output.size:
                self._array(operand)  # computed once for all numbers that need it, not in the loop
        inputs = [self._reordered(x, np.broadcast_to(_places(x.shape), output.shape)).text for x in operation.inputs]
        if operation.name == "Cast":
            (x,) = operation.inputs
            return Numbers(_cast(inputs[0], x.kind if isinstance(x, Value) else "float", output.kind))
        if operation.name in OPERATORS:
            return Numbers(OPERATORS[operation.name].format(*inputs))
        return Numbers(f"policy_{operation.name.lower()}({', '.join(map(_bare, inputs))})")

    def _linear(self, operation: Operation) -> None:
        x, _, *biases = operation.inputs
        assert isinstance(x, Value)
        source, target = self._array(x), operation.output.name
        weight = self._constant(operation.weight, "weight")
        bias = self._constant(np.asarray(biases[0]), "bias") if biases else "0"
        outputs, inputs = operation.weight.shape
        for row in range(x.size // inputs):
            ends = f"{_plus(source, row * inputs)}, {inputs}, {outputs}, {_plus(target, row * outputs)}"
            self.statements.append(f"policy_linear({weight}, {bias}, {ends});")
        self._results[operation.output] = self._new(operation.output)

    def _concat(self, operation: Operation) -> None:
        axis, output, start = operation.settings["axis"], operation.output, 0
        for part in operation.inputs:
            assert isinstance(part, Value)
            place = _place("#", _part(_places(output.shape), axis, start, part.shape[axis]))
            self.statements.append(_loop(f"{output.name}[{place}] = {self._stored(part)};", part.size))
            start += part.shape[axis]
        self._results[output] = self._new(output)

    def _reduce(self, operation: Operation) -> None:
        (x,), output = operation.inputs, operation.output
        assert isinstance(x, Value)
        call = f"policy_{operation.name.lower()}({self._array(x)} + # * {x.shape[-1]}, {x.shape[-1]})"
        self.statements.append(_loop(f"{output.name}[#] = {call};", output.size))
        self._results[output] = self._new(output)


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


def _loop(text: str, size: int) -> str:
    return f"for (i = 0; i < {size}; ++i) {{\n        {text.replace('#', 'i')}\n    }}"


def _plus(pointer: str, offset: int) -> str:
    return f"{pointer} + {offset}" if offset else pointer


def _places(shape: tuple[int, ...]) -> np.ndarray:
    """The places 0, 1, 2, … of the numbers of an array in memory; NumPy's views of it have the strides for C."""
    return np.arange(math.prod(shape)).reshape(shape)


def _part(places: np.ndarray, axis: int, start: int, size: int) -> np.ndarray:
    """A view of `size` rows along an axis; `np.take` would copy, and forget the strides."""
    return places[(slice(None),) * axis + (slice(start, start + size),)]


def _place(index: str, view: np.ndarray) -> str:
    """The expression of the place of number `index` of a view."""
    offset = int(view.flat[0]) if view.size else 0
    if view.flags.c_contiguous:
        return _plus(index, offset)
    terms = []
    for axis, (size, stride) in enumerate(zip(view.shape, view.strides, strict=True)):
        step, inner = stride // view.itemsize, math.prod(view.shape[axis + 1 :])
        if size > 1 and step:
            coordinate = index if inner == 1 else f"({index}) / {inner}"
            coordinate = coordinate if not any(n > 1 for n in view.shape[:axis]) else f"({coordinate}) % {size}"
            terms.append(coordinate if step == 1 else f"({coordinate}) * {step}")
    terms += [str(offset)] if offset or not terms else []
    return " + ".join(terms)


def braces(numbers: np.ndarray) -> str:
    """An array's initializer."""
    literals = [literal(number).strip("()") for number in np.ravel(numbers)]
    rows = [", ".join(literals[i : i + 8]) for i in range(0, len(literals), 8)]
    return "{\n" + "".join(f"    {row},\n" for row in rows) + "}"


def literal(number: np.generic | float) -> str:
    """A number in C, as short as float32 allows; one below zero in brackets."""
    value = np.float32(number)
    if not np.isfinite(value):
        return LARGEST if value > 0 else f"(-{LARGEST})"
    return f"({value!s}F)" if np.signbit(value) else f"{value!s}F"


# --- the folder with which the Crazyflie's firmware takes a policy as its controller ---------------------------------

CRAZYFLIE_FILES = ("policy_controller.c", "README.md", "Makefile", "Kbuild", "app-config")
COMMANDS = ("roll", "pitch", "yaw", "thrust")
LOOP = 1000
"""Hz, the rate of the firmware's stabilizer, which the policy's rate has to divide"""

VECTORS = {
    "position": "state->position.{0}",
    "velocity": "state->velocity.{0}",
    "angular_velocity": "sensors->gyro.{0} * RADIANS",
    "to_goal": "setpoint->position.{0} - state->position.{0}",
    "to_goal_velocity": "setpoint->velocity.{0} - state->velocity.{0}",
}
SENSED = {f"attitude_{axis}": f"state->attitudeQuaternion.{axis}" for axis in "xyzw"}
SENSED |= {f"{name}_{axis}": text.format(axis) for name, text in VECTORS.items() for axis in "xyz"}
"""the firmware's expression for each quantity, by its name"""


def crazyflie_files(
    interface: Interface, quantities: list[Quantity], action: Action, c_files: Mapping[str, str], title: str
) -> dict[str, str]:
    """The texts of the folder's files, by name, those of `c_files` among them.

    The policy sees `quantities`, in their order, in an environment with this interface.

    Raises:
        UserError: actions other than attitude and thrust; quantities that the firmware does not have; a rate that does
            not divide the firmware's.
    """
    if tuple(quantity.name for quantity in interface.action) != COMMANDS or not isinstance(action, Box):
        raise UserError("its actions are not roll, pitch, yaw and thrust")
    if not interface.period:
        raise UserError("the time between its actions is not known")
    rate = round(1 / interface.period)
    if not rate or LOOP % rate:
        raise UserError(f"its {rate} actions a second do not divide the firmware's {LOOP}")
    names = [quantity.name for quantity in quantities]
    now = {name: f"obs[{i}]" for i, name in enumerate(names)}
    references = [name for name in names if interface.reference and name.startswith("to_reference_in_")]
    done = {  # between -1 and 1, the ends of the range
        name: f"(action[{i}] - {literal((low + high) / 2)}) / {literal((high - low) / 2)}"
        for i, (name, low, high) in enumerate(zip(COMMANDS, action.low, action.high, strict=True))
    }
    ago = {name: f"{name}_{{}}_steps_ago{'_less_now' if name in now else ''}" for name in (*now, *done)}
    kept = [name for name in ago if ago[name].format(1) in now]
    past = [ago[name].format(steps) for steps in range(1, (interface.history or 0) + 1) for name in kept]
    first = next((i for i, name in enumerate(names) if name in past), 0)
    unknown = [name for name in names if name not in (*SENSED, *references, *past)]
    if past and (names[first : first + len(past)] != past or len(interface.action_before) != len(COMMANDS)):
        unknown.append(names[first])
    if unknown:
        raise UserError(f"nothing in the firmware gives {unknown[0]}")
    context = {
        "title": title,
        "version": version(),
        "rate": rate,
        "remembers": "POLICY_MEMORY" in c_files.get("policy.h", ""),
        "action": action,
        "interface": interface,
        "reference": interface.reference,
        "to_reference": names.index(references[0]) if references else None,
        "sensed": {i: SENSED[name] for i, name in enumerate(names) if name in SENSED},
        "first": first,
        "kept": [(now.get(name), done.get(name)) for name in kept],
    }
    folder, filters = TEMPLATES / "crazyflie", {"literal": literal, "comment": comment}
    return {**c_files, **{name: filled(folder / name, filters, **context) for name in CRAZYFLIE_FILES}}
