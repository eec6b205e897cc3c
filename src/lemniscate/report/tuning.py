"""Pictures of a search: its history, the importance of its settings, and all trials in parallel coordinates."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from lemniscate.report.style import COLORS, finish, save
from lemniscate.system.files import make_directory

FEW = 4
"""complete trials below which an importance would be a guess"""


def draw(study: Any, names: Sequence[str], folder: Path) -> list[Path]:
    """Draw a study of Optuna's that has a complete trial, and searches the settings `names`; returns the files."""
    make_directory(folder)
    complete = [trial for trial in study.trials if trial.state.name == "COMPLETE"]
    files = [_history(study, folder / "history.png")]
    if len(complete) >= FEW and len(names) > 1:
        files += _by_optuna(study, len(names), folder)
    return files


def _history(study: Any, file: Path) -> Path:
    """The score of each trial, those that ended early with what they were compared by, and the best so far.

    Optuna's own picture leaves out the trials that ended early.
    """
    complete = [(t.number, t.value) for t in study.trials if t.state.name == "COMPLETE"]
    early = [(t.number, list(t.intermediate_values.values())[-1]) for t in study.trials if t.state.name == "PRUNED"]
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    if early:
        axes.scatter(*zip(*early, strict=True), s=18, color="0.7", label="ended early, training return")
    numbers, scores = zip(*complete, strict=True)
    axes.scatter(numbers, scores, s=26, color=COLORS[0], label="score")
    axes.step(numbers, np.maximum.accumulate(scores), where="post", color=COLORS[1], label="best so far")
    axes.set(xlabel="trial", ylabel="interquartile mean over seeds", title="History of the search")
    axes.legend(frameon=False, fontsize=9)
    finish(axes)
    return save(figure, file)


def _by_optuna(study: Any, settings: int, folder: Path) -> list[Path]:
    """The importance of the settings, and each trial as a line through them, the darker the better its score."""
    from matplotlib import pyplot
    from optuna.importance import PedAnovaImportanceEvaluator
    from optuna.visualization import matplotlib as optuna_plots

    with mpl.rc_context({"savefig.bbox": "tight"}), pyplot.ioff(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Optuna's on functions that are experimental
        # The lines come first: the bars set a style that changes them.
        lines: Any = optuna_plots.plot_parallel_coordinate(study, target_name="score")
        lines.set_title("Settings and score of each trial that came to its end")
        lines.figure.set_size_inches(max(8.0, 2.2 * (settings + 1)), 4.5)
        # PED-ANOVA, because Optuna's own choice, fANOVA, needs scikit-learn.
        shares: Any = optuna_plots.plot_param_importances(study, evaluator=PedAnovaImportanceEvaluator())
        shares.set_title("Importance of each setting (PED-ANOVA)", loc="left")
        shares.set(xlabel="", ylabel="", facecolor="white")
        shares.get_legend().remove()
        shares.figure.set_size_inches(7, 0.5 * settings + 1.5)
        files = [save(shares.figure, folder / "importance.png"), save(lines.figure, folder / "settings.png")]
        for axes in (lines, shares):
            pyplot.close(axes.figure)
    return files
