"""The metrics of the updates: losses, KL divergence, entropy, Q, gradient norms."""

import math
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lemniscate.report.style import finish, legend_above, limit_axis, run_styles, save
from lemniscate.run.metrics import read_metrics

TITLES = {
    "losses/policy": ("Policy loss", ""),
    "losses/value": ("Value loss", "return²"),
    "losses/actor": ("Actor loss", "return"),
    "losses/critic": ("Critic loss", "return²"),
    "q": ("Q", "return"),
    "explained_variance": ("Explained variance", "share"),
    "approx_kl": ("Approximate KL divergence", "nats"),
    "kl": ("KL divergence", "nats"),
    "step_fraction": ("Step fraction", "share of the full step"),
    "clip_fraction": ("Clip fraction", "share of ratios"),
    "losses/entropy": ("Entropy of the policy", "nats"),
    "policy_std": ("Standard deviation of the policy", "half the action range"),
    "temperature": ("Temperature", "return per nat"),
    "gradient_norm": ("Gradient norm", "before the clip"),
    "gradient_norm/critic": ("Gradient norm of the critic", "before the clip"),
    "gradient_norm/actor": ("Gradient norm of the actor", "before the clip"),
    "gradient_norm/value": ("Gradient norm of the value", "before the clip"),
    "learning_rate": ("Learning rate", ""),
}
"""metric: (title, unit), in the order of the panels; the names and units of the glossary"""

APART = ("step", "old_approx_kl", "gradient_norm/temperature")
"""metrics without a panel, beside those in `ELSEWHERE`"""

ELSEWHERE = ("episode/", "evaluation/", "time/")
"""beginnings of the names that are not of an update"""


def diagnostics(runs: list[Path], file: Path, labels: Sequence[str] | None = None) -> Path:
    """Draw a panel for each metric of the updates, three in a row; one of a user's own algorithm under its name.

    A few outliers do not flatten a panel: its y axis ends where they begin, and triangles mark them.
    """
    logs = {run: read_metrics(run) for run in runs}
    logged = {name: None for lines in logs.values() for line in lines for name in line}
    own = [name for name in logged if name not in (*TITLES, *APART) and not name.startswith(ELSEWHERE)]
    names = [name for name in TITLES if name in logged] + own
    rows = max(1, math.ceil(len(names) / 3))
    figure = Figure(figsize=(10, 2.4 * rows + 0.4), layout="constrained")
    for i, (axes, name) in enumerate(zip_longest(figure.subplots(rows, 3, squeeze=False).flat, names)):
        if name is None:
            axes.set_visible(False)
            continue
        for run, color, label in run_styles(runs, labels):
            draw_metric(axes, logs[run], name, color, label, width=1.5 if len(runs) <= 5 else 0.7)
        title, unit = TITLES.get(name, (name, ""))
        axes.set_title(title, loc="left", fontsize=10)
        axes.set_ylabel(unit, fontsize=8)
        axes.set_xlabel("environment steps" if i >= len(names) - 3 else "", fontsize=9)
        axes.set_xlim(left=0)
        finish(axes, ticks=3)  # a panel is narrow
        limit_axis(axes)
    if len(runs) > 1:
        legend_above(figure)
    return save(figure, file)


def draw_metric(axes: Axes, log: list[dict[str, Any]], name: str, color: object, label: str, width: float) -> None:
    """Draw one metric of a run against steps, if it has any."""
    rows = [(line["step"], line[name]) for line in log if name in line]
    if rows:
        axes.plot(*np.array(rows).T, color=color, linewidth=width, label=label)
