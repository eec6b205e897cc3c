"""The model card of a policy on the Hugging Face Hub: what its page shows, and what the Hub lists it by."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lemniscate.algos import ALGORITHMS
from lemniscate.hub.repository import own_code
from lemniscate.report import commands, run_page
from lemniscate.run.config import RunConfig

CARD = "README.md"
TASK = "reinforcement-learning"
"""the name of the field on the Hub"""


def write(
    folder: Path,
    name: str,
    algorithm: str,
    config: RunConfig,
    *,
    step: int,
    scores: Mapping[str, Any] | None,
    license: str | None,
) -> None:
    """Write the card of a repository beside its files; it shows the pictures and the film that are there.

    Args:
        folder: the repository's files.
        name: user/name of the repository.
        algorithm: by name.
        config: of the run.
        step: of the policy.
        scores: those of `Evaluation.to_json` and the `seed` of the starts, if there are any.
        license: as the Hub abbreviates it, such as "mit"; none is named without.
    """
    sections = [
        f"# {algorithm.upper()} on {config.env}",
        _introduction(algorithm, config, step),
        *_film(folder),
        *_scores(scores),
        _use(name, algorithm, config),
        _training(algorithm, config),
        *_figures(folder),
        *_export(folder),
    ]
    text = "\n\n".join([_metadata(name, algorithm, config, scores, license), *sections])
    (folder / CARD).write_text(f"{text}\n", encoding="utf-8")


def _metadata(
    name: str, algorithm: str, config: RunConfig, scores: Mapping[str, Any] | None, license: str | None
) -> str:
    """The front matter in YAML, by which the Hub lists a policy: library, tags, and the scores as a `model-index`."""
    from huggingface_hub import ModelCardData

    data = ModelCardData(
        library_name="lemniscate",
        pipeline_tag=TASK,
        license=license,
        tags=[TASK, "lemniscate", config.env, algorithm],
        model_name=name,
        eval_results=[_result(config, scores)] if scores else None,
    )
    return f"---\n{data.to_yaml()}\n---"


def _result(config: RunConfig, scores: Mapping[str, Any]) -> Any:
    """The scores in the words of the Hub, where the return of an episode is its reward."""
    from huggingface_hub import EvalResult

    return EvalResult(
        task_type=TASK,
        task_name=TASK,
        dataset_type=config.env,
        dataset_name=config.env,
        metric_type="mean_reward",
        metric_name="mean_reward",
        metric_value=f"{scores['mean_return']:.2f} +/- {scores['std_return']:.2f}",
        metric_args={"episodes": scores["episodes"], "seed": scores["seed"], "training_seeds": [config.seed]},
    )


def _introduction(algorithm: str, config: RunConfig, step: int) -> str:
    return (
        f"A policy of lemniscate for {config.env}, trained by {algorithm.upper()} for {step:,} environment steps with"
        f" seed {config.seed}."
    )


def _film(folder: Path) -> list[str]:
    shown = [f"![An episode]({_link(file, folder)})" for file in sorted((folder / "videos").glob("*"))]
    return [*shown, *(["[Film](replay.mp4)"] if (folder / "replay.mp4").exists() else [])]


def _scores(scores: Mapping[str, Any] | None) -> list[str]:
    rows = [f"| {name} | {value} |" for name, value in run_page.score_rows(scores)] if scores else []
    return ["## Scores", "\n".join(["| measure | value |", "|---|---|", *rows])] if rows else []


def _use(name: str, algorithm: str, config: RunConfig) -> str:
    code = [*([] if algorithm in ALGORITHMS else [algorithm]), *own_code(config.to_json())]
    own = f"\n\nIt needs code that is not in this repository, and is loaded with `trust=True`: {', '.join(code)}."
    return f"""## Use it

```python
import lemniscate as lem

policy = lem.load("hf://{name}")
```

```
lemniscate evaluate hf://{name}
```

The files are raw tensors and JSON. Their sha256 is checked, and nothing in them is executed.{own if code else ""}"""


def _training(algorithm: str, config: RunConfig) -> str:
    return f"## Train it again\n\n```\n{commands.train(algorithm, config.to_json())}\n```"


def _figures(folder: Path) -> list[str]:
    pictures = sorted((folder / "plots").glob("*.png"))
    shown = [f"![{run_page.caption(file)}]({_link(file, folder)})" for file in pictures]
    return ["## Figures", *shown] if shown else []


def _export(folder: Path) -> list[str]:
    files = sorted(file for file in (folder / "export").rglob("*") if file.is_file())
    listed = "\n".join(f"- [{file.name}]({_link(file, folder)})" for file in files)
    return ["## Outside of Python", listed] if files else []


def _link(file: Path, folder: Path) -> str:
    return quote(file.relative_to(folder).as_posix())
