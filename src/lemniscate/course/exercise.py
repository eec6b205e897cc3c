"""The two kinds of exercise and how each is judged: a function against a reference, an object by its behaviour.

Both have two halves: `observe` runs the reader's code and puts down what was seen, plain tensors, numbers and text;
`judge` compares that with what is right, and runs nothing of the reader's. So the two can be done in two processes.
"""

import copy
import inspect
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lemniscate.course.solution import LIMIT, Function, MisfitError, Solution, TooLong, bound, limited, numbers
from lemniscate.run.run import globals_undisturbed
from lemniscate.run.seeding import seed_globals, torch_defaults

# --- likely causes that every exercise shares: what the reference would return with other arguments or results ---

Values = Mapping[str, Any]
"""arguments and options by name"""
Change = Callable[[Any], Any]
"""of one value"""

CONSTANTS = (0.0, 0.005, 0.01, 0.1, 0.2, 0.25, 0.5, 0.9, 0.95, 0.98, 0.99, 1.0)
"""values that are often written in place of an option"""


def normalised(x: Tensor, correction: int = 1) -> Tensor:
    """With mean 0 and standard deviation 1; NaN of one row."""
    apart = x - x.mean()
    return apart / ((apart.square().sum() / (x.numel() - correction)).sqrt() + 1e-8)  # `std` warns of one row


REAL: Mapping[str, Change] = {
    "{} is normalised, which is not asked for": normalised,
    "{} is normalised by all rows, which is not asked for": lambda x: normalised(x, 0),
    "{} is centred: its mean is subtracted, which is not asked for": lambda x: x - x.mean(),
    "the sign of {} is turned": torch.neg,
    "only the absolute value of {} counts": torch.abs,
    "only positive {} count": lambda x: x.clamp(min=0),
    "{} is exponentiated": torch.exp,
    "the softmax of {} is taken": lambda x: x.softmax(-1),
    "{} is rounded to whole numbers": torch.trunc,
    "{} is left out": torch.zeros_like,
}
"""of numbers"""
FLAGS: Mapping[str, Change] = {
    "{} is turned round: 1 where it should be 0": torch.logical_not,
    "{} is not looked at": torch.zeros_like,
    "{} is read one row too late": lambda x: torch.cat([x[1:], x[-1:]]),
    "{} is read one row too early": lambda x: torch.cat([torch.zeros_like(x[:1]), x[:-1]]),
}
WHOLE: Mapping[str, Change] = {
    "{} counts from one": lambda x: x - 1,
    "{} is one too large": lambda x: x + 1,
}
RESULTS: Mapping[str, Change] = {
    "the sign of {} is turned": torch.neg,
    "{} is normalised, which is not asked for": normalised,
    "{} is normalised by all rows, which is not asked for": lambda x: normalised(x, 0),
    "the rows of {} are in reverse order": lambda x: x.flip(0),
    "the first row of {} is left out": lambda x: torch.cat([torch.zeros_like(x[:1]), x[1:]]),
    "the last row of {} is left out": lambda x: torch.cat([x[:-1], torch.zeros_like(x[-1:])]),
    "{} is rounded to whole numbers": torch.trunc,
    "{} is rounded to two digits": lambda x: (x * 100).round() / 100,
    "{} is rounded to half precision": lambda x: x.half().to(x.dtype),
    "the root of {} is taken": lambda x: x.sqrt(),
}


def argument_changes(values: Values) -> Iterator[tuple[str, Callable[[Values], Values]]]:
    """Every change of arguments and options such as these, by what it is called: it gives those that are others."""
    for one, other in combinations(values, 2):
        if _alike(values[one], values[other]):
            yield f"{one} and {other} are exchanged", lambda v, a=one, b=other: {a: v[b], b: v[a]}
    for name, value in values.items():
        for words, change in _changes_of(value):
            yield words.format(name), lambda v, name=name, change=change: {name: change(v[name])}


def _changes_of(value: Any) -> Iterator[tuple[str, Change]]:
    if isinstance(value, Tensor):
        yield from (FLAGS if value.dtype == torch.bool else REAL if value.dtype.is_floating_point else WHOLE).items()
    elif isinstance(value, bool):
        yield "{} is turned round", lambda x: not x
        for constant in (True, False):
            yield f"{{}} is not looked at: it is taken for {constant}", lambda _, constant=constant: constant
    elif isinstance(value, float):
        yield "{} is squared, or applied twice", lambda x: x**2
        yield "{0} is exchanged with 1 − {0}", lambda x: 1 - x
        for constant in CONSTANTS:
            yield f"{{}} is not looked at: it is {constant:g}, a constant", lambda _, constant=constant: constant


def result_changes(outputs: tuple[str, ...]) -> Iterator[tuple[str, Callable[[list[Tensor], int], list[Tensor]]]]:
    """Every change of the results, by what it is called; it is told the number of rows that a mean is taken over."""
    if len(outputs) > 1:
        yield "the results are returned in another order", lambda found, _: found[::-1]
    for i, what in enumerate(outputs):
        for words, change in RESULTS.items():
            yield words.format(what), lambda found, _, i=i, f=change: [*found[:i], f(found[i]), *found[i + 1 :]]
    factors: Mapping[str, Callable[[int], float]] = {
        "the sum in place of the mean": lambda rows: rows,
        "the mean is over one row less than there are": lambda rows: rows / max(rows - 1, 1),
        "a factor of two": lambda _: 2.0,
        "a factor of a half": lambda _: 0.5,
    }
    for words, factor in factors.items():
        yield words, lambda found, rows, f=factor: [each * f(rows) for each in found]


def _alike(one: Any, other: Any) -> bool:
    if isinstance(one, Tensor) and isinstance(other, Tensor):
        return one.shape == other.shape and one.dtype == other.dtype
    return isinstance(one, float) and isinstance(other, float)


# --- exercises ---

TEMPLATES = Path(__file__).parent / "templates"

LIBRARIES = (str(Path(__file__).parents[1]), *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")))
"""folders of code that is not the reader's"""
RTOL, ATOL = 1e-4, 1e-5
"""float32 numbers of another order of summation are within it; the well-known mistakes are not"""


@dataclass(frozen=True)
class Finding:
    """The result of a check; true if the solution is right."""

    name: str
    right: bool
    sentence: str

    def __bool__(self) -> bool:
        return self.right

    def __str__(self) -> str:
        return f"{'✓' if self.right else '✗'} {self.name}: {self.sentence}"

    def _ipython_display_(self) -> None:
        """Show nothing: as the last value of a cell, the finding has been printed already."""


SCRATCH: tuple[str, ...] = ("newvalue", "ratio", "log_ratio", "mb_advantages", "log_prob")
"""arguments that a training loop computes for this call alone, so that they may be changed in place"""


Seen = dict[str, Any]
"""the observations of a solution by name, in the order in which they were made"""


@dataclass(frozen=True)
class Case:
    """Arguments of a function, and what is special about them."""

    about: str
    args: tuple[Any, ...]
    """tensors and numbers; a list is of the parameters of a network, which are to be changed in place"""
    options: Mapping[str, Any] = field(default_factory=dict)
    """for a function: keyword arguments; for a method: attributes of its `self`, and of `self.config`"""
    attributes: Mapping[str, Any] | None = None
    """more attributes of a method's `self`; None where the exercise is no method of a course"""


KINDS: Mapping[str, Change] = {
    "": lambda value: value,
    "it takes arrays of NumPy alone": lambda value: value.numpy() if isinstance(value, Tensor) else value,
}
"""what a solution may want its arguments to be, by what is then said of it"""
PARAMETERS: Sequence[Change] = (
    lambda value: [*value] if isinstance(value, list) else value,  # what replaces an item moves no network
    lambda value: iter(value) if isinstance(value, list) else value,
    lambda value: nn.ParameterList(value) if isinstance(value, list) else value,
)
"""what a solution that moves parameters may want: a list, an iterator, or a module"""

Results = dict[str, Any]
"""what a function returned in one case: see `Exercise._results`"""
Pairs = Sequence[tuple[Case, Results]]
"""cases, each with what a solution returned in it"""


@dataclass(frozen=True)
class Exercise:
    """A function to write: its reference, the cases it is compared on, and its well-known mistakes."""

    right: Function
    outputs: tuple[str, ...]
    """names of what it returns"""
    cases: Sequence[Case]
    mistakes: Mapping[str, Function]
    """by description: a function that makes a well-known mistake"""
    accepted: Mapping[str, Function] = field(default_factory=dict)
    """by note: a function that differs from the reference, but is what a course asks for"""
    gradient_in: int | None = None
    """the argument in which the gradient of the outputs counts too; in a method with networks it is their weights"""
    value_is_free: bool = False
    """only the gradient of what it returns counts"""
    detached: bool = False
    """what it returns has no gradient, though it is computed by networks"""

    def observe(self, solution: Function) -> Seen:
        """Call a solution in every case: what it returned, or the sentence on what it raised."""
        seen: Seen = {"cases": []}
        try:
            with globals_undisturbed(), torch_defaults(), limited(LIMIT):
                called = Solution(solution, self.cases[0].attributes is not None)
                for case in self.cases:
                    seen["cases"].append(self._in_case(called, case))
        except TooLong as error:
            seen["cases"].append({"raised": raised(error, LIMIT)})
        return seen

    def judge(self, name: str, seen: Seen) -> Finding:
        """Compare what was seen with the reference, in the cases whose arguments the solution takes."""
        every = [*zip(self.cases, seen["cases"], strict=False)]
        if len(every) < len(self.cases) and not any("raised" in got for _, got in every):
            return Finding(name, False, f"it ended in case {len(every) + 1} of {len(self.cases)}.")
        pairs = [pair for pair in every if not pair[1].get("misfit")]
        for number, (case, got) in enumerate(pairs or every, start=1):
            if complaint := self._complaint(case, got, pairs):
                for words, other in self.accepted.items():
                    if _agree(every, partial(self.answer, other)):
                        return Finding(name, True, f"right. Note: {words}.")
                return Finding(name, False, f"case {number} of {len(self.cases)}, {case.about}: {complaint}")
        right, note = "right", next((f" Note: {got['note']}." for _, got in pairs if got.get("note")), "")
        if len(pairs) < len(self.cases):
            others = ", ".join(case.about for case, got in every if got.get("misfit"))
            right = (
                f"right in {len(pairs)} of {len(self.cases)} cases; it takes too few arguments for the others: {others}"
            )
        elif len(pairs) > 1:
            right = f"right in all {len(pairs)} cases"
        return Finding(name, True, f"{right}.{note}")

    def answer(self, function: Function, case: Case, change: Callable[[Values], Values] = dict) -> Results:
        """The results of the reference, or of a known mistake, in a case; of other arguments after a change."""

        def call(given: Values, options: Values, attributes: Values) -> Any:
            if "self" not in inspect.signature(function).parameters:
                return function(*given.values(), **options)
            if "config" in attributes:
                attributes["config"].update(options)
            return function(SimpleNamespace(**options, **attributes), *given.values())

        return self._results(call, case, change)

    @property
    def arguments(self) -> list[str]:
        """The names of its arguments, those that are options among them."""
        return [name for name in inspect.signature(self.right).parameters if name != "self"]

    def _in_case(self, called: Solution, case: Case) -> Results:
        """The results of a solution in a case, with the first kind of arguments that it takes without an exception."""
        first: Results = {}
        moves = isinstance(case.args[0], list)
        kinds = [("", convert) for convert in PARAMETERS] if moves else [*KINDS.items()]
        for note, convert in kinds if self.gradient_in is None else kinds[:1]:
            try:
                results = self._results(called.call, case, partial(self._converted, convert))
                return results | {"note": note or results.get("note", "")}
            except (Exception, SystemExit) as error:  # what the solution raises is a finding too
                misfit = isinstance(error, MisfitError)
                first = first or {"raised": f"{error}." if misfit else raised(error), "misfit": misfit}
                if isinstance(error, RuntimeError):  # of torch itself, such as 1 - a tensor of booleans
                    break
        return first

    def _converted(self, convert: Change, values: Values) -> Values:
        return {name: convert(value) for name, value in values.items() if name in self.arguments}

    def _results(self, call: Function, case: Case, change: Callable[[Values], Values]) -> Results:
        """The results of a function in a case: `outputs`, and, where it counts, the `gradient` of their sum.

        Also whether they are `attached` to a graph, and the name of an argument that was `changed`; where it returns
        something else, `kinds` alone.
        """
        values: dict[str, Any] = dict(zip(self.arguments, copy.deepcopy(case.args), strict=False))
        values |= {name: [*map(nn.Parameter, value)] for name, value in values.items() if isinstance(value, list)}
        networks, leaves = [value for value in values.values() if isinstance(value, list)], list[Tensor]()
        attributes = copy.deepcopy(case.attributes)
        if self.gradient_in is not None:
            leaves = [*_weights(case.attributes), *_weights(attributes)]  # a method calls those of the case, or its own
            if not leaves:
                name = self.arguments[self.gradient_in]
                leaves = [values[name].requires_grad_()]
                values[name] = leaves[0] * 1  # as from a network: what is no leaf may be changed in place
        values |= copy.deepcopy(dict(case.options))
        values |= change(values)
        before = {name: value.detach().clone() for name, value in values.items() if isinstance(value, Tensor)}
        options = {name: values[name] for name in case.options}
        given = {name: value for name, value in values.items() if name not in options}
        returned = call(given, options, attributes)
        if networks:
            return {"outputs": [parameter.detach() for network in networks for parameter in network], "gradient": []}
        several = isinstance(returned, tuple) or (isinstance(returned, list) and len(self.outputs) > 1)
        outputs = list(returned) if several else [returned]
        tensors = [tensor for output in outputs if (tensor := numbers(output)) is not None]
        if not len(tensors) == len(outputs) == len(self.outputs):
            return {"kinds": ", ".join(type(output).__name__ for output in outputs)}
        seen: Results = {"outputs": [tensor.detach().clone() for tensor in tensors]}
        if any(isinstance(output, np.ndarray) for output in outputs):
            seen["note"] = "it returns arrays of NumPy, where training with it needs tensors"
        if not leaves:
            seen["gradient"] = []
        elif all(tensor.requires_grad for tensor in tensors):
            total = torch.stack([tensor.sum() for tensor in tensors]).sum()
            slopes = torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
            count = len(leaves) // 2 or 1  # of a network and its copy the sum
            seen["gradient"] = [sum(slopes[i::count]) for i in range(count)]
        seen["attached"] = any(tensor.requires_grad for tensor in tensors)
        if changed := [name for name, value in before.items() if not close(value, values[name])]:
            seen["changed"] = changed[0]
        return seen

    def _complaint(self, case: Case, got: Results, pairs: Pairs) -> str | None:
        """A sentence on the first difference, and one on its likely cause; None if there is none."""
        if "raised" in got:
            return got["raised"]
        if "outputs" not in got:
            wanted = " and ".join(self.outputs) + (", a tensor" if len(self.outputs) == 1 else ", tensors")
            return f"it should return {'both ' * (len(self.outputs) == 2)}{wanted}; it returned {got['kinds']}."
        if difference := self._difference(got, self.answer(self.right, case)):
            return difference + self._cause(case, pairs)
        if "changed" in got and got["changed"] not in SCRATCH:
            return f"it changes {got['changed']}, which it was given, in place; the next use of it sees other numbers."
        return None

    def _difference(self, got: Results, right: Results) -> str | None:
        """A sentence on the first difference between what was seen and what is right."""
        for what, output, wanted in zip(self.outputs, got["outputs"], right["outputs"], strict=True):
            if output.is_complex():
                return f"{what} is of complex numbers; its real part is asked for."
            if output.shape != wanted.shape:
                return f"{what} has shape {list(output.shape)}; it should be {list(wanted.shape)}."
            if "gradient" not in got:
                return f"{what} has no gradient; was something detached, or computed under no_grad?"
            if self.detached and got["attached"]:
                return f"{what} has a gradient, which would flow into the critic; .detach() is missing."
            if not close(output, wanted) and not self.value_is_free:
                return _apart(what, output, wanted)
        if not all(map(close, got["gradient"], right["gradient"])):
            return "its gradient is wrong." if self.value_is_free else "the value is right, but its gradient is not."
        return None

    def _cause(self, case: Case, pairs: Pairs) -> str:
        """The well-known mistakes, or else changes of arguments or results, that answer the same in every case.

        Where there are none, those that do in the first case that differs: a solution may have a second mistake.
        """
        for tried in (pairs, [pair for pair in pairs if pair[0] is case]):
            known = ((words, partial(self.answer, wrong)) for words, wrong in self.mistakes.items())
            for answers in (known, self._changed()):
                if likely := [words for words, answer in answers if _agree(tried, answer)]:
                    return f" Likely: {', or '.join(likely[:3])}."
        return ""

    def _changed(self) -> Iterator[tuple[str, Callable[[Case], Results]]]:
        """The reference with changed arguments or changed results, by the words for the change."""
        last = self.cases[-1]
        for words, change in argument_changes({**dict(zip(self.arguments, last.args, strict=False)), **last.options}):
            yield words, partial(self.answer, self.right, change=change)
        for words, change in result_changes(self.outputs):
            yield words, partial(self._with_results, change)

    def _with_results(self, change: Callable[[list[Tensor], int], list[Tensor]], case: Case) -> Results:
        """The reference's results after a change of them; their gradient, if it counts, after the same."""
        right, rows = self.answer(self.right, case), len(case.args[0])
        factor = change([torch.ones(())], rows)[0] if right["gradient"] and len(self.outputs) == 1 else 1
        return {"outputs": change(right["outputs"], rows), "gradient": [each * factor for each in right["gradient"]]}


class Note(str):
    """A remark on something that is right, but may surprise."""


@dataclass(frozen=True)
class Inspection:
    """A class, or a function with effects, to write: judged by what it does."""

    look: Callable[[Function, Seen], None]
    """tries the solution, and puts down what is seen, one thing after the other"""
    points: Callable[[Seen], Iterator[str]]
    """yields a sentence on each thing that is wrong, and a `Note` on what may surprise"""
    limit: float = LIMIT
    """seconds that the solution may take"""

    def observe(self, solution: Function) -> Seen:
        """Try a solution until it raises; the global random generators are left as they were."""
        seen: Seen = {}
        try:
            with globals_undisturbed(), torch_defaults(), limited(self.limit):
                seed_globals(0)
                self.look(bound(solution), seen)
        except (Exception, SystemExit, TooLong) as error:  # what the solution raises is a finding too
            seen["raised"] = raised(error, self.limit)
        return seen

    def judge(self, name: str, seen: Seen) -> Finding:
        """Look for the first point that is wrong; what came before an exception is said before it."""
        notes: list[str] = []
        try:
            for sentence in self.points(seen):
                if not isinstance(sentence, Note):
                    return Finding(name, False, sentence)
                notes.append(f" Note: {sentence}")
        # Where the solution raised before, a point may miss what was not seen; what a solution returns may be anything.
        except Exception as error:
            return Finding(name, False, seen.get("raised", f"what it does cannot be judged: {error}."))
        if "raised" in seen:
            return Finding(name, False, seen["raised"])
        return Finding(name, True, f"right.{''.join(notes)}")


def raised(error: BaseException, limit: float = LIMIT) -> str:
    """The exception of a solution, and the reader's line that raised it; in a cell of a notebook the line alone."""
    said = f"it raised {type(error).__name__}: {error}"
    if isinstance(error, TooLong):
        said = f"it did not end within {limit:g} seconds"
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(LIBRARIES)]
    if not own:
        return said
    file, line = Path(own[-1].filename), own[-1].lineno
    return f"{said}, in {own[-1].name} ({f'{file.name}:{line}' if file.is_file() else f'line {line}'})"


def close(mine: Any, right: Any, rtol: float = RTOL, atol: float = ATOL) -> bool:
    """Whether two tensors, lists or numbers have one shape and are equal up to rounding; NaN is equal to nothing."""
    mine, right = (value.tolist() if isinstance(value, Tensor) else value for value in (mine, right))
    if isinstance(mine, list) and isinstance(right, list):
        return len(mine) == len(right) and all(close(a, b, rtol, atol) for a, b in zip(mine, right, strict=True))
    if isinstance(mine, int | float) and isinstance(right, int | float):
        return abs(mine - right) <= atol + rtol * abs(right)
    return False


def _weights(attributes: Mapping[str, Any] | None) -> list[Tensor]:
    """The parameters of the networks among the attributes of an object."""
    networks = [each for each in (attributes or {}).values() if isinstance(each, nn.Module)]
    return [weight for network in networks for weight in network.parameters()]


def _apart(what: str, mine: Tensor, right: Tensor) -> str:
    """A sentence on the first element that differs."""
    elements = zip(np.ndindex(*right.shape), mine.flatten().tolist(), right.flatten().tolist(), strict=True)
    for index, one, other in elements:
        if not abs(one - other) <= ATOL + RTOL * abs(other):
            return f"{what}{list(index) or ''} is {one:.4g}; it should be {other:.4g}."
    raise AssertionError("nothing differs")


def _agree(pairs: Pairs, answer: Callable[[Case], Results]) -> bool:
    """Whether what was seen in each of some cases is what another function answers, with NaN in the same places."""
    with suppress(Exception):  # one that fails in a later case is none of the known mistakes
        both = (zip(_tensors(got), _tensors(answer(case)), strict=True) for case, got in pairs)
        return all(close(mine, its) for tensors in both for mine, its in tensors)
    return False


def _tensors(got: Results) -> list[Tensor]:
    return [tensor.nan_to_num(1e9) for tensor in got["outputs"] + got["gradient"]]
