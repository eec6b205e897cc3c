"""The page of a run, `plots/report.html`: curves, film, evaluation, settings, commands, what to try next."""

import math
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from lemniscate.errors import resume_line
from lemniscate.report import advice, commands, html
from lemniscate.report.curves import training_minutes
from lemniscate.report.film import newest_film
from lemniscate.report.html import Html, element, section
from lemniscate.run.directory import read_config
from lemniscate.run.metrics import read_metrics

CAPTIONS = {
    "learning_curve": "Return of each whole training episode, from a policy that explores",
    "diagnostics": "Metrics of the updates; triangles mark values beyond an axis",
    "q": "What Q predicts at the beginning of each episode, and the discounted return that followed",
    "flight": "The first flight of the evaluation over its reference",
    "error": "Distance to the reference over time",
    "comparison": "Returns in training, final returns, and probabilities of improvement",
}
"""what is below a picture, by the beginning of its name"""

NOT_MEASURES = ("env_id", "episodes", "mean_return", "std_return", "returns", "lengths", "terminated", "q_bias")
"""names in the JSON of an `Evaluation` that are not measures of the environment"""

PACKAGES = ("lemniscate", "torch", "numpy", "gymnasium")


def write(run: Path, pictures: Sequence[Path], scores: Mapping[str, Any] | None) -> Path:
    """Write the page of a run into its `plots/`.

    Args:
        run: the run directory.
        pictures: of the run; they are embedded.
        scores: of its newest policy, those of `Evaluation.to_json` and the `seed` of the starts, if there are any.
    """
    algorithm, config = read_config(run)
    log, file = read_metrics(run), run / "plots" / "report.html"
    said = advice.sentences(advice.Evidence(config, log, scores or {}))
    title = f"{algorithm.upper()} on {config.get('env')}"
    return html.write_page(
        file,
        title,
        element("h1", title),
        element("p", _subtitle(run, config, log), class_="soft"),
        html.cards(_headline(run, scores)),
        section("What to try next", html.bullets([*said, advice.ONE_SEED])),
        section("Training", *figures(pictures)),
        *_films(run, file),
        section("Final evaluation", *evaluation(scores)),
        section("Settings", *settings(algorithm, config)),
        section("Do it again", *_commands(run, algorithm, config)),
        footer(),
    )


def figures(pictures: Sequence[Path]) -> list[Html]:
    """Pictures, each with its caption."""
    return [html.picture(file, caption(file)) for file in pictures]


def caption(picture: Path) -> str:
    """The caption of a picture."""
    known = [text for name, text in CAPTIONS.items() if picture.stem.startswith(name)]
    return [picture.stem, *known][-1]


def footer() -> Html:
    """The date, and the versions of the packages, for the end of the page."""
    versions = []
    for package in PACKAGES:
        try:
            versions.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    machine = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return element("footer", f"Written on {date} by {', '.join(versions)}, {machine}.")


def evaluation(scores: Mapping[str, Any] | None) -> list[Html]:
    """The scores of an evaluation as a table, and its returns as bars."""
    if not scores or not scores.get("returns"):
        return [element("p", "The final policy has not been evaluated yet.", class_="soft")]
    returns = scores["returns"]
    alike = max(returns) - min(returns) < 1e-6 * (1 + abs(returns[0]))
    same, title = element("p", "Every episode had the same return."), "Returns of the episodes"
    table = html.table(("measure", "value"), score_rows(scores))
    return [table, same if alike else html.histogram(returns, title)]


def score_rows(scores: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The scores of an evaluation, each with its name in words."""
    returns, lengths = scores["returns"], scores["lengths"]
    return [
        ("return, mean ± standard deviation", f"{scores['mean_return']:,.1f} ± {scores['std_return']:,.1f}"),
        ("episodes, from starts that training never saw", f"{len(returns):,}, seed {scores.get('seed', 0)}"),
        ("worst, median, best return", ", ".join(f"{x:,.1f}" for x in np.percentile(returns, [0, 50, 100]))),
        ("length, mean", f"{np.mean(lengths):,.1f} steps"),
        ("terminated by the environment's rules", f"{scores['terminated']:,} of {len(returns):,}"),
        *((words(name), number(name, value)) for name, value in measures(scores).items()),
    ]


def measures(scores: Mapping[str, Any]) -> dict[str, float]:
    """The measures of the environment besides reward."""
    numbers = {name: value for name, value in scores.items() if name not in (*NOT_MEASURES, "step", "seed")}
    return {name: value for name, value in numbers.items() if isinstance(value, int | float) and math.isfinite(value)}


def words(name: str) -> str:
    """The name of a measure in words; the ending `_mm` is its unit."""
    return name.removesuffix("_mm").replace("_", " ")


def number(name: str, value: float) -> str:
    """The value of a measure, with its unit."""
    return f"{value:.4g}{' mm' * name.endswith('_mm')}"


def settings(algorithm: str, config: Mapping[str, Any]) -> list[Html]:
    """The fields that differ from their defaults, marked; the others folded away."""
    defaults, changed = commands.default_fields(algorithm), commands.changed_fields(algorithm, config)
    rows = [(name, element("mark", value_of(value)), value_of(defaults.get(name))) for name, value in changed.items()]
    others = [(name, value_of(value)) for name, value in config.items() if name not in changed]
    folded = element("summary", f"{len(others)} fields at their defaults")
    return [
        html.table(("field", "this run", "default"), rows),
        element("details", folded, html.table(("field", "value"), others)),
    ]


def value_of(value: Any) -> str:
    """The value of a field, as a person would write it."""
    if isinstance(value, list):
        return " ".join(map(value_of, value)) or "none"
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, int):
        return f"{value:,}"
    return "none" if value in (None, "", {}) else str(value)


def _subtitle(run: Path, config: Mapping[str, Any], log: Sequence[Mapping[str, Any]]) -> str:
    taken, total = (log[-1]["step"] if log else 0), config.get("total_steps", 0)
    progress = f"{taken:,} steps" if taken >= total else f"{taken:,} of {total:,} steps"
    return f"{run} · seed {config.get('seed')} · {progress}"


def _headline(run: Path, scores: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """The few numbers at the top."""
    minutes = training_minutes(run)[1][-1]
    spent = ("minutes of training", f"{minutes:,.1f}")
    if not scores or "mean_return" not in scores:
        return [spent]
    means = ("final return, mean ± std", f"{scores['mean_return']:,.1f} ± {scores['std_return']:,.1f}")
    worst = ("worst episode", f"{min(scores['returns']):,.1f}")
    measured = [(words(name), number(name, value)) for name, value in measures(scores).items() if name.endswith("_mm")]
    return [means, worst, *measured, spent]


def _films(run: Path, page: Path) -> list[Html]:
    """The newest film of a run, if it has any."""
    film = newest_film(run)
    return [section("Film", html.film(film, page))] if film else []


def _commands(run: Path, algorithm: str, config: Mapping[str, Any]) -> list[Html]:
    lines = {
        "Train it again; with the same versions on the same kind of machine the result is the same": commands.train(
            algorithm, config
        ),
        "Continue it where it was interrupted": resume_line(run),
        "Evaluate its newest policy from other starts": commands.evaluate(run, 100, 1),
    }
    return [part for title, line in lines.items() for part in (element("p", f"{title}:"), html.command(line))]
