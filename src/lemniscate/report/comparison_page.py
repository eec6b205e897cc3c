"""The page of a comparison, `plots/report.html`: the table, remarks, pictures, what differs, commands."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lemniscate.report import advice, commands, html
from lemniscate.report.groups import Group, Scores
from lemniscate.report.html import Html, element, section
from lemniscate.report.run_page import figures, footer, value_of
from lemniscate.run.directory import is_finished, read_config


def write(file: Path, envs: Sequence[str], parts: Sequence[Html]) -> Path:
    """Write the page from the parts of its environments."""
    title = f"Comparison on {', '.join(envs)}"
    return html.write_page(file, title, element("h1", title), element("p", str(file), class_="soft"), *parts, footer())


def part(
    page: Path,
    groups: Sequence[Group],
    scores: Scores,
    rows: Sequence[Sequence[str]],
    remarks: Sequence[str],
    pictures: Sequence[Path],
) -> Html:
    """The part of one environment.

    Args:
        page: that the part is for.
        groups: in that environment.
        scores: final returns of the finished runs.
        rows: the table of final returns, its heading first.
        remarks: sentences on what cannot be compared.
        pictures: of the comparison, embedded.
    """
    spread = [(one.label, advice.seeds_differ(one.finals(scores))) for one in groups]
    said = [*remarks, *(f"{label}: {sentence}" for label, sentence in spread if sentence)]
    return section(
        groups[0].env,
        html.table(rows[0], rows[1:]),
        html.bullets(said) if said else element("p"),
        *figures(pictures),
        *_differences(groups),
        element("h3", "Runs"),
        html.table(
            ("run", "seed", "final return", "state"), [_run(run, scores, page) for one in groups for run in one.runs]
        ),
        element("h3", "Do it again"),
        *(block for one in groups for block in (element("p", f"{one.label}:"), html.command(_command(one)))),
    )


def _differences(groups: Sequence[Group]) -> list[Html]:
    """The fields that are not the same in all groups."""
    kinds = [{"algorithm": one.algorithm, **one.config} for one in groups]
    names = [name for name in dict.fromkeys(name for kind in kinds for name in kind) if name != "seed"]
    differ = [name for name in names if any(kind.get(name) != kinds[0].get(name) for kind in kinds)]
    if not differ:
        return []
    rows = [(name, *(_cell(kind, name) for kind in kinds)) for name in differ]
    return [element("h3", "Settings that differ"), html.table(("field", *(one.label for one in groups)), rows)]


def _cell(kind: Mapping[str, Any], name: str) -> str:
    return value_of(kind[name]) if name in kind else "–"


def _run(run: Path, scores: Scores, page: Path) -> tuple[str, ...]:
    """The row of a run; its name leads to its own page, if there is one."""
    own = run / "plots" / "report.html"
    name = html.link(str(run), own, page) if own.exists() else str(run)
    final = f"{scores[run]:,.1f}" if run in scores else "–"
    return name, str(read_config(run)[1].get("seed")), final, "finished" if is_finished(run) else "not finished"


def _command(one: Group) -> str:
    seeds = ",".join(str(read_config(run)[1].get("seed")) for run in one.runs)
    return commands.train(one.algorithm, one.config, seeds=seeds)
