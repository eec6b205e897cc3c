"""A user's mistakes, each in one sentence.

The command line prints a `UserError` as it is and exits with 2; anything else is our own mistake and keeps its
traceback.
"""

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from shlex import quote
from typing import Any


class UserError(ValueError):
    """A user's mistake: the message names what was wrong and what would be right."""


class NonFiniteError(ArithmeticError):
    """A NaN or an infinity where training would have learned from it: names quantity, environment and step."""


class NotStoredError(RuntimeError):
    """The disk refused the last checkpoint of a run; `run` is what `train` would have returned, in memory."""

    run: Any = None


class WorkerError(RuntimeError):
    """The process of an environment died, or does not answer, or a pipe or a file of it failed: names which."""


class RankError(RuntimeError):
    """Another process of a run failed: names which, with its sentence. It is empty where another process says it."""

    reason = ""
    """the sentence, whoever says it"""
    repeats = False
    """whether the process failed by itself, and so would again; else it was killed, or hangs"""


class SweepError(RuntimeError):
    """Some runs of a sweep failed: names each, with its sentence."""


@contextmanager
def prefix_errors(name: str) -> Iterator[None]:
    """Prefixes the message of a `UserError` with `name`."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{name}: {error}") from None


def unknown_name(
    kind: str, name: object, known: Iterable[str], otherwise: str = "nothing known is near it."
) -> UserError:
    """The sentence for a name that is not in a table: the nearest names, or all of them when few, or `otherwise`."""
    names = sorted(known)
    plain = {choice.lower().lstrip("-"): choice for choice in names}
    written = repr(name) if isinstance(name, str) else shown(name)
    typed = (name if isinstance(name, str) else written).lower().lstrip("-")
    close = [typed] if typed in plain else get_close_matches(typed, plain, n=3, cutoff=0.5)
    near = [plain[match] for match in close]
    if near:
        hint = f"did you mean {' or '.join(near)}?"
    elif len(names) <= 12:
        hint = f"there is {', '.join(names)}."
    else:
        hint = otherwise
    return UserError(f"There is no {kind} {written}: {hint}")


def shown(value: object) -> str:
    """A value in a sentence: as it is written if that is short, else its type."""
    try:
        text = _signature(value) if callable(value) else repr(value)
    except (ValueError, RecursionError):  # Python writes no whole number of more than 4,300 digits
        text = "<"
    if len(text) <= 60 and not text.startswith("<") and "\n" not in text:
        return text
    if isinstance(value, int):
        return f"a number of {int(math.log10(abs(value))) + 1:,} digits"
    return repr(f"{value[:56]}…") if isinstance(value, str) else with_article(type(value).__name__)


def with_article(noun: str) -> str:
    """A noun with "a" or "an"."""
    return f"{'an' if noun[:1] in tuple('aeiouAEIOU') else 'a'} {noun}"


def _signature(function: Any) -> str:
    """A function in a sentence, by its name and what it takes, or a class."""
    if isinstance(function, type):
        return f"the class {function.__name__}"
    try:
        return f"{function.__name__}({', '.join(signature(function).parameters)})".replace("<lambda>", "lambda")
    except (AttributeError, ValueError, TypeError):  # of objects that can be called, and of built-in functions
        return repr(function)


def wrong_action(env: str, action: Any, layout: tuple[Any, Any] | None) -> UserError:
    """The sentence for actions without the shape and the type in `layout`, which is None before a restart."""
    if layout is None:
        return UserError(f"{env}: call restart(seed) before the first step.")
    is_array = hasattr(action, "dtype")
    given = f"{type(action).__name__} {list(action.shape)} of {action.dtype}" if is_array else shown(action)
    return UserError(f"{env}: actions are a Tensor {list(layout[0])} of {layout[1]}, not {given}.")


def resume_line(path: Path) -> str:
    """The command that resumes a run or a sweep."""
    return f"lemniscate resume {quote(str(path))}"


def export_line(path: Path) -> str:
    """The command that exports the policy of a run."""
    return f"lemniscate export {quote(str(path))}"


def is_installed(package: str) -> bool:
    """Whether an optional package can be imported."""
    try:
        return find_spec(package) is not None
    except ValueError:
        return False


def missing_extra(package: str, extra: str) -> UserError:
    """The sentence for an optional package that is not installed."""
    return UserError(
        f"{package} is not installed; it comes with the extra {extra}: in lemniscate's folder, pip install '.[{extra}]'"
    )
