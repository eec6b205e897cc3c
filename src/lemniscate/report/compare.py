"""Runs side by side, grouped by all but the seed: learning curves, final returns, who improves on whom.

What Agarwal et al. 2021, arXiv:2108.13264, ask of a comparison: intervals instead of points, the IQM, and the
probability of improvement. Nothing is ranked on one seed.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import YAxis
from matplotlib.figure import Figure

from lemniscate.console import say
from lemniscate.envs.registry import file_name
from lemniscate.report.curves import (
    COLORS,
    episode_returns,
    finish,
    legend_above,
    plot_runs,
    save,
    smooth,
    training_minutes,
)
from lemniscate.report.seeds import (
    bootstrap_interval,
    improvement_interval,
    iqm,
    mean_interval,
    probability_of_improvement,
)
from lemniscate.run.directory import is_finished, read_config
from lemniscate.run.sweep_file import is_sweep

POINTS = 200
"""of the grid that curves of several seeds are brought to"""

FIELDS = 3
"""that a label names, if they tell the groups apart"""

SHORT = 10
"""letters of a label up to which it stands beside a row of its own"""

ONE_SEED = "One seed says nothing about which is better: train more with --seeds 1-5."
UNFINISHED = "Nothing is ranked before two seeds of each are finished: go on with lemniscate resume."

Scores = Mapping[Path, float]
"""final return of each run that is finished"""


@dataclass(frozen=True)
class Group:
    """Runs in one environment that differ in nothing but the seed."""

    env: str
    label: str
    runs: list[Path]

    def finals(self, scores: Scores) -> list[float]:
        """The final return of each seed that has one."""
        return [scores[run] for run in self.runs if run in scores]


def report(groups: list[Group], scores: Scores, folder: Path) -> list[Path]:
    """For each environment a table on standard error, and its pictures."""
    pictures: list[Path] = []
    envs = list(dict.fromkeys(one.env for one in groups))
    for env in envs:
        same = [one for one in groups if one.env == env]
        for line in [f"{env}:", *table(same, scores), *remarks(same, scores)]:
            say(line)
        ending = ".png" if len(envs) == 1 else f"-{file_name(env)}.png"
        pictures.append(draw(same, scores, folder / f"comparison{ending}"))
        runs = [run for one in same for run in one.runs]
        apart = len(same) == 1 and len(runs) <= len(COLORS)
        labels = [run.name if apart else one.label for one in same for run in one.runs]
        pictures += plot_runs(runs, folder, labels, ending)
    return pictures


def group(runs: Iterable[Path]) -> list[Group]:
    """Groups in the order of their first run. Runs alike even in their seed are told apart by where they are."""
    found: dict[Path, dict[str, Any]] = {}
    for run in runs:
        algorithm, config = read_config(run)
        found[run] = {"algorithm": algorithm, **config}
    times = Counter(map(_key, found.values()))
    twins = {_key(kind, but="seed") for kind in found.values() if times[_key(kind)] > 1}
    for run, kind in found.items():
        if _key(kind, but="seed") in twins:
            kind["directory"] = str(run.parent if is_sweep(run.parent) else run)
    groups: dict[str, list[Path]] = {}
    for run, kind in found.items():
        groups.setdefault(_key(kind, but="seed"), []).append(run)
    kinds = [found[members[0]] for members in groups.values()]
    return [
        Group(kind["env"], _label(kind, kinds), members) for kind, members in zip(kinds, groups.values(), strict=True)
    ]


def _key(kind: dict[str, Any], but: str = "") -> str:
    return json.dumps({name: value for name, value in kind.items() if name != but}, sort_keys=True)


def _label(kind: dict[str, Any], kinds: list[dict[str, Any]]) -> str:
    """The algorithm; where it has several groups in one environment, also what tells this one from the others."""
    rivals = [other for other in kinds if all(other[name] == kind[name] for name in ("algorithm", "env"))]
    names = [name for name in dict.fromkeys(name for rival in rivals for name in rival) if name != "seed"]
    differ = [name for name in names if len({_word(rival.get(name)) for rival in rivals}) > 1]
    few = differ[:FIELDS]
    if len({tuple(_word(rival.get(name)) for name in few) for rival in rivals}) < len(rivals):
        few = differ
    more = [f"and {len(differ) - len(few)} more"] if len(differ) > len(few) else []
    return ", ".join([kind["algorithm"].upper(), *(f"{name} {_word(kind.get(name))}" for name in few), *more])


def _word(value: Any) -> str:
    if isinstance(value, list):
        return "×".join(map(str, value))
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def table(groups: list[Group], scores: Scores) -> list[str]:
    """One line for each group, and one above them."""
    highest = max((abs(score) for one in groups for score in one.finals(scores)), default=0)
    digits = 0 if highest >= 1000 else 1 if highest >= 100 else 2
    rows = [["", "seeds", "final return", "IQM [95 %]", "worst seed", "minutes"]]
    rows += [[one.label, *_cells(one, scores, digits)] for one in groups]
    first, *others = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [
        "  ".join([row[0].ljust(first), *(cell.rjust(width) for cell, width in zip(row[1:], others, strict=True))])
        for row in rows
    ]


def _cells(one: Group, scores: Scores, digits: int) -> list[str]:
    finals = one.finals(scores)
    seeds = str(len(finals)) if len(finals) == len(one.runs) else f"{len(finals)} of {len(one.runs)}"
    if not finals:
        return [seeds, "–", "–", "–", "–"]
    mean, interval = f"{np.mean(finals):,.{digits}f}", "–"
    if len(finals) > 1:
        low, high = bootstrap_interval(finals)
        mean += f" ± {np.std(finals):,.{digits}f}"
        interval = f"{iqm(finals):,.{digits}f} [{low:,.{digits}f}, {high:,.{digits}f}]"
    minutes = np.median([training_minutes(run)[1][-1] for run in one.runs if run in scores])
    return [seeds, mean, interval, f"{min(finals):,.{digits}f}", f"{minutes:.1f}"]


def remarks(groups: list[Group], scores: Scores) -> list[str]:
    """What has to be said of a comparison: runs of unequal length, runs that are not finished, and of one seed."""
    said: list[str] = []
    lengths = {one.label: read_config(one.runs[0])[1]["total_steps"] for one in groups}
    if len(set(lengths.values())) > 1:
        each = "; ".join(f"{label}: {steps:,}" for label, steps in lengths.items())
        said.append(f"They have not taken the same number of steps: {each}.")
    unfinished = [run for one in groups for run in one.runs if not is_finished(run)]
    if unfinished:
        said.append(f"Not finished, so in the curves alone: {', '.join(map(str, unfinished))}.")
    return said if is_ranked(groups, scores) else [*said, _why_unranked(groups)]


def _why_unranked(groups: list[Group]) -> str:
    return ONE_SEED if any(len(one.runs) == 1 for one in groups) else UNFINISHED


def is_ranked(groups: list[Group], scores: Scores) -> bool:
    """Whether every group has final returns of two seeds at least."""
    return all(len(one.finals(scores)) > 1 for one in groups)


def draw(groups: list[Group], scores: Scores, file: Path) -> Path:
    """Training against steps and against minutes; below, if no group is of one seed, final returns and who improves."""
    pairs = list(combinations(range(len(groups)), 2))
    ranked = is_ranked(groups, scores)
    lower = 0.9 + 0.3 * max(len(groups), len(pairs)) if ranked else 0.3
    figure = Figure(figsize=(11, 4.4 + lower), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=[3.6, lower])
    by_step = figure.add_subplot(grid[0, 0])
    _draw_training(figure, by_step, figure.add_subplot(grid[0, 1], sharey=by_step), groups)
    if not ranked:
        axes = figure.add_subplot(grid[1, :])
        axes.text(0.5, 0.5, _why_unranked(groups), ha="center", va="center")
        axes.axis("off")
    else:
        _draw_finals(figure.add_subplot(grid[1, 0] if pairs else grid[1, :]), groups, scores)
    if ranked and pairs:
        _draw_pairs(figure.add_subplot(grid[1, 1]), groups, pairs, scores)
    return save(figure, file)


@dataclass(frozen=True, eq=False)
class _Curve:
    """A run's episodes: when each ended, and the mean return of the last ones then."""

    steps: np.ndarray
    minutes: np.ndarray
    returns: np.ndarray


def _curve(run: Path) -> _Curve:
    steps, returns = episode_returns(run)
    return _Curve(steps, np.interp(steps, *training_minutes(run)), smooth(returns))


def _draw_training(figure: Figure, by_step: Axes, by_minute: Axes, groups: list[Group]) -> None:
    """Mean and interval of a group's finished seeds, or of all if none is; those left over as thin lines."""
    thin = False
    for i, (one, name) in enumerate(zip(groups, _names(groups), strict=True)):
        curves = {run: curve for run in one.runs if len((curve := _curve(run)).steps)}
        whole = [curve for run, curve in curves.items() if is_finished(run)] or list(curves.values())
        rest = [curve for curve in curves.values() if curve not in whole]
        thin = thin or bool(rest)
        label = f"{name if name == one.label else f'{name}: {one.label}'} ({_seeds(len(whole))})"
        by_step.plot([], [], color=COLORS[i % 10], label=label)  # in the legend, even if no episode is whole yet
        for axes, clock in ((by_step, "steps"), (by_minute, "minutes")):
            for curve in rest:
                axes.plot(getattr(curve, clock), curve.returns, color=COLORS[i % 10], linewidth=0.7)
            if whole:
                _band(axes, [(getattr(curve, clock), curve.returns) for curve in whole], COLORS[i % 10])
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
    """As far as all of them go: beyond, the mean would be one of other seeds."""
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
    """A group's name at each row, in its colour."""
    names = _names(groups)
    side.set_ticks(range(len(shown)), [names[i] for i in shown])
    side.set_tick_params(length=0)
    for label, i in zip(side.get_ticklabels(), shown, strict=True):
        label.set_color(COLORS[i % 10])
    axes.set_ylim(len(shown) - 0.4, -0.6)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.grid(axis="x", alpha=0.3)


def _names(groups: list[Group]) -> list[str]:
    """The labels; where they are long, the numbers that the legend gives them."""
    long = max(len(one.label) for one in groups) > SHORT
    return [str(i) if long else one.label for i, one in enumerate(groups, 1)]


def _seeds(count: int) -> str:
    return f"{count} seed{'s' * (count != 1)}" if count else "no whole episode yet"
