"""Learning curves, of one run or of several side by side."""

import math
from itertools import zip_longest
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from lemniscate.errors import UserError
from lemniscate.run.critique import Honesty
from lemniscate.run.loggers import read_metrics
from lemniscate.run.run import read_config

DIAGNOSTICS = (
    "losses/value",
    "explained_variance",
    "approx_kl",
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
"""what is drawn of an update, where an algorithm has it"""

POINTS = 3000
"""episodes drawn of a run, evenly chosen"""

COLORS = mpl.colormaps["tab10"].colors  # pyright: ignore[reportAttributeAccessIssue]


def learning_curve(runs: list[Path], file: Path) -> Path:
    """Return of each whole training episode against steps, and the mean of the last 20 (or 2 %, if they are many)."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for i, run in enumerate(runs):
        steps, returns = episode_returns(run)
        if len(steps):
            some = np.linspace(0, len(steps) - 1, min(len(steps), POINTS)).astype(int)
            axes.plot(steps[some], returns[some], ".", color=COLORS[i % 10], alpha=0.25, markersize=3)
            average = _moving_average(returns, max(20, len(returns) // 50))
            axes.plot(steps[some], average[some], color=COLORS[i % 10], linewidth=1.5, label=run.name)
    if not axes.has_data():
        axes.text(0.5, 0.5, "no whole training episode yet", transform=axes.transAxes, ha="center", color="grey")
    axes.set(xlabel="environment steps", ylabel="return of an episode")
    axes.set_title(_title(runs), loc="left")
    _finish(axes, len(runs))
    return _save(figure, file)


def diagnostics(runs: list[Path], file: Path) -> Path:
    """What was watched in the updates: losses, KL, entropy, Q, gradient norms; three panels in a row."""
    watched = {name for run in runs for line in read_metrics(run) for name in line}
    names = [name for name in DIAGNOSTICS if name in watched]
    lines = max(1, math.ceil(len(names) / 3))
    figure = Figure(figsize=(10, 2.75 * lines), layout="constrained")
    panels = figure.subplots(lines, 3, squeeze=False).flat
    for axes, name in zip_longest(panels, names):
        if name is None:
            axes.set_visible(False)
            continue
        for i, run in enumerate(runs):
            _curve(axes, run, name, COLORS[i % 10])
        axes.set_title(name, loc="left", fontsize=10)
        _finish(axes, len(runs) if name == names[0] else 1)
    return _save(figure, file)


def draw_honesty(honesty: Honesty, file: Path) -> Path:
    """What Q said of the beginning of each episode, against what followed: on the line it is honest."""
    figure = Figure(figsize=(4.6, 4.6), layout="constrained")
    axes = figure.subplots()
    ends = [min(honesty.predicted + honesty.realised), max(honesty.predicted + honesty.realised)]
    axes.plot(ends, ends, color="grey", linewidth=1, label="honest")
    axes.plot(honesty.realised, honesty.predicted, ".", color=COLORS[0], alpha=0.6, label="episodes")
    axes.set(xlabel="discounted return that followed", ylabel="Q(s₀, a₀)")
    axes.set_title(str(honesty).partition(": ")[2], loc="left", fontsize=10)
    _finish(axes, 2)
    return _save(figure, file)


def episode_returns(run: Path) -> tuple[np.ndarray, np.ndarray]:
    """(steps, returns) of every whole training episode of a run, in the order in which they ended.

    The steps are those of the update that an episode ended in, spread over it.
    """
    steps, returns, before = [], [], 0
    for line in read_metrics(run):
        ended = line.get("episode/returns", [])
        steps += list(np.linspace(before, line["step"], len(ended) + 1)[1:])
        returns += ended
        before = line["step"]
    return np.array(steps), np.array(returns)


def plot_runs(runs: list[Path]) -> list[Path]:
    """Draw the pictures of one run into its `plots/`, or of several into `plots/` here. Returns the files."""
    for run in runs:
        read_config(run)
        if not read_metrics(run):
            raise UserError(f"{run} has no metrics to plot yet.")
    folder = runs[0] / "plots" if len(runs) == 1 else Path("plots")
    return [learning_curve(runs, folder / "learning_curve.png"), diagnostics(runs, folder / "diagnostics.png")]


def _curve(axes: Axes, run: Path, name: str, color: object) -> None:
    rows = [(line["step"], line[name]) for line in read_metrics(run) if name in line]
    if not rows:
        return
    steps, values = np.array(rows).T
    axes.plot(steps, values, color=color, linewidth=1.5, label=run.name)


def _moving_average(values: np.ndarray, window: int) -> np.ndarray:
    """The mean of the last `window` values at each place, of fewer at the beginning."""
    total = np.cumsum(np.insert(values, 0, 0.0))
    start = np.maximum(0, np.arange(1, len(values) + 1) - window)
    return (total[1:] - total[start]) / (np.arange(1, len(values) + 1) - start)


def _title(runs: list[Path]) -> str:
    algorithm, config = read_config(runs[0])
    return f"{algorithm.upper()} on {config['env']}" if len(runs) == 1 else f"{len(runs)} runs"


def _finish(axes: Axes, runs: int) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.3)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    if runs > 1 and axes.has_data():
        axes.legend(frameon=False)


def _save(figure: Figure, file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=150)
    return file
