"""Pictures of a search: its history, the importance of its settings, and all trials in parallel coordinates."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lemniscate.report.style import COLORS, finish, save
from lemniscate.system.files import make_directory

FEW = 4
"""complete trials below which an importance would be a guess"""


def draw(study: Any, names: Sequence[str], folder: Path) -> list[Path]:
    """Draw what there is to see in a study of Optuna's; returns the files."""
    complete = [trial for trial in study.trials if trial.state.name == "COMPLETE"]
    make_directory(folder)
    files = [_draw(folder / "history.png", (7, 4), lambda figure: _history(figure.subplots(), study))]
    if len(complete) >= FEW and len(names) > 1:
        files.append(_draw(folder / "importance.png", (7, 0.5 * len(names) + 1.5), lambda f: _importance(f, study)))
        size = (max(7.0, 1.7 * (len(names) + 1)), 4.5)
        files.append(_draw(folder / "settings.png", size, lambda figure: _settings(figure, complete, names)))
    return files


def draw_population(
    tenths: Sequence[Sequence[dict[str, Any]]], best: int, names: Sequence[str], folder: Path
) -> list[Path]:
    """Draw how the numbers among the settings of a population changed; returns the files.

    Args:
        tenths: for each tenth of the runs, the settings of every member, and of whom it is a copy.
        best: the member that is best in the end.
        names: of the settings.
        folder: of the picture.
    """
    numbers = [name for name in names if isinstance(tenths[0][0]["settings"][name], int | float)]
    make_directory(folder)
    if not numbers:
        return []
    size = (7, 0.6 + 2.2 * len(numbers))
    return [_draw(folder / "population.png", size, lambda figure: _population(figure, tenths, best, numbers))]


def _population(figure: Figure, tenths: Any, best: int, names: Sequence[str]) -> None:
    """Each setting by tenth; in colour those that the best member's networks were trained with."""
    ancestors = [best]
    for members in reversed(tenths[1:]):
        copy_of = members[ancestors[0]]["copy_of"]
        ancestors.insert(0, ancestors[0] if copy_of is None else copy_of)
    tenth = np.arange(1, len(tenths) + 1)
    for axes, name in zip(figure.subplots(len(names), squeeze=False)[:, 0], names, strict=True):
        values = np.array([[member["settings"][name] for member in members] for members in tenths])
        axes.plot(tenth, values, "o", color="0.75", markersize=4)
        path = values[np.arange(len(tenths)), ancestors]
        axes.step(tenth, path, where="mid", color=COLORS[0], label="of the best member, and of those it is copied from")
        if values.min() > 0 and values.max() > 10 * values.min():
            axes.set_yscale("log")
        axes.set(ylabel=name, xticks=tenth)
        finish(axes)
    figure.axes[0].legend(frameon=False, fontsize=9)
    figure.axes[0].set_title("Settings of the population")
    figure.axes[-1].set_xlabel("tenth of the steps")


def _draw(file: Path, size: tuple[float, float], content: Any) -> Path:
    figure = Figure(size, layout="constrained")
    content(figure)
    save(figure, file)
    return file


def _history(axes: Axes, study: Any) -> None:
    """The score of each trial, those that ended early with what they were compared by, and the best so far."""
    complete = [(t.number, t.value) for t in study.trials if t.state.name == "COMPLETE"]
    early = [(t.number, list(t.intermediate_values.values())[-1]) for t in study.trials if t.state.name == "PRUNED"]
    if early:
        axes.scatter(*zip(*early, strict=True), s=18, color="0.7", label="ended early, training return")
    numbers, scores = zip(*complete, strict=True)
    axes.scatter(numbers, scores, s=26, color=COLORS[0], label="score")
    axes.step(numbers, np.maximum.accumulate(scores), where="post", color=COLORS[1], label="best so far")
    axes.set(xlabel="trial", ylabel="interquartile mean over seeds", title="History of the search")
    axes.legend(frameon=False, fontsize=9)
    finish(axes)


def _importance(figure: Figure, study: Any) -> None:
    """The share of the scores' variance that each setting explains."""
    from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shares = get_param_importances(study, evaluator=PedAnovaImportanceEvaluator())
    axes = figure.subplots()
    names = list(shares)[::-1]
    axes.barh(names, [shares[name] for name in names], color=COLORS[0], height=0.6)
    for y, name in enumerate(names):
        axes.text(shares[name], y, f" {shares[name]:.2f}", va="center", fontsize=9)
    axes.set(title="Importance of each setting (PED-ANOVA)", xlim=(0, 1.12 * max(shares.values())))
    axes.spines[["top", "right"]].set_visible(False)


def _settings(figure: Figure, trials: Sequence[Any], names: Sequence[str]) -> None:
    """Each complete trial as a line through its settings to its score, the better the brighter."""
    axes = figure.subplots()
    scores = np.array([trial.value for trial in trials])
    columns = [_column([trial.params[name] for trial in trials], trials[0].distributions[name]) for name in names]
    columns.append((_scaled(scores), [(0.0, f"{scores.min():,.4g}"), (1.0, f"{scores.max():,.4g}")]))
    color = mpl.colormaps["viridis"]
    for i in np.argsort(scores):
        height = columns[-1][0][i]
        axes.plot([positions[i] for positions, _ in columns], color=color(height), alpha=0.35 + 0.65 * height)
    for x, (_, ticks) in enumerate(columns):
        axes.axvline(x, color="0.3", linewidth=0.8)
        for y, text in ticks:
            axes.text(x + 0.03, y, text, fontsize=8, va="bottom" if y < 0.5 else "top", color="0.2")
    axes.set_xticks(range(len(columns)), [*names, "score"])
    axes.set(yticks=[], title="Settings and score of each trial that came to its end", xlim=(-0.1, len(names) + 0.4))
    axes.spines[["top", "right", "left", "bottom"]].set_visible(False)


def _column(values: list[Any], distribution: Any) -> tuple[np.ndarray, list[tuple[float, str]]]:
    """The heights of values between the ends of their range, and the marks of the axis."""
    if hasattr(distribution, "choices"):
        heights = np.linspace(0, 1, len(distribution.choices))
        marks = list(zip(heights.tolist(), map(str, distribution.choices), strict=True))
        return np.array([heights[distribution.choices.index(value)] for value in values]), marks
    scale = np.log if distribution.log else np.asarray
    low, high = scale(distribution.low), scale(distribution.high)
    marks = [(0.0, f"{distribution.low:.4g}"), (1.0, f"{distribution.high:.4g}")]
    return (scale(np.array(values, dtype=float)) - low) / (high - low), marks


def _scaled(values: np.ndarray) -> np.ndarray:
    return (values - values.min()) / (np.ptp(values) or 1.0)
