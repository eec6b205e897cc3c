"""The kinds of exercise: a function compared with a reference, and an object judged by its behaviour."""

import inspect
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

Function = Callable[..., Any]

LIBRARIES = (str(Path(__file__).parents[1]), *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")))
"""folders of code that is not the reader's"""


@dataclass(frozen=True)
class Case:
    """Arguments of a function, and what is special about them."""

    about: str
    args: tuple[Any, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    """for a function by keyword; for a method the attributes of its `self`, and of `self.config`"""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    """what only the `self` of a method has"""


@dataclass(frozen=True)
class Exercise:
    """A function to write: its reference, the cases it is compared on, and its usual mistakes."""

    right: Function
    outputs: tuple[str, ...]
    """names of what it returns"""
    cases: Sequence[Case]
    mistakes: Mapping[str, Function]
    """by description: a function that makes the mistake"""
    accepted: Mapping[str, Function] = field(default_factory=dict)
    """by note: a function that differs from the reference, and is what a course asks for"""
    gradient_in: int | None = None
    """the argument in which the gradient of its outputs counts too"""
    in_place: bool = False
    """it changes the parameters of two networks in place, and returns nothing"""


class Note(str):
    """A remark on something that is right, but may surprise."""


@dataclass(frozen=True)
class Inspection:
    """A class, or a function with effects, to write: `points` looks at what it does.

    `points` takes it and yields a sentence on each thing that is wrong, and a `Note` on what may surprise.
    """

    points: Callable[[Function], Iterator[str]]


TWO_ENDS = torch.tensor([[0, 0], [1, 0], [0, 0], [0, 1], [0, 0]]).bool()
"""a death in each of two environments, [5, 2]"""


def late(flags: torch.Tensor) -> torch.Tensor:
    """The flag of row t + 1 in row t, and that of the last row there too."""
    return torch.cat([flags[1:], flags[-1:]])


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    """Normal numbers, the same each time."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(sum(shape) + 100 * seed))


def call_by_name(function: Function, **known: Any) -> Any:
    """Call a function with those of the known arguments that its parameters name.

    Raises `TypeError` where it takes another one that has no default.
    """
    parameters = inspect.signature(function).parameters
    for name, parameter in parameters.items():
        needed = parameter.default is parameter.empty and parameter.kind in (
            parameter.POSITIONAL_OR_KEYWORD,
            parameter.KEYWORD_ONLY,
        )
        if needed and name not in known:
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
