"""Runs side by side, grouped by all but the seed: a table, remarks, and pictures.

What Agarwal et al. 2021, arXiv:2108.13264, ask of a comparison: intervals instead of points, the IQM, and the
probability of improvement. Nothing is ranked on one seed.
"""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import YAxis
from matplotlib.figure import Figure

from lemniscate.envs.registry import file_name
from lemniscate.report import pages
from lemniscate.report.curves import (
    COLORS,
    episode_returns,
    finish,
    legend_above,
    moving_average,
    plot_runs,
    save,
    training_minutes,
    window_of,
)
from lemniscate.report.seeds import Group, Scores, interval, iqm, probability_of_improvement
from lemniscate.run.directory import is_finished
from lemniscate.system.console import say

ONE_SEED = "One seed says nothing about which is better: train more with --seeds 1-5."
FEW_SEEDS = "Below five seeds of each, intervals are too narrow to be believed: train more with --seeds 1-5."
UNFINISHED = "Nothing is ranked before two seeds of each are finished: continue with lemniscate resume."

POINTS = 200
"""points of the grid on which curves of several seeds are averaged"""

SHORT = 10
"""letters of a label up to which it stands beside its row; longer ones are numbered"""


def report(groups: list[Group], scores: Scores, folder: Path, by: str = "step") -> list[Path]:
    """A table on standard error, pictures in `folder`, and a page with all of it; returns the files.

    Each environment has its own table and pictures. `by` is the horizontal axis of the learning curves.
    """
    page, files, parts = folder / "report.html", list[Path](), list[dict[str, Any]]()
    envs = list(dict.fromkeys(one.env for one in groups))
    for env in envs:
        same = [one for one in groups if one.env == env]
        cells, said = rows(same, scores), remarks(same, scores)
        for line in [f"{env}:", *table(cells), *said]:
            say(line)
        ending = ".png" if len(envs) == 1 else f"-{file_name(env)}.png"
        runs = [run for one in same for run in one.runs]
        apart = len(same) == 1 and len(runs) <= len(COLORS)
        labels = [run.name if apart else one.label for one in same for run in one.runs]
        pictures = [draw(same, scores, folder / f"comparison{ending}")]
        pictures += plot_runs(runs, folder, labels, ending, by)
        parts.append(pages.comparison_part(page, same, scores, cells, said, pictures))
        files += pictures
    return [*files, pages.write_comparison(page, parts)]


def table(cells: list[list[str]]) -> list[str]:
    """The lines of the table whose `rows` are given, in columns."""
    first, *others = (max(map(len, column)) for column in zip(*cells, strict=True))
    return [
        "  ".join([row[0].ljust(first), *(cell.rjust(width) for cell, width in zip(row[1:], others, strict=True))])
        for row in cells
    ]


def rows(groups: list[Group], scores: Scores) -> list[list[str]]:
    """The cells of the table: a heading, and a row for each group."""
    highest = max((abs(score) for one in groups for score in one.finals(scores)), default=0)
    digits = 0 if highest >= 1000 else 1 if highest >= 100 else 2
    heading = ["", "seeds", "final return", "IQM [95 %]", "worst seed", "minutes"]
    return [heading, *([one.label, *_cells(one, scores, digits)] for one in groups)]


def _cells(one: Group, scores: Scores, digits: int) -> list[str]:
    finals = one.finals(scores)
    seeds = str(len(finals)) if len(finals) == len(one.runs) else f"{len(finals)} of {len(one.runs)}"
    if not finals:
        return [seeds, "–", "–", "–", "–"]
    mean, middle = f"{np.mean(finals):,.{digits}f}", "–"
    if len(finals) > 1:
        low, high = interval(iqm, finals)
        mean += f" ± {np.std(finals):,.{digits}f}"
        middle = f"{iqm(finals):,.{digits}f} [{low:,.{digits}f}, {high:,.{digits}f}]"
    minutes = np.median([training_minutes(run)[1][-1] for run in one.runs if run in scores])
    return [seeds, mean, middle, f"{min(finals):,.{digits}f}", f"{minutes:.1f}"]


def remarks(groups: list[Group], scores: Scores) -> list[str]:
    """Sentences on which is better, runs of unequal length, unfinished runs, and groups of few seeds."""
    said: list[str] = []
    lengths = {one.label: one.config["total_steps"] for one in groups}
    if len(set(lengths.values())) > 1:
        each = "; ".join(f"{label}: {steps:,}" for label, steps in lengths.items())
        said.append(f"They have not taken the same number of steps: {each}.")
    unfinished = [run for one in groups for run in one.runs if not is_finished(run)]
    if unfinished:
        said.append(f"Not finished, and so only in the curves: {', '.join(map(str, unfinished))}.")
    if unranked := _why_unranked(groups, scores):
        return [*said, unranked]
    said += [_improvement(*pair, scores) for pair in combinations(groups, 2)]
    few = len(groups) > 1 and min(len(one.finals(scores)) for one in groups) < 5
    return [*said, FEW_SEEDS] if few else said


def _improvement(one: Group, other: Group, scores: Scores) -> str:
    """The probability that the better of two groups is better, with its interval, as a sentence."""
    x, y = one.finals(scores), other.finals(scores)
    if probability_of_improvement(x, y) < 0.5:
        one, other, x, y = other, one, y, x
    low, high = interval(probability_of_improvement, x, y)
    share = f"{probability_of_improvement(x, y):.0%} [95 %: {low:.0%} to {high:.0%}]"
    return f"{one.label} is better than {other.label} in {share} of the pairs of a seed of each."


def _why_unranked(groups: list[Group], scores: Scores) -> str | None:
    """A sentence on why nothing is ranked; None if every group has final returns of two seeds at least."""
    if all(len(one.finals(scores)) > 1 for one in groups):
        return None
    return ONE_SEED if any(len(one.runs) == 1 for one in groups) else UNFINISHED


def draw(groups: list[Group], scores: Scores, file: Path) -> Path:
    """Returns in training against steps and minutes; below them final returns and probabilities of improvement.

    Where nothing is ranked, a sentence says why in the place of the lower half. The groups are in one environment.
    """
    pairs, unranked = list(combinations(range(len(groups)), 2)), _why_unranked(groups, scores)
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


def _draw_training(figure: Figure, by_step: Axes, by_minute: Axes, groups: list[Group]) -> None:
    """Mean and interval of the finished seeds of a group, or of all if none is; the other seeds as thin lines."""
    unfinished = False
    for i, (one, name) in enumerate(zip(groups, _names(groups), strict=True)):
        curves = {run: curve for run in one.runs if len((curve := _curve(run))[0])}
        whole = [run for run in curves if is_finished(run)] or list(curves)
        rest = [run for run in curves if run not in whole]
        unfinished = unfinished or bool(rest)
        seeds = f"{len(whole)} seed{'s' * (len(whole) != 1)}" if whole else "no whole episode yet"
        label = f"{name if name == one.label else f'{name}: {one.label}'} ({seeds})"
        by_step.plot([], [], color=COLORS[i % 10], label=label)  # in the legend, even if no episode is whole yet
        for unit, axes in enumerate((by_step, by_minute)):
            for run in rest:
                axes.plot(curves[run][unit], curves[run][2], color=COLORS[i % 10], linewidth=0.7)
            if whole:
                _band(axes, [(curves[run][unit], curves[run][2]) for run in whole], COLORS[i % 10])
    if unfinished:
        by_step.plot([], [], color="grey", linewidth=0.7, label="not finished")
    several = any(len(one.runs) > 1 for one in groups)
    by_step.set_title(f"{groups[0].env}{': mean and 95 % over seeds' if several else ''}", loc="left", fontsize=10)
    by_step.set(xlabel="environment steps", ylabel="return of a training episode")
    by_minute.set(xlabel="minutes of training")
    for axes in (by_step, by_minute):
        finish(axes)
    by_minute.xaxis.set_major_formatter("{x:g}")
    legend_above(figure)


def _curve(run: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The step and the minute at which each episode of a run ended, and the mean return of the last ones there."""
    steps, returns = episode_returns(run)
    return steps, np.interp(steps, *training_minutes(run)), moving_average(returns, window_of(returns))


def _band(axes: Axes, curves: list[tuple[np.ndarray, np.ndarray]], color: object) -> None:
    """Mean and interval of the curves, as far as all of them go: beyond, the mean would be over fewer seeds."""
    begin, end = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    grid = np.linspace(begin, max(begin, end), POINTS)
    values = np.stack([np.interp(grid, x, y) for x, y in curves])
    axes.plot(grid, values.mean(axis=0), color=color, linewidth=1.5)
    if len(curves) > 1:
        low, high = interval(lambda drawn: drawn.mean(axis=1), values, resamples=2_000)
        axes.fill_between(grid, low, high, color=color, alpha=0.2, linewidth=0)


def _draw_finals(axes: Axes, groups: list[Group], scores: Scores) -> None:
    for i, one in enumerate(groups):
        finals, color = one.finals(scores), COLORS[i % 10]
        axes.plot(finals, [i - 0.25] * len(finals), "o", color=color, alpha=0.5, markersize=5, markeredgewidth=0)
        axes.plot(interval(iqm, finals), [i, i], color=color, linewidth=4, alpha=0.5, solid_capstyle="butt")
        axes.plot(iqm(finals), i, "|", color=color, markersize=14, markeredgewidth=3)
    axes.set_title("final return: each seed; IQM and its 95 %", loc="left", fontsize=10)
    axes.xaxis.set_major_formatter("{x:,g}")
    _rows(axes, axes.yaxis, groups, range(len(groups)))


def _draw_pairs(axes: Axes, groups: list[Group], pairs: list[tuple[int, int]], scores: Scores) -> None:
    axes.axvline(0.5, color="grey", linewidth=1)
    for row, (a, b) in enumerate(pairs):
        x, y = groups[a].finals(scores), groups[b].finals(scores)
        ends = interval(probability_of_improvement, x, y)
        axes.plot(ends, [row, row], color="grey", linewidth=4, alpha=0.5, solid_capstyle="butt")
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
