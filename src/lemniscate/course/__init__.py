"""Checks of functions that a reader writes: correct, or wrong in a well-known way.

    from lemniscate import course

    def gae(reward, value, next_value, terminated, done, *, gamma, lam): ...

    course.check(gae)

A function is compared with the library's of the same name on small cases, each with one difficulty. Where a value
differs, the result is compared with those of well-known mistakes, and the mistake that agrees is named.
"""

import copy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from lemniscate.console import say
from lemniscate.course.exercises import EXERCISES, Case, Exercise, Function
from lemniscate.errors import unknown_name


@dataclass(frozen=True)
class Finding:
    """The result of a check; true if the function is right."""

    name: str
    right: bool
    sentence: str

    def __bool__(self) -> bool:
        return self.right

    def __str__(self) -> str:
        return f"{'✓' if self.right else '✗'} {self.name}: {self.sentence}"

    def _ipython_display_(self) -> None:
        """Nothing: as the last value of a cell it has been printed already."""


def check(function: Function, name: str | None = None) -> Finding:
    """Compare a function with the library's; prints the finding, and returns it.

    Args:
        function: takes what `lemniscate.maths` documents under its name, and returns the same.
        name: the name of the library's function; by default its own name.

    Raises:
        UserError: a name that is no exercise.
    """
    name = name or function.__name__
    if name not in EXERCISES:
        raise unknown_name("exercise", name, EXERCISES)
    finding = _find(name, EXERCISES[name], function)
    say(finding)
    return finding


def _find(name: str, exercise: Exercise, function: Function) -> Finding:
    for i, case in enumerate(exercise.cases, start=1):
        if complaint := _complaint(exercise, function, case):
            return Finding(name, False, f"case {i} of {len(exercise.cases)}, {case.about}: {complaint}")
    cases = len(exercise.cases)
    return Finding(name, True, f"right in all {cases} cases." if cases > 1 else "right.")


def _complaint(exercise: Exercise, function: Function, case: Case) -> str | None:
    """A sentence on the first difference, and one on its likely cause; None if there is none."""
    try:
        return _off(exercise, function, case)
    except Exception as error:  # whatever the function raises is a finding too
        return f"it raised {type(error).__name__}: {error}"


def _off(exercise: Exercise, function: Function, case: Case) -> str | None:
    answer, want = _ask(exercise, function, case), _ask(exercise, exercise.right, case)
    if len(answer) != len(want) or not all(isinstance(output, Tensor) for output in answer):
        kinds = ", ".join(type(output).__name__ for output in answer)
        return f"it should return {' and '.join(exercise.outputs)}, each a tensor; it returned {kinds}."
    for what, mine, right in zip(exercise.outputs, answer, want, strict=True):
        if mine.shape != right.shape:
            return f"{what} has shape {list(mine.shape)}; it should be {list(right.shape)}."
        if mine.dtype != right.dtype:
            return f"{what} is {mine.dtype}; it should be {right.dtype}."
        if right.requires_grad and not mine.requires_grad:
            return f"{what} has no gradient; was something detached, or computed under no_grad?"
        if not _close(mine, right):
            return _apart(what, mine.detach(), right.detach()) + _cause(exercise, function)
    if exercise.is_loss and not _close(*(_slope(exercise, of, case) for of in (function, exercise.right))):
        return f"the value is right, but its gradient is not.{_cause(exercise, function)}"
    return None


def _ask(exercise: Exercise, function: Function, case: Case) -> tuple[Any, ...]:
    """The outputs of a function as a tuple; of one that works in place, the parameters after the call."""
    args = copy.deepcopy(case.args)
    if exercise.in_place:
        parameters = [[nn.Parameter(tensor) for tensor in arg] for arg in args if isinstance(arg, list)]
        function(*map(iter, parameters), *args[len(parameters) :], **case.options)  # as `module.parameters()` comes
        return tuple(parameter for network in parameters for parameter in network)
    if exercise.is_loss:
        args[0].requires_grad_()
    answer = function(*args, **case.options)
    return answer if isinstance(answer, tuple) else (answer,)


def _slope(exercise: Exercise, function: Function, case: Case) -> Tensor:
    """The gradient of a loss in its first argument."""
    args = copy.deepcopy(case.args)
    (slope,) = torch.autograd.grad(function(args[0].requires_grad_(), *args[1:], **case.options), args[0])
    return slope


def _close(mine: Tensor, right: Tensor) -> bool:
    return torch.allclose(mine, right, rtol=1e-4, atol=1e-5)


def _apart(what: str, mine: Tensor, right: Tensor) -> str:
    """A sentence on the first element that differs."""
    if not mine.dim():
        return f"{what} is {mine:.4g}; it should be {right:.4g}."
    place = tuple(torch.nonzero(~torch.isclose(mine, right, rtol=1e-4, atol=1e-5))[0].tolist())
    return f"{what}{list(place)} is {mine[place]:.4g}; it should be {right[place]:.4g}."


def _cause(exercise: Exercise, function: Function) -> str:
    """The well-known mistakes that give the same answers as this function in every case."""
    likely = [words for words, wrong in exercise.mistakes.items() if _same(exercise, function, wrong)]
    return f" Likely: {', or '.join(likely)}." if likely else ""


def _same(exercise: Exercise, one: Function, other: Function) -> bool:
    for case in exercise.cases:
        try:
            pairs = zip(_ask(exercise, one, case), _ask(exercise, other, case), strict=True)
            if not all(a.shape == b.shape and _close(a.to(b.dtype), b) for a, b in pairs):
                return False
            if exercise.is_loss and not _close(_slope(exercise, one, case), _slope(exercise, other, case)):
                return False
        except Exception:  # it fails in a later case, so it is none of the known mistakes
            return False
    return True
