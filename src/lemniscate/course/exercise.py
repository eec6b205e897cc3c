"""The two kinds of exercise and how each is judged: a function against a reference, an object by its behaviour."""

import copy
import inspect
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from lemniscate.run.run import globals_undisturbed
from lemniscate.run.seeding import seed_globals

TEMPLATES = Path(__file__).parent / "templates"
Function = Callable[..., Any]

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
    """The outputs of a function in one case, and the argument in which their gradient counts."""

    outputs: tuple[Any, ...]
    leaf: Tensor | None

    def gradient(self) -> Tensor:
        """The gradient of the sum of the outputs in that argument; 0 where none counts."""
        if self.leaf is None:
            return torch.zeros(())
        return torch.autograd.grad(torch.stack(self.outputs).sum(), self.leaf)[0]


@dataclass(frozen=True)
class Exercise:
    """A function to write: its reference, the cases it is compared on, and its well-known mistakes."""

    right: Function
    outputs: tuple[str, ...]
    """names of what it returns"""
    cases: Sequence[Case]
    mistakes: Mapping[str, Function]
    """by description: a function that makes the mistake"""
    accepted: Mapping[str, Function] = field(default_factory=dict)
    """by note: a function that differs from the reference, but is what a course asks for"""
    gradient_in: int | None = None
    """the argument in which the gradient of the outputs counts too"""
    in_place: bool = False
    """it changes the parameters of two networks in place, and returns nothing"""

    def judge(self, name: str, function: Function) -> Finding:
        """Compare a function with the reference in the cases whose arguments it takes."""
        fitting = replace(self, cases=self._fitting(function))
        cases, all_cases = len(fitting.cases), len(self.cases)
        for number, case in enumerate(fitting.cases, start=1):
            if complaint := fitting._complaint(function, case):
                if notes := [words for words, other in self.accepted.items() if fitting._agree(function, other)]:
                    return Finding(name, True, f"right. Note: {notes[0]}.")
                return Finding(name, False, f"case {number} of {all_cases}, {case.about}: {complaint}")
        if cases < all_cases:
            return Finding(name, True, f"right in {cases} of {all_cases} cases; the others give it more arguments.")
        return Finding(name, True, f"right in all {cases} cases." if cases > 1 else "right.")

    def answer(self, function: Function, case: Case) -> Answer:
        """Call a function on copies of a case's arguments; the parameters afterwards, if it works in place."""
        args = copy.deepcopy(case.args)
        if self.in_place:
            networks = [[nn.Parameter(tensor) for tensor in arg] for arg in args if isinstance(arg, list)]
            # Iterators, which can be gone through once, since that is what `module.parameters()` returns.
            function(*map(iter, networks), *args[len(networks) :], **case.options)
            return Answer(tuple(parameter for network in networks for parameter in network), None)
        leaf = None if self.gradient_in is None else args[self.gradient_in].requires_grad_()
        outputs = call(function, args, case)
        is_several = isinstance(outputs, tuple) or (isinstance(outputs, list) and len(self.outputs) > 1)
        return Answer(tuple(outputs) if is_several else (outputs,), leaf)

    def _fitting(self, function: Function) -> list[Case]:
        """The cases whose arguments the function can take; all of them if it can take none."""
        fitting = []
        for case in self.cases:
            with suppress(TypeError, ValueError):  # other arguments; a function written in C, which has no signature
                inspect.signature(function).bind(*case.args, **case.options)
                fitting.append(case)
        return fitting or list(self.cases)

    def _complaint(self, function: Function, case: Case) -> str | None:
        """A sentence on the first difference, and one on its likely cause; None if there is none."""
        try:
            mine, right = self.answer(function, case), self.answer(self.right, case)
            if len(mine.outputs) != len(right.outputs) or not all(isinstance(out, Tensor) for out in mine.outputs):
                kinds = ", ".join(type(output).__name__ for output in mine.outputs)
                return f"it should return {' and '.join(self.outputs)}, each a tensor; it returned {kinds}."
            for what, output, wanted in zip(self.outputs, mine.outputs, right.outputs, strict=True):
                if unlike := _unlike(what, output, wanted):
                    return unlike
                if not _close(output, wanted):
                    return _apart(what, output.detach(), wanted.detach()) + self._cause(function)
            if not _close(mine.gradient(), right.gradient()):
                return "the value is right, but its gradient is not." + self._cause(function)
        except Exception as error:  # what the solution raises is a finding too
            return raised(error)
        return None

    def _cause(self, function: Function) -> str:
        """The well-known mistakes that give the same answers as this function in every case."""
        likely = [words for words, wrong in self.mistakes.items() if self._agree(function, wrong)]
        return f" Likely: {', or '.join(likely)}." if likely else ""

    def _agree(self, one: Function, other: Function) -> bool:
        """Whether two functions give the same outputs and gradients in every case."""
        try:
            return all(_same(self.answer(one, case), self.answer(other, case)) for case in self.cases)
        except Exception:  # one that fails in a later case is none of the known mistakes
            return False


class Note(str):
    """A remark on something that is right, but may surprise."""


@dataclass(frozen=True)
class Inspection:
    """A class, or a function with effects, to write: judged by what it does."""

    points: Callable[[Function], Iterator[str]]
    """takes the solution; yields a sentence on each thing that is wrong, and a `Note` on what may surprise"""

    def judge(self, name: str, solution: Function) -> Finding:
        """Look for the first point that is wrong; the global random generators are left as they were."""
        notes: list[str] = []
        try:
            with globals_undisturbed():
                seed_globals(0)
                for sentence in self.points(solution):
                    if not isinstance(sentence, Note):
                        return Finding(name, False, sentence)
                    notes.append(f" Note: {sentence}")
        except Exception as error:  # what the solution raises is a finding too
            return Finding(name, False, raised(error))
        return Finding(name, True, f"right.{''.join(notes)}")


def call(function: Function, args: tuple[Any, ...], case: Case) -> Any:
    """Call a function with the options of a case; a method with a `self` that has them as attributes."""
    plain = getattr(function, "__func__", function)
    if inspect.isfunction(plain) and next(iter(inspect.signature(plain).parameters), None) == "self":
        held = copy.deepcopy({**case.options, **case.attributes})
        return plain(SimpleNamespace(**held, config=SimpleNamespace(**held, device="cpu")), *args)
    return function(*args, **copy.deepcopy(dict(case.options)))


def call_by_name(function: Function, **known: Any) -> Any:
    """Call a function with those of the known arguments that its parameters name.

    Raises:
        TypeError: the function takes another argument, which has no default.
    """
    parameters = inspect.signature(function).parameters
    for name, parameter in parameters.items():
        is_named = parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
        if is_named and parameter.default is parameter.empty and name not in known:
            raise TypeError(f"its parameter {name} is none of those that this exercise has: {', '.join(known)}")
    return function(**{name: known[name] for name in parameters if name in known})


def raised(error: Exception) -> str:
    """The exception of a solution, and the reader's line that raised it; in a cell of a notebook the line alone."""
    own = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(LIBRARIES)]
    if not own:
        return f"it raised {type(error).__name__}: {error}"
    file, line = Path(own[-1].filename), own[-1].lineno
    place = f"{file.name}:{line}" if file.is_file() else f"line {line}"
    return f"it raised {type(error).__name__}: {error}, in {own[-1].name} ({place})"


def _unlike(what: str, mine: Tensor, right: Tensor) -> str | None:
    """A sentence on another shape or kind of tensor."""
    if mine.shape != right.shape:
        return f"{what} has shape {list(mine.shape)}; it should be {list(right.shape)}."
    if mine.dtype != right.dtype:
        return f"{what} is {mine.dtype}; it should be {right.dtype}."
    if right.requires_grad and not mine.requires_grad:
        return f"{what} has no gradient; was something detached, or computed under no_grad?"
    return None


def _apart(what: str, mine: Tensor, right: Tensor) -> str:
    """A sentence on the first element that differs."""
    if not mine.dim():
        return f"{what} is {mine:.4g}; it should be {right:.4g}."
    place = tuple(torch.nonzero(~torch.isclose(mine, right, rtol=RTOL, atol=ATOL))[0].tolist())
    return f"{what}{list(place)} is {mine[place]:.4g}; it should be {right[place]:.4g}."


def _close(mine: Tensor, right: Tensor) -> bool:
    return torch.allclose(mine, right, rtol=RTOL, atol=ATOL)


def _same(mine: Answer, other: Answer) -> bool:
    pairs = list(zip(mine.outputs, other.outputs, strict=True))
    is_same = all(a.shape == b.shape and _close(a.to(b.dtype), b) for a, b in pairs)
    return is_same and _close(mine.gradient(), other.gradient())
