"""Learning curves, of one run or of several side by side."""

import math
import textwrap
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from lemniscate.run.directory import read_config
from lemniscate.run.loggers import read_metrics
from lemniscate.run.q_bias import QBias

DIAGNOSTICS = (
    "losses/value",
    "explained_variance",
    "approx_kl",
    "kl",
    "step_fraction",
    "clip_fraction",
    "losses/critic",
    "losses/actor",
    "q",
    "losses/entropy",
    "temperature",
    "gradient_norm",
    "gradient_norm/critic",
    "gradient_norm/actor",
)
"""the metrics of an update that are drawn, where an algorithm has them"""

POINTS = 3000
"""the most episodes of a run that are drawn, evenly chosen"""

COLORS = mpl.colormaps["tab10"].colors  # pyright: ignore[reportAttributeAccessIssue]


def learning_curve(runs: list[Path], file: Path, labels: Sequence[str] | None = None) -> Path:
    """Return of each whole training episode against steps, and the mean of the last 20, or of 2 % if that is more."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for run, color, label in _styles(runs, labels):
        steps, returns = episode_returns(run)
        if len(steps):
            some = np.linspace(0, len(steps) - 1, min(len(steps), POINTS)).astype(int)
            axes.plot(steps[some], returns[some], ".", color=color, alpha=0.25, markersize=3)
            axes.plot(steps[some], smooth(returns)[some], color=color, linewidth=1.5, label=label)
    if not axes.has_data():
        axes.text(0.5, 0.5, "no whole training episode yet", transform=axes.transAxes, ha="center", color="grey")
    axes.set(xlabel="environment steps", ylabel="return of an episode")
    axes.set_title(_title(runs), loc="left")
    finish(axes)
    if len(runs) > 1:
        legend_above(figure)
    return save(figure, file)


def diagnostics(runs: list[Path], file: Path, labels: Sequence[str] | None = None) -> Path:
    """Metrics of the updates: losses, KL, entropy, Q, gradient norms; three panels in a row."""
    logs = {run: read_metrics(run) for run in runs}
    logged = {name for lines in logs.values() for line in lines for name in line}
    names = [name for name in DIAGNOSTICS if name in logged]
    height = max(1, math.ceil(len(names) / 3))
    figure = Figure(figsize=(10, 2.75 * height), layout="constrained")
    panels = figure.subplots(height, 3, squeeze=False).flat
    for axes, name in zip_longest(panels, names):
        if name is None:
            axes.set_visible(False)
            continue
        for run, color, label in _styles(runs, labels):
            _curve(axes, logs[run], name, color, label, width=1.5 if len(runs) <= 5 else 0.7)
        axes.set_title(name, loc="left", fontsize=10)
        finish(axes)
    if len(runs) > 1:
        legend_above(figure)
    return save(figure, file)


def draw_q_bias(q_bias: QBias, run: Path, file: Path) -> Path:
    """Q(s₀, a₀) of each episode against the discounted return that followed; on the line there is no bias.

    Beside it the means of both at every evaluation of the run, if it had any.
    """
    log = [line for line in read_metrics(run) if "evaluation/q" in line]
    figure = Figure(figsize=(9.2 if log else 4.6, 4.6), layout="constrained")
    axes, *beside = figure.subplots(1, 2 if log else 1, squeeze=False)[0]
    ends = [min(q_bias.predicted + q_bias.realised), max(q_bias.predicted + q_bias.realised)]
    axes.plot(ends, ends, color="grey", linewidth=1, label="no bias")
    axes.plot(q_bias.realised, q_bias.predicted, ".", color=COLORS[0], alpha=0.6, label="episodes")
    axes.set(xlabel="discounted return that followed", ylabel="Q(s₀, a₀)")
    axes.set_title(str(q_bias).partition(": ")[2], loc="left", fontsize=10)
    for history in beside:
        _curve(history, log, "evaluation/q", COLORS[0], "Q(s₀, a₀)", width=1.5)
        _curve(history, log, "evaluation/q_realised", "grey", "discounted return", width=1.5)
        history.set_xlabel("environment steps")
        history.set_title("at the evaluations of the run", loc="left", fontsize=10)
    for panel in (axes, *beside):
        finish(panel)
        panel.legend(frameon=False)
    return save(figure, file)


def episode_returns(run: Path) -> tuple[np.ndarray, np.ndarray]:
    """(steps, returns) of every whole training episode of a run, in the order in which they ended.

    The episodes that ended in one update are spread evenly over its steps.
    """
    steps, returns, before = [], [], 0
    for line in read_metrics(run):
        ended = line.get("episode/returns", [])
        steps += list(np.linspace(before, line["step"], len(ended) + 1)[1:])
        returns += ended
        before = line["step"]
    return np.array(steps), np.array(returns)


def training_minutes(run: Path) -> tuple[np.ndarray, np.ndarray]:
    """(steps, minutes) of a run's training loop, at its start and at each line of its metrics.

    They include evaluations, checkpoints and recordings, but not the start of the process, nor the time between a
    stop and a resume.
    """
    steps, seconds = [0], [0.0]
    for line in read_metrics(run):
        if "time/steps_per_second" in line:
            seconds.append(seconds[-1] + (line["step"] - steps[-1]) / line["time/steps_per_second"])
            steps.append(line["step"])
    return np.array(steps), np.array(seconds) / 60


def plot_runs(runs: list[Path], folder: Path, labels: Sequence[str] | None = None, ending: str = ".png") -> list[Path]:
    """Draw the curves of runs into a folder; runs of one label (by default their name) have one colour."""
    return [
        learning_curve(runs, folder / f"learning_curve{ending}", labels),
        diagnostics(runs, folder / f"diagnostics{ending}", labels),
    ]


def smooth(returns: np.ndarray) -> np.ndarray:
    """The mean of the last 20 episodes at each of them, or of the last 2 % of all if that is more."""
    return _moving_average(returns, max(20, len(returns) // 50))


def _styles(runs: list[Path], labels: Sequence[str] | None) -> Iterator[tuple[Path, object, str]]:
    """(run, colour, label) of each; one colour for one label."""
    names = list(labels or (run.name for run in runs))
    different = list(dict.fromkeys(names))
    for run, name in zip(runs, names, strict=True):
        yield run, COLORS[different.index(name) % 10], name


def _curve(axes: Axes, log: list[dict[str, Any]], name: str, color: object, label: str, width: float) -> None:
    rows = [(line["step"], line[name]) for line in log if name in line]
    if not rows:
        return
    steps, values = np.array(rows).T
    axes.plot(steps, values, color=color, linewidth=width, label=label)


def _moving_average(values: np.ndarray, window: int) -> np.ndarray:
    """The mean of the last `window` values at each place, of fewer at the beginning."""
    total = np.cumsum(np.insert(values, 0, 0.0))
    start = np.maximum(0, np.arange(1, len(values) + 1) - window)
    return (total[1:] - total[start]) / (np.arange(1, len(values) + 1) - start)


def _title(runs: list[Path]) -> str:
    algorithm, config = read_config(runs[0])
    return f"{algorithm.upper() if len(runs) == 1 else f'{len(runs)} runs'} on {config['env']}"


def finish(axes: Axes) -> None:
    """Remove two spines, draw a grid, and write 100k for a hundred thousand steps."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.3)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


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
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=150)
    return file
