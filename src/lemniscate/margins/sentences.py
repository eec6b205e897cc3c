"""Margins for people: a table, and a sentence for each axis."""

from collections.abc import Iterator, Sequence

from lemniscate.envs.probe import Axis, Value
from lemniscate.margins.record import AxisMargins, Side

FAILS, FALLS_SHORT = ("Flies", "crash"), ("Holds", "fall short")
"""the verbs for episodes that are alive, and for the others"""


def rows(found: Sequence[AxisMargins], episodes: int) -> list[list[str]]:
    """The cells of the table, its heading first: what was tried, what it flies with, what is beyond."""
    heading = ["", "tried", "within margins", "mean return there", "alive beyond"]
    return [heading, *(_row(one, episodes) for one in found)]


def _row(one: AxisMargins, episodes: int) -> list[str]:
    axis, inside = one.axis, within(one, episodes)
    returns = [one.return_at(value) for value in inside]
    beyond = [side.first for side in one.sides.values() if side.first is not None]
    return [
        axis.title,
        span(axis, axis.values),
        span(axis, inside) if inside else "nothing",
        f"{min(returns):,.4g}" if returns else "–",
        ", ".join(f"{one.alive_at(value)} of {episodes} at {_short(axis, value)}" for value in beyond) or "–",
    ]


def within(one: AxisMargins, episodes: int) -> list[Value]:
    """The values within the margins; of an axis without an order those at which enough are alive."""
    if not one.sides:
        return one.survived(episodes)
    values = one.axis.values
    places = [values.index(side.last) for side in one.sides.values() if side.last is not None]
    if not places:
        return []
    places.append(values.index(one.axis.nominal))
    return list(values[min(places) : max(places) + 1])


def span(axis: Axis, values: Sequence[Value]) -> str:
    """Values in a few letters: from the first to the last; of words their number."""
    if isinstance(axis.nominal, str):
        return f"{len(values)} of {len(axis.values)}"
    first, last = _short(axis, values[0]).removesuffix(f" {axis.shown_unit}"), _short(axis, values[-1])
    return f"{first} … {last}"


def _short(axis: Axis, value: Value) -> str:
    if isinstance(value, str):
        return value
    sign = "+" if axis.is_factor else ""
    number = axis.number(value)
    text = f"{number:{sign if number else ''}.4g} {axis.shown_unit}"
    return text.replace("-", "−").strip()


def _is_nominal_alive(one: AxisMargins) -> bool:
    return all(side.last is not None for side in one.sides.values())


def sentences(found: Sequence[AxisMargins], episodes: int, words: tuple[str, str]) -> Iterator[str]:
    """A sentence for each axis; one for all where not even the nominal episodes are alive.

    Args:
        found: the margins.
        episodes: E.
        words: `FAILS` or `FALLS_SHORT`.
    """
    flies, fails = words
    ordered = [one for one in found if one.sides]
    broken = [one for one in ordered if not _is_nominal_alive(one)]
    if broken:
        lost = episodes - broken[0].alive_at(broken[0].axis.nominal)
        yield f"{lost} of {episodes} {fails} in the environment as it is, so there are no margins."
        return
    for one in found:
        parts = _parts(one, episodes, flies, fails) if one.sides else _choices(one, episodes, flies, fails)
        said = "; ".join(parts)
        yield f"{said[0].upper()}{said[1:]}."


def _parts(one: AxisMargins, episodes: int, flies: str, fails: str) -> list[str]:
    """The clauses of each side; one of both at once where nothing beyond them was tried."""
    axis, sides = one.axis, list(one.sides.values())
    lasts = [side.last for side in sides]
    if len(sides) > 1 and all(side.first is None for side in sides):
        both = axis.phrase.format(" to ".join(axis.text(last) for last in lasts if last is not None))
        return [f"{flies.lower()} with {both}, the most that was tried{_losses(one, lasts, episodes)}"]
    return [_side(one, side, episodes, flies, fails) for side in sides]


def _side(one: AxisMargins, side: Side, episodes: int, flies: str, fails: str) -> str:
    axis = one.axis
    assert side.last is not None
    with_last = f"{flies.lower()} with {axis.phrase.format(axis.text(side.last))}"
    if side.first is None:
        return f"{with_last}, the most that was tried{_losses(one, [side.last], episodes)}"
    lost = f"{episodes - one.alive_at(side.first)} of {episodes} {fails}"
    if side.last == axis.nominal:
        return f"{lost} with {axis.phrase.format(axis.text(side.first))}, the least that was tried"
    return f"{with_last}{_losses(one, [side.last], episodes)}; at {axis.text(side.first)} {lost}"


def _losses(one: AxisMargins, values: Sequence[Value | None], episodes: int) -> str:
    """The losses within the margins, where there are some."""
    lost = max(episodes - one.alive_at(value) for value in values if value is not None)
    return f", and loses {lost} of {episodes} there" if lost else ""


def _choices(one: AxisMargins, episodes: int, flies: str, fails: str) -> list[str]:
    """The clauses of an axis without an order."""
    good = one.survived(episodes)
    bad = [value for value in one.axis.values if value not in good]
    parts = [f"{flies.lower()} with {one.axis.phrase.format(' and '.join(map(str, good)))}"] if good else []
    return parts + [f"{episodes - one.alive_at(value)} of {episodes} {fails} with {value}" for value in bad]
