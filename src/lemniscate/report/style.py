"""The look of the pictures: colours, numbers on axes, legends, files."""

import io
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from lemniscate.system.files import replace_file

COLORS = mpl.colormaps["tab10"].colors  # pyright: ignore[reportAttributeAccessIssue]

FENCE = 3.0
"""a value is beyond the axis if it is further from the middle 80 % of all values than so many times their width"""


def run_styles(runs: list[Path], labels: Sequence[str] | None = None) -> Iterator[tuple[Path, object, str]]:
    """(run, colour, label) of each; one colour for one label, which is the run's name by default."""
    names = list(labels or (run.name for run in runs))
    different = list(dict.fromkeys(names))
    for run, name in zip(runs, names, strict=True):
        yield run, COLORS[different.index(name) % 10], name


def finish(axes: Axes, ticks: int = 5) -> None:
    """Remove two spines, draw a grid, write 100,000 for a hundred thousand; at most so many `ticks` and one more."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.3)
    axes.xaxis.set_major_locator(MaxNLocator(ticks))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:,.10g}"))


def robust_range(values: np.ndarray) -> tuple[float, float]:
    """The least and the greatest of `values` that are no outliers.

    An outlier is further from the middle 80 % of the values than `FENCE` times their width; where these are all alike,
    there is none.
    """
    low, high = np.percentile(values, [10, 90])
    fence = FENCE * (high - low) or np.inf
    inside = values[(values >= low - fence) & (values <= high + fence)]
    return float(inside.min()), float(inside.max())


def limit_axis(axes: Axes) -> None:
    """End the y axis where the outliers of its lines begin; triangles at the edge mark them, the title the furthest."""
    lines = [(line.get_color(), *np.asarray(line.get_xydata()).T) for line in axes.lines]
    if not lines:
        return
    values = np.concatenate([y for _, _, y in lines])
    low, high = robust_range(values)
    margin = 0.05 * (high - low)
    said = [f"▲ to {values.max():,.3g}"] if values.max() > high else []
    said += [f"▼ to {values.min():,.3g}"] if values.min() < low else []
    if said:  # both ends: the margin of one that is left as it is would be a share of the outliers
        axes.set_ylim(low - margin, high + margin)
    for color, x, y in lines:
        for beyond, edge, marker in ((y > high, 1, "^"), (y < low, 0, "v")):
            if beyond.any():  # an empty line would upset the layout
                place = np.full(beyond.sum(), edge)
                style = {"color": color, "marker": marker, "markersize": 5, "linestyle": ""}
                axes.plot(x[beyond], place, transform=axes.get_xaxis_transform(), clip_on=False, **style)
    if said:
        axes.set_title("  ".join(said), loc="right", fontsize=8, color="dimgrey")


def legend_above(figure: Figure) -> None:
    """One legend for all panels, each label once, in as many columns as fit."""
    letters = int(13 * figure.get_figwidth())
    once: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            once.setdefault(textwrap.fill(label, letters), handle)
    columns = max(1, letters // (8 + max(map(len, once), default=0)))
    if once:
        figure.legend(once.values(), once.keys(), loc="outside upper left", frameon=False, fontsize=9, ncols=columns)


def save(figure: Figure, file: Path) -> Path:
    """Write a picture."""
    picture = io.BytesIO()
    figure.savefig(picture, dpi=150, format=file.suffix.removeprefix("."))
    file.parent.mkdir(parents=True, exist_ok=True)
    replace_file(file, picture.getvalue())
    return file
