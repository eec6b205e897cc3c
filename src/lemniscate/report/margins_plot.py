"""The picture of a policy's margins: a panel for each axis, with the share that is alive and the mean return."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from lemniscate.report.style import COLORS, finish, legend_above, save

COLUMNS = 5
ALIVE, RETURN, BEYOND = COLORS[0], COLORS[1], COLORS[3]


@dataclass(frozen=True)
class Panel:
    """The content of one panel.

    Attributes:
        title: of the axis.
        unit: of the values.
        values: [V], where the curves have their points.
        names: of the values, where they are words.
        nominal: the value of the environment as it is.
        margin: the least and the greatest value within the margins; None where there is none.
        edges: those of the two beyond which fewer are alive.
        margin_text: the margin in words.
        alive: [V], shares.
        returns: [V].
    """

    title: str
    unit: str
    values: Sequence[float]
    names: Sequence[str]
    nominal: float
    margin: tuple[float, float] | None
    edges: Sequence[float]
    margin_text: str
    alive: Sequence[float]
    returns: Sequence[float]


def draw(panels: Sequence[Panel], title: str, file: Path) -> Path:
    """Draw all panels into a picture."""
    columns = min(COLUMNS, len(panels))
    lines = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(2.9 * columns + 0.6, 2.0 * lines + 0.7), layout=ConstrainedLayoutEngine(hspace=0.06))
    everything = [value for panel in panels for value in panel.returns]
    low, high = min(0.0, *everything), max(0.0, *everything)
    for i, panel in enumerate(panels):
        axes = figure.add_subplot(lines, columns, i + 1)
        right = axes.twinx()
        right.set_ylim(low - 0.04 * (high - low), high + 0.08 * (high - low))
        _draw(axes, right, panel)
        if i % columns:
            axes.set_yticklabels([])
        else:
            axes.set_ylabel("share alive", fontsize=8, color=ALIVE)
        if (i + 1) % columns:
            right.set_yticklabels([])
        else:
            right.set_ylabel("mean return", fontsize=8, color=RETURN)
    legend_above(figure)
    figure.suptitle(title, x=0.99, ha="right", fontsize=9, color="dimgrey")
    return save(figure, file)


def _draw(axes: Axes, right: Axes, panel: Panel) -> None:
    """The curves of one panel, the margin as a band that ends in a line where fewer are alive."""
    style: dict[str, Any] = {"markersize": 3, "linewidth": 1.5}
    style["linestyle"] = "" if panel.names else "-"
    if panel.margin and not panel.names:
        axes.axvspan(*panel.margin, color=ALIVE, alpha=0.1, linewidth=0, label="within the margin")
        for edge in panel.edges:
            axes.axvline(edge, color=ALIVE, linewidth=1, linestyle="--")
            end = min(panel.values) if edge < panel.nominal else max(panel.values)
            axes.axvspan(edge, end, color=BEYOND, alpha=0.06, linewidth=0, label="beyond it")
    axes.axvline(panel.nominal, color="0.6", linewidth=0.8, linestyle=":", label="nominal")
    right.plot(panel.values, panel.returns, "s", color=RETURN, label="mean return", alpha=0.8, **style)
    axes.plot(panel.values, panel.alive, "o", color=ALIVE, label="share alive", **style)
    finish(axes)
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    if panel.names:
        axes.set_xticks(panel.values, [textwrap.fill(name.replace("_", " "), 10) for name in panel.names])
        axes.margins(x=0.12)
    axes.set_ylim(-0.04, 1.08)
    axes.set_yticks([0, 0.5, 1], ["0", "50 %", "100 %"])
    axes.tick_params(labelsize=7.5)
    right.tick_params(labelsize=7.5, length=0)
    right.spines[:].set_visible(False)
    axes.set_zorder(right.get_zorder() + 1)
    axes.patch.set_visible(False)
    unit = f" ({panel.unit})" if panel.unit else ""
    axes.set_title(f"{panel.title}{unit}", loc="left", fontsize=9)
    axes.set_title(panel.margin_text, loc="right", fontsize=8, color=ALIVE)
