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
from functools import cached_property, partial
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lemniscate.course.solution import (
    KINDS,
    LIMIT,
    PARAMETERS,
    Function,
    Held,
    MisfitError,
    Solution,
    TooLong,
    bound,
    limited,
    numbers,
)
from lemniscate.run.run import globals_undisturbed
from lemniscate.run.seeding import seed_globals

# --- likely causes that every exercise shares: what the reference would return with other arguments or results ---

Values = Mapping[str, Any]
"""arguments and options by name"""
Change = Callable[[Any], Any]
"""of one value"""

CONSTANTS = (0.0, 0.005, 0.01, 0.1, 0.2, 0.25, 0.5, 0.9, 0.95, 0.98, 0.99, 1.0)
"""values that are often written in place of an option"""


def normalised(x: Tensor, correction: int = 1) -> Tensor:
    """With mean 0 and standard deviation 1."""
    return (x - x.mean()) / (x.std(correction=correction) + 1e-8)


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


def of_arguments(values: Values) -> Iterator[tuple[str, Callable[[Values], Values]]]:
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


def of_results(outputs: tuple[str, ...]) -> Iterator[tuple[str, Callable[[list[Tensor], int], list[Tensor]]]]:
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


class EndedError(Exception):
    """The solution raised before something could be seen."""


class Seen(dict):
    """The observations of a solution by name, in the order in which they were made."""

    def __missing__(self, name: str) -> Any:
        raise EndedError(name)


@dataclass(frozen=True)
class Case:
    """Arguments of a function, and what is special about them."""

    about: str
    args: tuple[Any, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    """for a function: keyword arguments; for a method: attributes of its `self`, and of `self.config`"""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    """more attributes of a method's `self`"""


@dataclass(frozen=True)
class Answer:
    """The outputs of a reference in one case, and the gradient of their sum in the argument where it counts, if any."""

    outputs: tuple[Tensor, ...]
    gradient: Tensor | None = None


@dataclass(frozen=True)
class Exercise:
    """A function to write: its reference, the cases it is compared on, and its well-known mistakes."""

    right: Function
    outputs: tuple[str, ...]
    """names of what it returns"""
    cases: Sequence[Case]
    edited: Callable[[Sequence[str]], Function]
    """makes another function of the reference's text"""
    wrong: Mapping[str, Sequence[str]]
    """by description: the edits of a well-known mistake"""
    noted: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """by note: the edits of what differs from the reference, but is what a course asks for"""
    gradient_in: int | None = None
    """the argument in which the gradient of the outputs counts too"""
    in_place: bool = False
    """it changes the parameters of two networks in place, and returns nothing"""
    value_is_free: bool = False
    """only the gradient of what it returns counts"""
    detached: bool = False
    """what it returns has no gradient, though it is computed by networks"""

    @cached_property
    def mistakes(self) -> dict[str, Function]:
        """By description: a function that makes the mistake."""
        return {words: self.edited(edits) for words, edits in self.wrong.items()}

    def observe(self, solution: Function) -> Seen:
        """Call a solution in every case: what it returned, or the sentence on what it raised."""
        seen = Seen(cases=[])
        try:
            with limited(LIMIT):
                called = Solution(solution, isinstance(self.cases[0].attributes, Held))
                for case in self.cases:
                    seen["cases"].append(self._in_case(called, case))
        except TooLong as error:
            seen["cases"].append({"raised": f"it did not end within {LIMIT:g} seconds{place(error)}"})
        return seen

    def judge(self, name: str, seen: Seen) -> Finding:
        """Compare what was seen with the reference, in the cases whose arguments the solution takes."""
        pairs = [pair for pair in zip(self.cases, seen["cases"], strict=False) if not pair[1].get("misfit")]
        for number, (case, got) in enumerate(pairs or zip(self.cases, seen["cases"], strict=False), start=1):
            if complaint := self._complaint(case, got, seen["cases"]):
                accepted = ((words, partial(self.answer, self.edited(edits))) for words, edits in self.noted.items())
                if notes := [
                    words
                    for words, answer in accepted
                    if _agree([*zip(self.cases, seen["cases"], strict=False)], answer)
                ]:
                    return Finding(name, True, f"right. Note: {notes[0]}.")
                return Finding(name, False, f"case {number} of {len(self.cases)}, {case.about}: {complaint}")
        right, notes = "right", sorted({f" Note: {got['note']}." for _, got in pairs if "note" in got})
        if len(pairs) < len(self.cases):
            right = f"right in {len(pairs)} of {len(self.cases)} cases; the others give it more arguments"
        elif len(pairs) > 1:
            right = f"right in all {len(pairs)} cases"
        return Finding(name, True, f"{right}.{''.join(notes)}")

    def answer(self, function: Function, case: Case, change: Callable[[Values], Values] | None = None) -> Answer:
        """The results of the reference, or of a known mistake, in a case; of other arguments after a change."""
        args, options = list(copy.deepcopy(case.args)), dict(case.options)
        networks = [[nn.Parameter(tensor) for tensor in arg] for arg in args if isinstance(arg, list)]
        args[: len(networks)] = networks
        leaf = None if self.gradient_in is None else args[self.gradient_in].requires_grad_()
        if change:
            values = dict(zip(self.arguments, args, strict=False)) | options
            values |= change(values)
            args, options = list(values.values())[: len(args)], {name: values[name] for name in options}
        if "self" in inspect.signature(function).parameters:
            held = {**options, **case.attributes}
            if "config" in held:
                held["config"] = SimpleNamespace(**{**held["config"], **options})
            function, options = partial(function, SimpleNamespace(**held)), {}
        returned = function(*args, **options)
        if self.in_place:
            return Answer(tuple(parameter.detach() for network in networks for parameter in network))
        outputs = returned if isinstance(returned, tuple) else (returned,)
        gradient = (
            None if leaf is None else torch.autograd.grad(torch.stack([each.sum() for each in outputs]).sum(), leaf)[0]
        )
        return Answer(tuple(output.detach() for output in outputs), gradient)

    @property
    def arguments(self) -> list[str]:
        """The names of its arguments, those that are options left out."""
        return [name for name in inspect.signature(self.right).parameters if name != "self"]

    def _in_case(self, called: Solution, case: Case) -> dict[str, Any]:
        """The results of a solution in a case, with the first kind of arguments that it takes without an exception."""
        first: dict[str, Any] = {}
        for note, convert in PARAMETERS if self.in_place else KINDS if self.gradient_in is None else KINDS[:1]:
            try:
                return self._returned(called, case, convert) | ({"note": note} if note else {})
            except (Exception, SystemExit) as error:  # what the solution raises is a finding too
                misfit = isinstance(error, MisfitError)
                first = first or {"raised": f"{error}." if misfit else raised(error), "misfit": misfit}
                if isinstance(error, RuntimeError):  # of torch itself, such as 1 - a tensor of booleans
                    break
        return first

    def _returned(self, called: Solution, case: Case, convert: Callable[[Any], Any]) -> dict[str, Any]:
        args, leaf = copy.deepcopy(case.args), None
        if self.gradient_in is not None:
            leaf = args[self.gradient_in].requires_grad_()
            # As from a network: what is no leaf may be changed in place.
            args = tuple(arg * 1 if arg is leaf else arg for arg in args)
        networks = [[nn.Parameter(tensor) for tensor in arg] for arg in args if self.in_place and isinstance(arg, list)]
        given = dict(zip(self.arguments, map(convert, [*networks, *args[len(networks) :]]), strict=False))
        options = copy.deepcopy(dict(case.options))
        kept = {name: value for name, value in (given | options).items() if isinstance(value, Tensor)}
        before = {name: value.detach().clone() for name, value in kept.items()}
        returned = called.call(given, options, copy.deepcopy(case.attributes))
        if networks:
            return {"outputs": [parameter.detach() for network in networks for parameter in network]}
        several = isinstance(returned, tuple) or (isinstance(returned, list) and len(self.outputs) > 1)
        outputs = list(returned) if several else [returned]
        tensors = [tensor for output in outputs if (tensor := numbers(output)) is not None]
        if not len(tensors) == len(outputs) == len(self.outputs):
            return {"kinds": ", ".join(type(output).__name__ for output in outputs)}
        seen: dict[str, Any] = {"outputs": [tensor.detach().clone() for tensor in tensors]}
        if leaf is not None and all(tensor.requires_grad for tensor in tensors):
            total = torch.stack([tensor.sum() for tensor in tensors]).sum()
            slope = torch.autograd.grad(total, leaf, allow_unused=True)[0]
            seen["gradient"] = torch.zeros_like(leaf) if slope is None else slope
        seen["attached"] = any(tensor.requires_grad for tensor in tensors)
        if changed := [name for name, value in before.items() if not close(value, kept[name])]:
            seen["changed"] = changed[0]
        return seen

    def _complaint(self, case: Case, got: Mapping[str, Any], cases: Sequence[Mapping[str, Any]]) -> str | None:
        """A sentence on the first difference, and one on its likely cause; None if there is none."""
        if "raised" in got:
            return got["raised"]
        if "outputs" not in got:
            wanted = " and ".join(self.outputs) + (", a tensor" if len(self.outputs) == 1 else ", tensors")
            return f"it should return {'both ' * (len(self.outputs) == 2)}{wanted}; it returned {got['kinds']}."
        if difference := self._difference(got, self.answer(self.right, case)):
            return difference + self._cause(cases, case)
        if "changed" in got and got["changed"] not in SCRATCH:
            return f"it changes {got['changed']}, which it was given, in place; the next use of it sees other numbers."
        return None

    def _difference(self, got: Mapping[str, Any], right: Answer) -> str | None:
        """A sentence on the first difference between what was seen and what is right."""
        for what, output, wanted in zip(self.outputs, got["outputs"], right.outputs, strict=True):
            if output.shape != wanted.shape:
                return f"{what} has shape {list(output.shape)}; it should be {list(wanted.shape)}."
            if right.gradient is not None and "gradient" not in got:
                return f"{what} has no gradient; was something detached, or computed under no_grad?"
            if self.detached and got["attached"]:
                return f"{what} has a gradient, which would flow into the critic; .detach() is missing."
            if not close(output, wanted) and not self.value_is_free:
                return _apart(what, output, wanted)
        if right.gradient is not None and not close(got["gradient"], right.gradient):
            return "its gradient is wrong." if self.value_is_free else "the value is right, but its gradient is not."
        return None

    def _cause(self, cases: Sequence[Mapping[str, Any]], case: Case) -> str:
        """The well-known mistakes, or else changes of arguments or results, that answer the same in every case.

        Where there are none, those that do in the first case that differs: a solution may have a second mistake.
        """
        pairs = [pair for pair in zip(self.cases, cases, strict=False) if not pair[1].get("misfit")]
        for tried in (pairs, [pair for pair in pairs if pair[0] is case]):
            known = ((words, partial(self.answer, wrong)) for words, wrong in self.mistakes.items())
            for answers in (known, self._changed()):
                if likely := [words for words, answer in answers if _agree(tried, answer)]:
                    return f" Likely: {', or '.join(likely[:3])}."
        return ""

    def _changed(self) -> Iterator[tuple[str, Callable[[Case], Answer]]]:
        """The reference with changed arguments or changed results, by the words for the change."""
        last = self.cases[-1]
        for words, change in of_arguments({**dict(zip(self.arguments, last.args, strict=False)), **last.options}):
            yield words, partial(self.answer, self.right, change=change)
        for words, change in of_results(self.outputs):
            yield words, partial(self._with_results, change)

    def _with_results(self, change: Callable[[list[Tensor], int], list[Tensor]], case: Case) -> Answer:
        """The reference's results after a change of them; their gradient, if it counts, after the same."""
        right, rows = self.answer(self.right, case), len(case.args[0])
        gradient = None
        if right.gradient is not None:
            gradient = right.gradient * (change([torch.ones(())], rows)[0] if len(self.outputs) == 1 else 1)
        return Answer(tuple(change(list(right.outputs), rows)), gradient)


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
        seen = Seen()
        try:
            with globals_undisturbed(), limited(self.limit):
                seed_globals(0)
                self.look(bound(solution), seen)
        except TooLong as error:
            seen["raised"] = f"it did not end within {self.limit:g} seconds{place(error)}"
        except (Exception, SystemExit) as error:  # what the solution raises is a finding too
            seen["raised"] = raised(error)
        return seen

    def judge(self, name: str, seen: Seen) -> Finding:
        """Look for the first point that is wrong; what came before an exception is said before it."""
        notes: list[str] = []
        try:
            for sentence in self.points(Seen(seen)):
                if not isinstance(sentence, Note):
                    return Finding(name, False, sentence)
                notes.append(f" Note: {sentence}")
        except EndedError as missing:
            return Finding(name, False, seen.get("raised", f"{missing} was not seen."))
        except Exception as error:  # what a solution returns may be anything
            return Finding(name, False, f"what it does cannot be judged: {error}.")
        if "raised" in seen:
            return Finding(name, False, seen["raised"])
        return Finding(name, True, f"right.{''.join(notes)}")


def raised(error: BaseException) -> str:
    """The exception of a solution, and the reader's line that raised it; in a cell of a notebook the line alone."""
    return f"it raised {type(error).__name__}: {error}{place(error)}"


def place(error: BaseException) -> str:
    """The reader's line in which an exception was raised, after a comma; nothing where it is none of theirs."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(LIBRARIES)]
    if not own:
        return ""
    file, line = Path(own[-1].filename), own[-1].lineno
    return f", in {own[-1].name} ({f'{file.name}:{line}' if file.is_file() else f'line {line}'})"


def close(mine: Any, right: Any, rtol: float = RTOL, atol: float = ATOL) -> bool:
    """Whether two tensors, lists or numbers have one shape and are equal up to rounding; NaN is equal to nothing."""
    mine, right = (value.tolist() if isinstance(value, Tensor) else value for value in (mine, right))
    if isinstance(mine, list) and isinstance(right, list):
        return len(mine) == len(right) and all(close(a, b, rtol, atol) for a, b in zip(mine, right, strict=True))
    if isinstance(mine, int | float) and isinstance(right, int | float):
        return abs(mine - right) <= atol + rtol * abs(right)
    return False


def _flat(tensor: Any) -> list[float]:
    return [float(number) for number in tensor.reshape(-1).tolist()]


def _apart(what: str, mine: Tensor, right: Tensor) -> str:
    """A sentence on the first element that differs."""
    for flat, (one, other) in enumerate(zip(_flat(mine), _flat(right), strict=True)):
        if not abs(one - other) <= ATOL + RTOL * abs(other):
            index = [int(number) for number in np.unravel_index(flat, tuple(right.shape))] if right.dim() else ""
            return f"{what}{index} is {one:.4g}; it should be {other:.4g}."
    raise AssertionError("nothing differs")


def _agree(pairs: Sequence[tuple[Case, Mapping[str, Any]]], answer: Callable[[Case], Answer]) -> bool:
    """Whether what was seen in each of some cases is what another function answers."""
    with suppress(Exception):  # one that fails in a later case is none of the known mistakes
        return all(_same(got, answer(case)) for case, got in pairs)
    return False


def _same(got: Mapping[str, Any], other: Answer) -> bool:
    """Whether both have the same numbers, and NaN in the same places."""
    pairs = [*zip(got["outputs"], other.outputs, strict=True)]
    if other.gradient is not None:
        pairs.append((got["gradient"], other.gradient))
    return all(close(mine.nan_to_num(1e9), its.nan_to_num(1e9)) for mine, its in pairs)
