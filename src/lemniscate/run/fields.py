"""The fields of a Config as a person writes them: their values as texts, and the names that other libraries have.

Unknown names are looked up in the table fields.md, which docs/glossary.md shows.
"""

import ast
import inspect
import json
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from lemniscate.errors import UserError, unknown_name

TABLE = Path(__file__).with_suffix(".md")
"""A row for each field: ours, then that of each library. What stands in backticks is looked up."""

GONE = {
    "population": "Population-based training has gone: `lemniscate tune` ends the worse trials early (--prune).",
    "symmetry": "There is a symmetry where a Q(s, a) is learned: sac, td3, ddpg and reppo (docs/notes/symmetry.md).",
}
"""names that a Config does not have, or not any more, and what takes their place"""


def options_of(hint: Any) -> tuple[Any, ...]:
    """The types that a field may have: those of a union, or the one."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def kinds_of(hint: Any) -> dict[Any, tuple[Any, ...]]:
    """The basic types that a field may have, such as int, tuple, dict, Literal or NoneType, each with its arguments."""
    kinds: dict[Any, tuple[Any, ...]] = {}
    for option in options_of(hint):
        kind, arguments = get_origin(option) or option, get_args(option)
        kinds |= {arguments[0]: ()} if kind is Annotated else {kind: arguments}
    return kinds


def flag(name: str) -> str:
    """The flag of a field on the command line."""
    return "--env-args" if name == "env_kwargs" else f"--{name.replace('_', '-')}"


def field_help(config: type) -> dict[str, str]:
    """The docstring below each field, read from the source of the Config and of those it inherits from."""
    found: dict[str, str] = {}
    for kind in reversed(config.__mro__[:-1]):
        try:
            (tree,) = ast.parse(dedent(inspect.getsource(kind))).body
        except (OSError, TypeError):  # typed into an interpreter, say
            continue
        for field, below in pairwise(tree.body if isinstance(tree, ast.ClassDef) else []):
            match field, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = " ".join(text.split())
    return found


def field_of(flag: str) -> str:
    """The field of a flag on the command line."""
    return "env_kwargs" if flag == "--env-args" else flag.removeprefix("--").replace("-", "_")


def typed(value: Any) -> str:
    """A value of a field as it would be typed."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple):
        return " ".join(map(typed, value))
    if isinstance(value, int):
        return f"{value:_}" if value >= 10_000 else str(value)
    return "none" if value is None else str(value)


def read(name: str, hint: Any, text: Any) -> Any:
    """The value that `text` (of a tuple, several texts) stands for; what cannot be read as `hint` says stays as it is.

    The Config then says what would be right. Raises `UserError` for a dictionary that is not JSON.
    """
    kinds = kinds_of(hint)
    if isinstance(text, list):
        joined = ",".join(text).strip()
        inner = joined[1:-1] if joined[:1] + joined[-1:] in ("[]", "()") else joined  # as Python writes several
        parts = [part.strip("'\"") for part in _split(inner)]
        if parts == ["none"]:
            return None if NoneType in kinds else ()
        return tuple(read(name, kinds[tuple][0], part) for part in parts)
    if NoneType in kinds and text == "none":
        return None
    if dict in kinds:
        return read_json(flag(name), text)
    return number(text) if kinds.keys() & {int, float} else text


def number(text: Any) -> Any:
    """The number that `text` stands for, 1e6 and 1_000 too; what is none stays, for the sentence on it."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def read_json(option: str, text: str) -> dict[str, Any]:
    """The dictionary that `text` is in JSON. Raises `UserError` for anything else."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise UserError(f"""{option} must be a JSON object, such as '{{"gravity": -5}}', not {text}""")
    return value


def _split(word: str) -> list[str]:
    """The parts between commas that are in no bracket: "a:b(x=1,y=2),c:d" is two."""
    parts, depth = [""], 0
    for character in word:
        depth += (character in "([{") - (character in ")]}")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts if part.strip()]


@cache
def rows() -> list[list[str]]:
    """The cells of each row: our field, and the other libraries' words for it; of the first row, their names."""
    lines = TABLE.read_text("utf-8").splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if not line.startswith("| ---")]


def words_of(library: str) -> str:
    """A table in Markdown of the fields that a library has a name for: its name, and the one here."""
    header, *fields = rows()
    column = header.index(library)
    lines = [(library, "lemniscate"), ("---", "---"), *((row[column], row[0]) for row in fields if "`" in row[column])]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def names_in(cell: str) -> list[str]:
    """The names in backticks: `a` gives a, and `a["b"]["c"]` a, b and c."""
    return [name for code in re.findall("`([^`]+)`", cell) for name in re.findall(r"\w+", code)]


def ours(name: str, known: Iterable[str]) -> dict[str, str]:
    """The fields among `known` that another library calls `name`, each with a remark where theirs means something else.

    A remark stands in brackets behind the name: `polyak` (1 − tau).
    """
    found: dict[str, str] = {}
    for field, *cells in rows()[1:]:
        mine = names_in(field)[0]
        codes = re.findall(r"`([^`]+)`(?: \(([^)]*)\))?", " ".join(cells))
        remarks = [remark.replace("`", "") for code, remark in codes if name in re.findall(r"\w+", code)]
        if remarks and mine in known:
            found[mine] = min(remarks, key=len)
    return found


def unknown_field(name: str, known: Iterable[str], spell: Callable[[str], str] = str) -> UserError:
    """The sentence for a field that is not `known`: ours for another library's word, or the nearest names.

    `spell` writes a name in the sentence, such as a flag.
    """
    if name in GONE:
        return UserError(GONE[name])
    known = list(known)
    found = ours(name, known)
    if not found:
        otherwise = "`lemniscate train ALGO --help` lists them."
        return unknown_name("field", spell(name), map(spell, known), otherwise)
    here = " or ".join(spell(mine) + (f" (theirs: {remark})" if remark else "") for mine, remark in found.items())
    return UserError(f"There is no {spell(name)}: here it is {here}.")
