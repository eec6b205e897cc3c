"""The findings of a pre-flight for people: a table, a sentence for each axis, and a picture."""

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from lemniscate.envs.probe import Axis, Value
from lemniscate.margins.record import AxisMargins
from lemniscate.report.curves import COLORS, finish, legend_above, save

Words = tuple[str, str]
FAILS, FALLS_SHORT = ("flies", "crash"), ("holds", "fall short")
"""the verbs for episodes that are alive, and for the others"""

COLUMNS = 5
ALIVE, RETURN, BEYOND = COLORS[0], COLORS[1], COLORS[3]
"""colours of the picture"""


def rows(found: Sequence[AxisMargins]) -> list[list[str]]:
    """The cells of the table, its heading first: what was tried, what is within the margins, what is beyond."""
    cells = [["", "tried", "within margins", "least mean return", "alive beyond"]]
    for one in found:
        axis, inside, episodes = one.axis, one.within(), one.episodes
        least = min(map(one.return_at, inside), default=None)
        firsts = [side.first for side in one.sides.values() if side.first is not None]
        beyond = [f"{episodes - one.lost_at(edge)} of {episodes} at {_short(axis, edge)}" for edge in firsts]
        within = _span(axis, inside) if inside else "nothing"
        mean = "–" if least is None else f"{least:,.4g}"
        cells.append([axis.title, _span(axis, axis.values), within, mean, ", ".join(beyond) or "–"])
    return cells


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
    """A sentence for each axis, with these verbs; one for all where not even the nominal episodes are alive."""
    flies, fails = words
    for one in found:
        if any(side.last is None for side in one.sides.values()):
            lost = f"{one.lost_at(one.axis.nominal)} of {one.episodes} {fails}"
            yield f"{lost} in the environment as it is, so there are no margins."
            return
    for one in found:
        said = "; ".join(_sides(one, flies, fails) if one.sides else _choices(one, flies, fails))
        yield f"{said[0].upper()}{said[1:]}."


def _sides(one: AxisMargins, flies: str, fails: str) -> Iterator[str]:
    """The clauses of each side; one of both at once where nothing beyond them was tried."""
    axis, sides = one.axis, list(one.sides.values())
    for group in [sides] if all(side.first is None for side in sides) else [[side] for side in sides]:
        first, lasts = group[0].first, [side.last for side in group if side.last is not None]
        with_lasts = f"{flies} with {axis.phrase.format(' to '.join(map(axis.text, lasts)))}"
        lost = max(map(one.lost_at, lasts))
        losses = f", and loses {lost} of {one.episodes} there" if lost else ""
        beyond = "" if first is None else f"{one.lost_at(first)} of {one.episodes} {fails}"
        if first is None:
            yield f"{with_lasts}, the most that was tried{losses}"
        elif lasts == [axis.nominal]:
            yield f"{beyond} with {axis.phrase.format(axis.text(first))}, the least that was tried"
        else:
            yield f"{with_lasts}{losses}; at {axis.text(first)} {beyond}"


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


def draw(found: Sequence[AxisMargins], title: str, file: Path) -> Path:
    """Draw a panel for each axis: the share of the episodes that is alive, and the mean return."""
    columns = min(COLUMNS, len(found))
    lines = math.ceil(len(found) / columns)
    figure = Figure(figsize=(2.9 * columns + 0.6, 2.0 * lines + 0.7), layout=ConstrainedLayoutEngine(hspace=0.06))
    everything = [value for one in found for value in one.mean_returns]
    low, high = min(0.0, *everything), max(0.0, *everything)
    for i, one in enumerate(found):
        axes = figure.add_subplot(lines, columns, i + 1)
        right = axes.twinx()
        right.set_ylim(low - 0.04 * (high - low), high + 0.08 * (high - low))
        _draw(axes, right, one)
        labels = (axes, "share alive", ALIVE, 0), (right, "mean return", RETURN, columns - 1)
        for side, label, color, outermost in labels:
            if i % columns == outermost:
                side.set_ylabel(label, fontsize=8, color=color)
            else:
                side.set_yticklabels([])
    legend_above(figure)
    figure.suptitle(title, x=0.99, ha="right", fontsize=9, color="dimgrey")
    return save(figure, file)


def _draw(axes: Axes, right: Axes, one: AxisMargins) -> None:
    """The curves of one panel, the margin as a band that ends in a line where fewer are alive."""
    axis, inside, is_named = one.axis, one.within(), isinstance(one.axis.nominal, str)
    values, nominal = [_place(axis, value) for value in axis.values], _place(axis, axis.nominal)
    style: dict[str, Any] = {"markersize": 3, "linewidth": 1.5, "linestyle": "" if is_named else "-"}
    if inside and not is_named:
        ends = _place(axis, inside[0]), _place(axis, inside[-1])
        axes.axvspan(*ends, color=ALIVE, alpha=0.1, linewidth=0, label="within the margin")
        for name, side in one.sides.items():
            if side.first is not None and side.last is not None:
                edge = _place(axis, side.last)
                axes.axvline(edge, color=ALIVE, linewidth=1, linestyle="--")
                end = min(values) if name == "below" else max(values)
                axes.axvspan(edge, end, color=BEYOND, alpha=0.06, linewidth=0, label="beyond it")
    axes.axvline(nominal, color="0.6", linewidth=0.8, linestyle=":", label="nominal")
    right.plot(values, one.mean_returns, "s", color=RETURN, label="mean return", alpha=0.8, **style)
    shares = [alive / one.episodes for alive in one.alive]
    axes.plot(values, shares, "o", color=ALIVE, label="share alive", **style)
    finish(axes)
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    if is_named:
        axes.set_xticks(values, [textwrap.fill(str(value).replace("_", " "), 10) for value in axis.values])
        axes.margins(x=0.12)
    axes.set_ylim(-0.04, 1.08)
    axes.set_yticks([0, 0.5, 1], ["0", "50 %", "100 %"])
    axes.tick_params(labelsize=7.5)
    right.tick_params(labelsize=7.5, length=0)
    right.spines[:].set_visible(False)
    # The second axes of a twin are drawn above the first, but alive is what the picture is about.
    axes.set_zorder(right.get_zorder() + 1)
    axes.patch.set_visible(False)
    unit = f" ({axis.shown_unit})" if axis.shown_unit else ""
    axes.set_title(f"{axis.title}{unit}", loc="left", fontsize=9)
    margin = (_span(axis, inside) if one.sides else "") if inside else "none"
    axes.set_title(margin, loc="right", fontsize=8, color=ALIVE)


def _place(axis: Axis, value: Value) -> float:
    """The place of a value on the horizontal axis; words stand side by side."""
    return float(axis.values.index(value)) if isinstance(value, str) else axis.number(value)
