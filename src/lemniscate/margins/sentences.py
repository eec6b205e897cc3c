"""The findings of a pre-flight for people: a table, a sentence for each axis, and the panels of a picture."""

from collections.abc import Iterator, Mapping, Sequence

from lemniscate.envs.probe import Axis, Value
from lemniscate.margins.record import AxisMargins, Side
from lemniscate.report.margins_plot import Panel

Words = tuple[str, str]
FAILS, FALLS_SHORT = ("flies", "crash"), ("holds", "fall short")
"""the verbs for episodes that are alive, and for the others"""


def rows(found: Sequence[AxisMargins]) -> list[list[str]]:
    """The cells of the table, its heading first: what was tried, what is within the margins, what is beyond."""
    heading = ["", "tried", "within margins", "mean return there", "alive beyond"]
    return [heading, *map(_row, found)]


def _row(one: AxisMargins) -> list[str]:
    axis, inside, episodes = one.axis, one.within(), one.episodes
    returns = [one.return_at(value) for value in inside]
    beyond = [side.first for side in one.sides.values() if side.first is not None]
    return [
        axis.title,
        _span(axis, axis.values),
        _span(axis, inside) if inside else "nothing",
        f"{min(returns):,.4g}" if returns else "–",
        ", ".join(f"{episodes - one.lost_at(value)} of {episodes} at {_short(axis, value)}" for value in beyond) or "–",
    ]


def _span(axis: Axis, values: Sequence[Value]) -> str:
    """Values in a few letters: from the first to the last; of words their number."""
    if isinstance(axis.nominal, str):
        return f"{len(values)} of {len(axis.values)}"
    first, last = _short(axis, values[0]).removesuffix(f" {axis.shown_unit}"), _short(axis, values[-1])
    return f"{first} … {last}"


def _short(axis: Axis, value: Value) -> str:
    if isinstance(value, str):
        return value
    number = axis.number(value)
    sign = "+" if axis.is_factor and number else ""
    return f"{number:{sign}.4g} {axis.shown_unit}".replace("-", "−").strip()


def sentences(found: Sequence[AxisMargins], words: Words) -> Iterator[str]:
    """A sentence for each axis; one for all where not even the nominal episodes are alive.

    Args:
        found: the margins.
        words: `FAILS` or `FALLS_SHORT`.
    """
    flies, fails = words
    for one in found:
        if any(side.last is None for side in one.sides.values()):
            lost = f"{one.lost_at(one.axis.nominal)} of {one.episodes} {fails}"
            yield f"{lost} in the environment as it is, so there are no margins."
            return
    for one in found:
        said = "; ".join(_sides(one, flies, fails) if one.sides else _choices(one, flies, fails))
        yield f"{said[0].upper()}{said[1:]}."


def _sides(one: AxisMargins, flies: str, fails: str) -> list[str]:
    """The clauses of each side; one of both at once where nothing beyond them was tried."""
    axis, sides = one.axis, list(one.sides.values())
    lasts = [side.last for side in sides if side.last is not None]
    if len(sides) > 1 and all(side.first is None for side in sides):
        both = axis.phrase.format(" to ".join(map(axis.text, lasts)))
        return [f"{flies} with {both}, the most that was tried{_losses(one, lasts)}"]
    return [_side(one, side, flies, fails) for side in sides]


def _side(one: AxisMargins, side: Side, flies: str, fails: str) -> str:
    axis = one.axis
    assert side.last is not None
    with_last = f"{flies} with {axis.phrase.format(axis.text(side.last))}"
    if side.first is None:
        return f"{with_last}, the most that was tried{_losses(one, [side.last])}"
    lost = f"{one.lost_at(side.first)} of {one.episodes} {fails}"
    if side.last == axis.nominal:
        return f"{lost} with {axis.phrase.format(axis.text(side.first))}, the least that was tried"
    return f"{with_last}{_losses(one, [side.last])}; at {axis.text(side.first)} {lost}"


def _losses(one: AxisMargins, values: Sequence[Value]) -> str:
    """The losses within the margins, where there are some."""
    lost = max(map(one.lost_at, values))
    return f", and loses {lost} of {one.episodes} there" if lost else ""


def _choices(one: AxisMargins, flies: str, fails: str) -> list[str]:
    """The clauses of an axis without an order."""
    good = one.within()
    bad = [value for value in one.axis.values if value not in good]
    parts = [f"{flies} with {one.axis.phrase.format(' and '.join(map(str, good)))}"] if good else []
    return parts + [f"{one.lost_at(value)} of {one.episodes} {fails} with {value}" for value in bad]


def smoothness_sentence(smooth: Mapping[str, float]) -> str:
    """The smoothness of actions, as `record.smoothness` measures it, in a sentence."""
    fast, saturated = (100 * smooth[name] for name in ("fast_share", "saturated_share"))
    return (
        f"Actions change by {smooth['action_rate']:.2g} of their half range a second (RMS), {fast:.2g} % of their power"
        f" is above 10 Hz, and {saturated:.2g} % are at a bound."
    )


def panel(one: AxisMargins) -> Panel:
    """The panel of an axis in the picture."""
    axis, inside = one.axis, one.within()
    ends = [side.last for side in one.sides.values() if side.first is not None]
    return Panel(
        title=axis.title,
        unit=axis.shown_unit,
        values=[_place(axis, value) for value in axis.values],
        names=[str(value) for value in axis.values] if isinstance(axis.nominal, str) else [],
        nominal=_place(axis, axis.nominal),
        margin=(_place(axis, inside[0]), _place(axis, inside[-1])) if inside else None,
        edges=[_place(axis, value) for value in ends if value is not None],
        margin_text=(_span(axis, inside) if one.sides else "") if inside else "none",
        alive=[alive / one.episodes for alive in one.alive],
        returns=one.mean_returns,
    )


def _place(axis: Axis, value: Value) -> float:
    """The place of a value on the horizontal axis; words stand side by side."""
    return float(axis.values.index(value)) if isinstance(value, str) else axis.number(value)
