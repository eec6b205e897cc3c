"""The picture of a comparison: learning curves, final returns, probabilities of improvement."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import YAxis
from matplotlib.figure import Figure

from lemniscate.report.curves import episode_returns, smooth, training_minutes
from lemniscate.report.groups import Group, Scores
from lemniscate.report.seeds import (
    bootstrap_interval,
    improvement_interval,
    iqm,
    mean_interval,
    probability_of_improvement,
)
from lemniscate.report.style import COLORS, finish, legend_above, save
from lemniscate.run.directory import is_finished

POINTS = 200
"""points of the grid on which curves of several seeds are averaged"""

SHORT = 10
"""letters of a label up to which it stands beside its row; longer ones are numbered"""


def draw(groups: list[Group], scores: Scores, file: Path, unranked: str | None = None) -> Path:
    """Returns in training against steps and minutes; below them final returns and probabilities of improvement.

    Args:
        groups: in one environment.
        scores: final returns, of two runs of each group at least unless `unranked`.
        file: of the picture.
        unranked: the reason why nothing is ranked, written in the place of the lower half.
    """
    pairs = list(combinations(range(len(groups)), 2))
    lower = 0.3 if unranked else 0.9 + 0.3 * max(len(groups), len(pairs))
    figure = Figure(figsize=(11, 4.4 + lower), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[3.6, lower])
    by_step = figure.add_subplot(grid[0, 0])
    _draw_training(figure, by_step, figure.add_subplot(grid[0, 1], sharey=by_step), groups)
    if unranked:
        axes = figure.add_subplot(grid[1, :])
        axes.text(0.5, 0.5, unranked, ha="center", va="center")
        axes.axis("off")
        return save(figure, file)
    _draw_finals(figure.add_subplot(grid[1, 0] if pairs else grid[1, :]), groups, scores)
    if pairs:
        _draw_pairs(figure.add_subplot(grid[1, 1]), groups, pairs, scores)
    return save(figure, file)


@dataclass(frozen=True, eq=False)
class _Curve:
    """The episodes of a run: the time at which each ended, and the mean return of the last ones at that time."""

    steps: np.ndarray
    minutes: np.ndarray
    returns: np.ndarray


def _curve(run: Path) -> _Curve:
    steps, returns = episode_returns(run)
    return _Curve(steps, np.interp(steps, *training_minutes(run)), smooth(returns))


def _draw_training(figure: Figure, by_step: Axes, by_minute: Axes, groups: list[Group]) -> None:
    """Mean and interval of the finished seeds of a group, or of all if none is; the other seeds as thin lines."""
    thin = False
    for i, (one, name) in enumerate(zip(groups, _names(groups), strict=True)):
        curves = {run: curve for run in one.runs if len((curve := _curve(run)).steps)}
        whole = [curve for run, curve in curves.items() if is_finished(run)] or list(curves.values())
        rest = [curve for curve in curves.values() if curve not in whole]
        thin = thin or bool(rest)
        label = f"{name if name == one.label else f'{name}: {one.label}'} ({_seeds(len(whole))})"
        by_step.plot([], [], color=COLORS[i % 10], label=label)  # in the legend, even if no episode is whole yet
        for axes, unit in ((by_step, "steps"), (by_minute, "minutes")):
            for curve in rest:
                axes.plot(getattr(curve, unit), curve.returns, color=COLORS[i % 10], linewidth=0.7)
            if whole:
                _band(axes, [(getattr(curve, unit), curve.returns) for curve in whole], COLORS[i % 10])
    if thin:
        by_step.plot([], [], color="grey", linewidth=0.7, label="not finished")
    several = any(len(one.runs) > 1 for one in groups)
    by_step.set_title(f"{groups[0].env}{': mean and 95 % over seeds' if several else ''}", loc="left", fontsize=10)
    by_step.set(xlabel="environment steps", ylabel="return of a training episode")
    by_minute.set(xlabel="minutes of training")
    for axes in (by_step, by_minute):
        finish(axes)
    by_minute.xaxis.set_major_formatter("{x:g}")
    legend_above(figure)


def _band(axes: Axes, curves: list[tuple[np.ndarray, np.ndarray]], color: object) -> None:
    """Mean and interval of the curves, as far as all of them go: beyond, the mean would be over fewer seeds."""
    begin, end = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    grid = np.linspace(begin, max(begin, end), POINTS)
    values = np.stack([np.interp(grid, x, y) for x, y in curves])
    axes.plot(grid, values.mean(axis=0), color=color, linewidth=1.5)
    if len(curves) > 1:
        axes.fill_between(grid, *mean_interval(values), color=color, alpha=0.2, linewidth=0)


def _draw_finals(axes: Axes, groups: list[Group], scores: Scores) -> None:
    for i, one in enumerate(groups):
        finals, color = one.finals(scores), COLORS[i % 10]
        axes.plot(finals, [i - 0.25] * len(finals), "o", color=color, alpha=0.5, markersize=5, markeredgewidth=0)
        axes.plot(bootstrap_interval(finals), [i, i], color=color, linewidth=4, alpha=0.5, solid_capstyle="butt")
        axes.plot(iqm(finals), i, "|", color=color, markersize=14, markeredgewidth=3)
    axes.set_title("final return: each seed; IQM and its 95 %", loc="left", fontsize=10)
    axes.xaxis.set_major_formatter("{x:,g}")
    _rows(axes, axes.yaxis, groups, range(len(groups)))


def _draw_pairs(axes: Axes, groups: list[Group], pairs: list[tuple[int, int]], scores: Scores) -> None:
    axes.axvline(0.5, color="grey", linewidth=1)
    for row, (a, b) in enumerate(pairs):
        x, y = groups[a].finals(scores), groups[b].finals(scores)
        axes.plot(improvement_interval(x, y), [row, row], color="grey", linewidth=4, alpha=0.5, solid_capstyle="butt")
        axes.plot(probability_of_improvement(x, y), row, "|", color="black", markersize=14, markeredgewidth=3)
    axes.set_title("probability that the left one is better than the right one", loc="left", fontsize=10)
    axes.set_xlim(-0.02, 1.02)
    _rows(axes, axes.yaxis, groups, [a for a, _ in pairs])
    right = axes.secondary_yaxis("right")
    right.spines[:].set_visible(False)
    _rows(axes, right.yaxis, groups, [b for _, b in pairs])


def _rows(axes: Axes, side: YAxis, groups: list[Group], shown: Sequence[int]) -> None:
    """The name of a group at each row, in its colour."""
    names = _names(groups)
    side.set_ticks(range(len(shown)), [names[i] for i in shown])
    side.set_tick_params(length=0)
    for label, i in zip(side.get_ticklabels(), shown, strict=True):
        label.set_color(COLORS[i % 10])
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.grid(axis="x", alpha=0.3)


def _names(groups: list[Group]) -> list[str]:
    """The labels of the groups; where one is long, their numbers in the legend."""
    long = max(len(one.label) for one in groups) > SHORT
    return [str(i) if long else one.label for i, one in enumerate(groups, 1)]


def _seeds(count: int) -> str:
    return f"{count} seed{'s' * (count != 1)}" if count else "no whole episode yet"
