"""What is written about a run: its page, the page of a comparison, its card on the Hub, and its scores in a sentence.

A page is one file, `plots/report.html`: no script, nothing from a network, for light and dark, wide and narrow. The
templates stand in `templates/`; Jinja escapes whatever is put into a page, so nothing in a run's files becomes markup.
"""

import json
import math
import os
import platform
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from lemniscate import algos
from lemniscate.doctor import Diagnosis
from lemniscate.doctor.rules import seeds_differ
from lemniscate.errors import UserError, resume_line
from lemniscate.report import curves
from lemniscate.report.playback import VIDEOS, embedded
from lemniscate.report.seeds import Group, Scores, differing, written
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import is_finished, read_config
from lemniscate.run.evaluate import Evaluation, QBias
from lemniscate.run.fields import flag
from lemniscate.run.metrics import read_metrics
from lemniscate.system.files import filled, replace_file

MOST_BYTES = 5_000_000
"""the largest video that is embedded; a larger one is linked"""

NOT_MEASURES = {field.name for field in fields(Evaluation)} | {"step", "seed"}
"""names among scores that are not measures of the environment"""

Evaluated = Mapping[str, Any]
"""what `Evaluation.to_json` returns; of a run's policy also its `step`, and the `seed` of the starts"""

TEMPLATES = Path(__file__).parent / "templates"

FILTERS = {"embedded": embedded}
"""the functions that templates call"""

TASK = "reinforcement-learning"
"""the name of the field on the Hub"""


def write_run(run: Path, pictures: Sequence[Path], scores: Evaluated | None, found: Sequence[Diagnosis]) -> Path:
    """Write the page of a run: curves, video, evaluation, settings, commands, and what the doctor has found."""
    algorithm, config = read_config(run)
    log = read_metrics(run)
    taken, total = (log[-1]["step"] if log else 0), config.get("total_steps", 0)
    progress = f"{taken:,} steps" if taken >= total else f"{taken:,} of {total:,} steps"
    changed = changed_fields(algorithm, config)
    evaluate = shlex.join(["lemniscate", "evaluate", str(run), "--episodes", "100", "--seed", "1"])
    return write_page(
        run / "plots" / "report.html",
        "run.html.j2",
        title=f"{algorithm.upper()} on {config.get('env')}",
        subtitle=f"{run} · seed {config.get('seed')} · {progress}",
        minutes=curves.training_minutes(run)[1][-1],
        found=found,
        pictures=pictures,
        video=newest_video(run),
        scores=scores,
        rows=score_rows(scores) if scores else [],
        histogram=_histogram(scores["returns"]) if scores else None,
        changed=[(name, *map(_shown, values)) for name, values in changed.items()],
        unchanged=[(name, _shown(value)) for name, value in config.items() if name not in changed],
        commands=(train_command(algorithm, config), resume_line(run), evaluate),
    )


def write_evaluation(
    folder: Path, name: str, pictures: Sequence[Path], scores: Evaluation, seed: int, since: float
) -> Path:
    """Write the page of an evaluation of the policy `name`, which need not be of a run: video, scores, pictures.

    A video from before the time `since` is of another evaluation.
    """
    return write_page(
        folder / "plots" / "report.html",
        "evaluation.html.j2",
        title=f"{name} in {scores.env_id}",
        subtitle=f"{scores.episodes:,} episodes · seed {seed}",
        pictures=pictures,
        video=newest_video(folder, since),
        rows=score_rows({**scores.to_json(), "seed": seed}),
        histogram=_histogram(scores.returns),
    )


def newest_video(run: Path, since: float = 0.0) -> Path | None:
    """The newest video of a run, if it has any from that time on."""
    found = (file for file in (run / "videos").glob("*") if file.suffix in VIDEOS)
    videos = [file for file in found if not file.stem.endswith(".tmp")]  # which is being written
    # Not a link, which could lead to any file of this machine, and what is found is embedded and uploaded.
    own = [file for file in videos if file.is_file() and not file.is_symlink() and file.stat().st_mtime >= since]
    return max(own, key=lambda file: file.stat().st_mtime, default=None)


def _histogram(returns: Sequence[float]) -> dict[str, Any] | None:
    """Bars of how many returns lie where, the highest 40; None if all are alike."""
    if max(returns) - min(returns) < 1e-6 * (1 + abs(returns[0])):
        return None
    counts, edges = np.histogram(returns, bins=min(24, max(6, len(returns) // 4)))
    return {"heights": 40 * counts / max(counts), "least": edges[0], "greatest": edges[-1]}


def write_comparison(page: Path, parts: Sequence[Mapping[str, Any]]) -> Path:
    """Write the page of a comparison from what `comparison_part` returned for each environment."""
    title = f"Comparison on {', '.join(part['env'] for part in parts)}"
    return write_page(page, "comparison.html.j2", title=title, subtitle=str(page), parts=parts)


def _shown(value: Any) -> str:
    return written(value, " ")


def comparison_part(
    page: Path,
    groups: Sequence[Group],
    scores: Scores,
    rows: Sequence[Sequence[str]],
    remarks: Sequence[str],
    pictures: Sequence[Path],
) -> dict[str, Any]:
    """The part of one environment: the table with its heading, remarks, pictures, settings that differ, runs, commands.

    Links in it lead from the `page` that it is for.
    """
    spread = [(one.label, seeds_differ(one.finals(scores))) for one in groups]
    kinds = [{"algorithm": one.algorithm, **one.config} for one in groups]
    seeds = {run: str(read_config(run)[1].get("seed")) for one in groups for run in one.runs}
    return {
        "env": groups[0].env,
        "labels": [one.label for one in groups],
        "rows": rows,
        "remarks": [*remarks, *(f"{label}: {sentence}" for label, sentence in spread if sentence)],
        "pictures": pictures,
        "differences": [
            [name, *(_shown(kind[name]) if name in kind else "–" for kind in kinds)] for name in differing(kinds)
        ],
        "runs": [
            {
                "path": run,
                "page": _from(page, run / "plots" / "report.html"),
                "seed": seed,
                "final": f"{scores[run]:,.1f}" if run in scores else "–",
                "state": "finished" if is_finished(run) else "not finished",
            }
            for run, seed in seeds.items()
        ],
        "commands": {
            one.label: train_command(one.algorithm, one.config, seeds=",".join(seeds[run] for run in one.runs))
            for one in groups
        },
    }


def _from(page: Path, file: Path) -> str:
    """The path from a page to a file, which holds as long as both are moved together; none where it is not there."""
    try:
        return Path(os.path.relpath(file, page.parent)).as_posix() if file.exists() else ""
    except ValueError:  # Windows has no path from one drive to another
        return file.resolve().as_uri()


def write_card(
    folder: Path,
    name: str,
    algorithm: str,
    config: RunConfig,
    *,
    step: int,
    scores: Evaluated | None,
    license: str | None,
    code: Sequence[str],
) -> None:
    """Write the card of the repository user/`name` on the Hugging Face Hub into the `folder` of its files.

    It shows the files that are there, and the `scores` if the policy at `step` could be evaluated. A `license` is
    written as the Hub abbreviates it, such as "mit"; `code` are the names of what the policy needs besides lemniscate.
    """
    text = filled(
        TEMPLATES / "card.md.j2",
        FILTERS,
        metadata=_metadata(name, algorithm, config, scores, license),
        name=name,
        algorithm=algorithm,
        config=config,
        step=step,
        scores=score_rows(scores) if scores else [],
        code=code,
        command=train_command(algorithm, config.to_json()),
        files=[file.relative_to(folder) for file in sorted(folder.rglob("*")) if file.is_file()],
    )
    (folder / "README.md").write_text(text, encoding="utf-8")


def _metadata(name: str, algorithm: str, config: RunConfig, scores: Evaluated | None, license: str | None) -> str:
    """The front matter in YAML, by which the Hub lists a policy: library, tags, and the scores as a `model-index`.

    In the words of the Hub the return of an episode is its reward.
    """
    from huggingface_hub import EvalResult, ModelCardData

    results = None
    if scores:
        result = EvalResult(
            task_type=TASK,
            task_name=TASK,
            dataset_type=config.env,
            dataset_name=config.env,
            metric_type="mean_reward",
            metric_name="mean_reward",
            metric_value=f"{scores['mean_return']:.2f} +/- {scores['std_return']:.2f}",
            metric_args={"episodes": scores["episodes"], "seed": scores["seed"], "training_seeds": [config.seed]},
        )
        results = [result]
    data = ModelCardData(
        library_name="lemniscate",
        pipeline_tag=TASK,
        license=license,
        tags=[TASK, "lemniscate", config.env, algorithm],
        model_name=name,
        eval_results=results,
    )
    return data.to_yaml()


def sentence(scores: Evaluated) -> str:
    """The scores of an evaluation in one sentence, or two."""
    mean, std = scores["mean_return"], scores["std_return"]
    said = f"{mean:.1f} ± {std:.1f} return over {scores['episodes']} episodes of {scores['env_id']}"
    if measures := _measures(scores):
        said += f", {scores['terminated']} of them terminated; {', '.join(map(' '.join, measures))}"
    return f"{said}.\n{q_bias(scores)}." if "q_bias" in scores else f"{said}."


def score_rows(scores: Evaluated) -> list[tuple[str, str]]:
    """The scores of an evaluation, each with its name in words."""
    returns, lengths = scores["returns"], scores["lengths"]
    return [
        ("return, mean ± standard deviation", f"{scores['mean_return']:,.1f} ± {scores['std_return']:,.1f}"),
        ("episodes, from starts that training never saw", f"{len(returns):,}, seed {scores.get('seed', 0)}"),
        ("worst, median, best return", ", ".join(f"{x:,.1f}" for x in np.percentile(returns, [0, 50, 100]))),
        ("length, mean", f"{np.mean(lengths):,.1f} steps"),
        ("terminated by the environment's rules", f"{scores['terminated']:,} of {len(returns):,}"),
        *_measures(scores),
    ]


def _measures(scores: Evaluated) -> list[tuple[str, str]]:
    """(name in words, value) of what the environment measures besides reward; the ending `_mm` is a unit."""
    return [
        (name.removesuffix("_mm").replace("_", " "), f"{value:.4g}{' mm' * name.endswith('_mm')}")
        for name, value in scores.items()
        if not (name in NOT_MEASURES or name.startswith("info/"))
        and isinstance(value, int | float)
        and math.isfinite(value)
    ]


def q_bias(scores: Evaluated) -> QBias:
    """The bias of Q in the scores of an evaluation that has one."""
    return QBias(scores["q_bias"]["predicted"], scores["q_bias"]["realised"])


def changed_fields(algorithm: str, config: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """The fields of a run that are not at their defaults: (value, default); all, if there is no such algorithm."""
    try:
        defaults = algos.find(algorithm).Config().to_json()
    except UserError:
        defaults = {}
    return {
        name: (value, defaults.get(name))
        for name, value in config.items()
        if name not in defaults or defaults[name] != value
    }


def train_command(algorithm: str, config: Mapping[str, Any], *, seeds: str | None = None) -> str:
    """The command line that trains a run of this Config; with `seeds`, such as "1,2,3", a sweep of it."""
    # The preset is named because the one that fits the environment best may change between versions.
    words = ["lemniscate", "train", algorithm, "--preset", "default", "--env", str(config.get("env"))]
    changed = [name for name in changed_fields(algorithm, config) if name not in ("env", "seed")]
    words += ["--seeds", seeds] if seeds else ["--seed", str(config.get("seed"))]
    for name in dict.fromkeys(["total_steps", *changed]):
        words += _option(name, config.get(name))
    return shlex.join(words)


def _option(name: str, value: Any) -> list[str]:
    """The words of one field on the command line."""
    if isinstance(value, bool):
        return [flag(name) if value else flag(name).replace("--", "--no-", 1)]
    if isinstance(value, list):
        return [flag(name), *map(str, value or ["[]"])]
    if isinstance(value, dict):
        return [flag(name), json.dumps(value)]
    return [flag(name), "none" if value is None else str(value)]


def write_page(file: Path, template: str, **context: Any) -> Path:
    """Fill a template, and say at its end by which versions that was done."""
    versions = [f"{package} {version(package)}" for package in ("torch", "numpy", "gymnasium")]
    machine = f"Python {platform.python_version()} on {platform.system()} {platform.machine()}"
    date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    written_on = f"Written on {date} by lemniscate {version('lemniscate')}, {', '.join(versions)}, {machine}."
    page = filled(TEMPLATES / template, FILTERS, written=written_on, embedded_bytes=MOST_BYTES, **context)
    file.parent.mkdir(parents=True, exist_ok=True)
    replace_file(file, page.encode("utf-8", errors="xmlcharrefreplace"))
    return file
