"""Pictures of logged numbers: learning curves, metrics of updates, the bias of Q, a search, a curve in training.

The look that they share with other pictures is below them: colours, numbers on axes, legends, files.
"""

import io
import math
import textwrap
import time
import tomllib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from lemniscate.run.directory import read_config
from lemniscate.run.evaluate import QBias
from lemniscate.run.metrics import read_metrics
from lemniscate.run.signals import KINDS as SIGNALS
from lemniscate.system.console import Place, in_notebook
from lemniscate.system.files import make_directory, replace_file

COLORS = mpl.colormaps["tab10"].colors  # pyright: ignore[reportAttributeAccessIssue]

FENCE = 3.0
"""a value is beyond the axis if it is further from the middle 80 % of all values than so many times their width"""

BY = {"step": "environment steps", "episode": "episode", "minute": "minutes of training"}
"""what a learning curve can be drawn against, and the label of that axis"""

WINDOW = 20
"""the fewest episodes of a moving average"""

POINTS = 3000
"""the most episodes of a run that are drawn, evenly chosen"""

FEW = 4
"""complete trials below which an importance would be a guess"""

TITLES = tomllib.loads((Path(__file__).parent / "templates" / "metrics.toml").read_text(encoding="utf-8"))
"""metric: (title, unit), in the order of the panels"""

APART = ("step", "old_approx_kl", "gradient_norm/temperature")
"""metrics without a panel, beside those in `ELSEWHERE`"""

ELSEWHERE = ("episode/", "evaluation/", "time/", *SIGNALS)
"""beginnings of the names that are not of an update"""


def plot_runs(
    runs: list[Path], folder: Path, labels: Sequence[str] | None = None, ending: str = ".png", by: str = "step"
) -> list[Path]:
    """Draw the curves of runs into a folder; runs of one label (by default their name) have one colour."""
    name = "learning_curve" if by == "step" else f"learning_curve_by_{by}"
    return [
        learning_curve(runs, folder / f"{name}{ending}", labels, by),
        diagnostics(runs, folder / f"diagnostics{ending}", labels),
    ]


def learning_curve(runs: list[Path], file: Path, labels: Sequence[str] | None = None, by: str = "step") -> Path:
    """Return of each whole training episode, and the mean of the last ones: of 20, or of 2 % if that is more.

    By episode the mean is that of the last 20 always. The line is interrupted where no episode ended for long. The
    horizontal axis is one of `BY`; several runs have different colours.
    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    several = len(runs) > 1
    drawn = [_draw_episodes(axes, run, by, color, label * several) for run, color, label in run_styles(runs, labels)]
    windows = sorted(filter(None, drawn))
    axes.set(xlabel=BY[by], ylabel="return of an episode")
    algorithm, config = read_config(runs[0])
    axes.set_title(f"{f'{len(runs)} runs' if several else algorithm.upper()} on {config['env']}", loc="left")
    axes.set_xlim(left=0)
    finish(axes)
    if windows:
        few, many, color = windows[0], windows[-1], "grey" if several else COLORS[0]
        last = f"{few:,}" if few == many else f"{few:,} to {many:,}"
        axes.plot([], [], ".", color=color, label="an episode")
        axes.plot([], [], color=color, linewidth=1.5, label=f"mean of the last {last}")
        legend_above(figure)
    else:
        axes.text(0.5, 0.5, "no whole training episode yet", transform=axes.transAxes, ha="center", color="grey")
    return save(figure, file)


def _draw_episodes(axes: Axes, run: Path, by: str, color: object, label: str) -> int:
    """The episodes of a run as dots, their moving average as a line; returns over how many, 0 if there is none yet."""
    steps, returns = episode_returns(run)
    if not len(steps):
        return 0
    window, x, interrupted = window_of(returns), steps, gaps(steps)
    if by == "episode":
        window, x, interrupted = WINDOW, np.arange(1.0, len(steps) + 1), np.zeros_like(interrupted)
    elif by == "minute":
        x = np.interp(steps, *training_minutes(run))
    some = np.linspace(0, len(steps) - 1, min(len(steps), POINTS)).astype(int)
    x, averages = x[some], moving_average(returns, window)[some]
    axes.plot(x, returns[some], ".", color=color, alpha=0.25 if len(x) > 300 else 0.5, markersize=3)
    cuts = np.flatnonzero(np.diff(np.cumsum([False, *interrupted])[some])) + 1
    axes.plot(np.insert(x, cuts, np.nan), np.insert(averages, cuts, np.nan), color=color, linewidth=1.5, label=label)
    return window


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
    for i, name in enumerate(names):
        axes = figure.add_subplot(rows, 3, i + 1)
        for run, color, label in run_styles(runs, labels):
            draw_metric(axes, logs[run], name, color, label, width=1.5 if len(runs) <= 5 else 0.7)
        words = name.removeprefix("info/").replace("_", " ")
        title, unit = TITLES.get(name, (words[:1].upper() + words[1:] if name.startswith("info/") else name, ""))
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
        draw_metric(history, log, "evaluation/q", COLORS[0], "Q(s₀, a₀)", width=1.5)
        draw_metric(history, log, "evaluation/q_realised", "grey", "discounted return", width=1.5)
        history.set(xlabel="environment steps", ylabel="discounted return")
        history.set_title("at the evaluations of the run", loc="left", fontsize=10)
    for panel in (axes, *beside):
        finish(panel)
        panel.legend(frameon=False)
    return save(figure, file)


class LiveCurve:
    """A callback that draws the returns of training episodes, and of evaluations where the run has them.

        lem.train("ppo", "CartPole-v1", callbacks=[LiveCurve()])

    The picture is replaced at most once in `seconds`, and at the end of the run. Outside a notebook nothing is drawn.
    """

    def __init__(self, seconds: float = 1.0) -> None:
        self.seconds = seconds
        self._drawn = -float("inf")
        self._place = Place()
        self._curves: dict[str, list[tuple[int, float]]] = {"episode/return": [], "evaluation/return": []}

    def __call__(self, step: int, metrics: Mapping[str, float], policy: Any) -> None:
        """Take the returns of one line, and draw if it is time."""
        for name, points in self._curves.items():
            if name in metrics:
                points.append((step, metrics[name]))
        due = time.monotonic() - self._drawn >= self.seconds or step >= policy.config.total_steps
        if due and any(self._curves.values()) and in_notebook():
            from IPython.display import Image

            self._place.show(Image(self.draw(policy.config), format="png"))
            self._drawn = time.monotonic()

    def draw(self, config: Any) -> bytes:
        """The curves so far as a PNG; `config` has the title and the length of the run."""
        figure = Figure(figsize=(7, 3), layout="constrained")
        axes = figure.subplots()
        for points, style, label in zip(self._curves.values(), ("-", "o-"), ("training", "evaluation"), strict=True):
            if points:
                axes.plot(*zip(*points, strict=True), style, label=label, linewidth=1.5, markersize=4)
        axes.set(xlabel="environment steps", ylabel="return of an episode", xlim=(0, config.total_steps))
        axes.set_title(f"{config.env}, seed {config.seed}", loc="left")
        axes.legend(frameon=False)
        finish(axes)
        png = io.BytesIO()
        figure.savefig(png, format="png", dpi=90)
        return png.getvalue()


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


def gaps(steps: np.ndarray) -> np.ndarray:
    """Whether no episode ended for long between each two that ended at `steps` [episodes]: [episodes − 1].

    Long is more than three times the usual (median) time between two, and more than a twentieth of all steps.
    """
    pauses = np.diff(steps)
    return pauses > max(3 * np.median(pauses), steps[-1] / 20) if len(pauses) else np.zeros(0, dtype=bool)


def window_of(returns: np.ndarray) -> int:
    """The number of episodes of a moving average of `returns`: 20, or 2 % of all if that is more."""
    return max(WINDOW, len(returns) // 50)


def moving_average(values: np.ndarray, window: int) -> np.ndarray:
    """The mean of the last `window` values at each place, of fewer at the beginning."""
    total = np.cumsum(np.insert(values, 0, 0.0))
    start = np.maximum(0, np.arange(1, len(values) + 1) - window)
    return (total[1:] - total[start]) / (np.arange(1, len(values) + 1) - start)


def draw_study(study: Any, names: Sequence[str], folder: Path) -> list[Path]:
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


def run_styles(runs: list[Path], labels: Sequence[str] | None = None) -> Iterator[tuple[Path, object, str]]:
    """(run, colour, label) of each; one colour for one label, which is the run's name by default."""
    names = [_plain(name) for name in labels or (run.name for run in runs)]
    different = list(dict.fromkeys(names))
    for run, name in zip(runs, names, strict=True):
        yield run, COLORS[different.index(name) % 10], name


def _plain(name: str) -> str:
    """A name as a legend shows it: matplotlib leaves out those with _ before them, and takes dollars for formulas."""
    return f" {name}".replace("$", r"\$") if name.startswith("_") else name.replace("$", r"\$")


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
    fence = np.inf if np.isclose(low, high, rtol=1e-9, atol=0) else FENCE * (high - low)
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
