"""The names that other libraries have for the fields of a Config; unknown names are looked up in the table glossary.md.

The same table stands in docs/glossary.md.
"""

import re
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

from lemniscate.errors import UserError, unknown_name

TABLE = Path(__file__).with_suffix(".md")
"""A row for each field: ours, then that of each library. What stands in backticks is looked up."""

GONE = {
    "population": "Population-based training has gone: `lemniscate tune` ends the worse trials early (--prune).",
}
"""names that earlier versions had, and what takes their place"""


@cache
def rows() -> list[list[str]]:
    """The cells of each row: our field, and the other libraries' words for it; of the first row, their names."""
    lines = TABLE.read_text().splitlines()
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
    """The sentence for a field that a Config does not have: ours for another library's word, or the nearest names.

    Args:
        name: the unknown field.
        known: the Config's fields.
        spell: how a name is written in the sentence, such as a flag.
    """
    if name in GONE:
        return UserError(GONE[name])
    known = list(known)
    found = ours(name, known)
    if not found:
        return unknown_name("field", spell(name), map(spell, known))
    here = " or ".join(spell(mine) + (f" (theirs: {remark})" if remark else "") for mine, remark in found.items())
    return UserError(f"There is no {spell(name)}: here it is {here}.")
