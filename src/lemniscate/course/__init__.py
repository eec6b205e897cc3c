"""Checks of functions and classes that a reader writes: correct, or wrong in a well-known way.

    from lemniscate import course

    def gae(reward, value, next_value, terminated, done, *, gamma, lam): ...

    course.check(gae)

A function is compared with a reference on small cases, each with one difficulty. Where a value differs, the result is
compared with those of well-known mistakes, and the mistake that agrees is named. A class, or a function with effects,
is judged by what it does; a whole training loop (`skeleton`) by what it learns.
"""

import copy
import inspect
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from lemniscate.course.exercise import Case, Exercise, Function, Inspection, Note, raised
from lemniscate.course.exercises import EXERCISES
from lemniscate.course.skeletons import skeleton
from lemniscate.errors import UserError, shown, unknown_name
from lemniscate.run.seeding import globals_undisturbed, seed_globals
from lemniscate.system.console import say

__all__ = ["EXERCISES", "Finding", "check", "skeleton"]


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
    """Judge a solution of an exercise; prints the finding, and returns it.

    Args:
        function: the solution: a function or a class. What `lemniscate.maths` has under its name takes and returns the
            same as there; docs/courses.md has the others. A method is given as it stands in its class,
            `Trainer.calculate_pg_loss`: what it uses of `self` is put there.
        name: the name of the exercise; by default that of the function.

    Raises:
        UserError: what is no function and no class, or has no name of its own; a name that is no exercise.
    """
    name = name or _name_of(function)
    if name not in EXERCISES:
        raise _unknown(name, function)
    if not callable(function):
        raise UserError(f"What can be checked is a function or a class, not {shown(function)}.")
    exercise = EXERCISES[name]
    is_inspection = isinstance(exercise, Inspection)
    finding = _inspect(name, exercise, function) if is_inspection else _find(name, exercise, function)
    say(finding)
    return finding


def _name_of(function: Function) -> str:
    name = getattr(function, "__name__", "<lambda>")
    if name == "<lambda>":
        raise UserError(f'Which exercise is {shown(function)}? Name it: course.check(solution, "gae").')
    return name


def _unknown(name: str, thing: Function) -> UserError:
    """The sentence for a name that is no exercise; of a class with exercises as methods, those."""
    methods = [method for method in EXERCISES if isinstance(thing, type) and hasattr(thing, method)]
    if not methods:
        return unknown_name("exercise", name, EXERCISES)
    return UserError(f"{name} is judged by its methods: {', '.join(f'course.check({name}.{m})' for m in methods)}.")


def _inspect(name: str, inspection: Inspection, thing: Function) -> Finding:
    notes: list[str] = []
    try:
        with globals_undisturbed():
            seed_globals(0)
            for sentence in inspection.points(thing):
                if not isinstance(sentence, Note):
                    return Finding(name, False, sentence)
                notes.append(f" Note: {sentence}")
    except Exception as error:  # whatever it raises is a finding too
        return Finding(name, False, raised(error))
    return Finding(name, True, f"right.{''.join(notes)}")


def _find(name: str, whole: Exercise, function: Function) -> Finding:
    exercise = replace(whole, cases=_fitting(whole, function))
    cases, all_cases = len(exercise.cases), len(whole.cases)
    for i, case in enumerate(exercise.cases, start=1):
        if complaint := _complaint(exercise, function, case):
            if notes := [words for words, other in exercise.accepted.items() if _same(exercise, function, other)]:
                return Finding(name, True, f"right. Note: {notes[0]}.")
            return Finding(name, False, f"case {i} of {all_cases}, {case.about}: {complaint}")
    if cases < all_cases:
        return Finding(name, True, f"right in {cases} of {all_cases} cases; the others give it more arguments.")
    return Finding(name, True, f"right in all {cases} cases." if cases > 1 else "right.")


def _fitting(exercise: Exercise, function: Function) -> list[Case]:
    """The cases whose arguments the function can take; all of them if it can take none."""
    fitting = []
    for case in exercise.cases:
        try:
            inspect.signature(function).bind(*case.args, **case.options)
        except (TypeError, ValueError):  # other arguments; a function of C that has no signature
            continue
        fitting.append(case)
    return fitting or list(exercise.cases)


def _complaint(exercise: Exercise, function: Function, case: Case) -> str | None:
    """A sentence on the first difference, and one on its likely cause; None if there is none."""
    try:
        return _off(exercise, function, case)
    except Exception as error:  # whatever the function raises is a finding too
        return raised(error)


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
    if not _same_slope(exercise, function, exercise.right, case):
        return f"the value is right, but its gradient is not.{_cause(exercise, function)}"
    return None


def _ask(exercise: Exercise, function: Function, case: Case) -> tuple[Any, ...]:
    """The outputs of a function as a tuple; of one that works in place, the parameters after the call."""
    args = copy.deepcopy(case.args)
    if exercise.in_place:
        parameters = [[nn.Parameter(tensor) for tensor in arg] for arg in args if isinstance(arg, list)]
        function(*map(iter, parameters), *args[len(parameters) :], **case.options)  # as `module.parameters()` comes
        return tuple(parameter for network in parameters for parameter in network)
    if exercise.gradient_in is not None:
        args[exercise.gradient_in].requires_grad_()
    answer = _call(function, args, case)
    is_several = isinstance(answer, tuple) or (isinstance(answer, list) and len(exercise.outputs) > 1)
    return tuple(answer) if is_several else (answer,)


def _same_slope(exercise: Exercise, one: Function, other: Function, case: Case) -> bool:
    """Whether two losses have the same gradient in the argument that counts, if one does."""
    place = exercise.gradient_in
    return place is None or _close(*(_slope(function, case, place) for function in (one, other)))


def _slope(function: Function, case: Case, place: int) -> Tensor:
    """The gradient of a loss, or of the sum of several, in an argument."""
    args = copy.deepcopy(case.args)
    answer = _call(function, (*args[:place], args[place].requires_grad_(), *args[place + 1 :]), case)
    total = torch.stack(tuple(answer)).sum() if isinstance(answer, tuple | list) else answer
    (slope,) = torch.autograd.grad(total, args[place])
    return slope


def _call(function: Function, args: tuple[Any, ...], case: Case) -> Any:
    """Call a function with the options of a case; a method with a `self` that has them as attributes."""
    plain = getattr(function, "__func__", function)
    if inspect.isfunction(plain) and next(iter(inspect.signature(plain).parameters), None) == "self":
        held = copy.deepcopy({**case.options, **case.attributes})
        return plain(SimpleNamespace(**held, config=SimpleNamespace(**held, device="cpu")), *args)
    return function(*args, **copy.deepcopy(dict(case.options)))


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
            if not _same_slope(exercise, one, other, case):
                return False
        except Exception:  # it fails in a later case, so it is none of the known mistakes
            return False
    return True
