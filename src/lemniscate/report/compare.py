"""Runs side by side, grouped by all but the seed: a table, remarks, and pictures.

What Agarwal et al. 2021, arXiv:2108.13264, ask of a comparison: intervals instead of points, the IQM, and the
probability of improvement. Nothing is ranked on one seed.
"""

from itertools import combinations
from pathlib import Path

import numpy as np

from lemniscate.envs.registry import file_name
from lemniscate.report import comparison_page
from lemniscate.report.comparison_plot import draw
from lemniscate.report.curves import plot_runs, training_minutes
from lemniscate.report.groups import Group, Scores
from lemniscate.report.html import Html
from lemniscate.report.seeds import bootstrap_interval, improvement_interval, iqm, probability_of_improvement
from lemniscate.report.style import COLORS
from lemniscate.run.directory import is_finished
from lemniscate.system.console import say

ONE_SEED = "One seed says nothing about which is better: train more with --seeds 1-5."
FEW_SEEDS = "Below five seeds of each, intervals are too narrow to be believed: train more with --seeds 1-5."
UNFINISHED = "Nothing is ranked before two seeds of each are finished: continue with lemniscate resume."


def report(groups: list[Group], scores: Scores, folder: Path, by: str = "step") -> list[Path]:
    """A table on standard error, pictures in `folder`, and a page with all of it; returns the files.

    Args:
        groups: in any environments; each has its own table and pictures.
        scores: final returns of the finished runs.
        folder: of the files.
        by: "step", "episode" or "minute", the horizontal axis of the learning curves.
    """
    files: list[Path] = []
    parts: list[Html] = []
    page = folder / "report.html"
    envs = list(dict.fromkeys(one.env for one in groups))
    for env in envs:
        same = [one for one in groups if one.env == env]
        cells, said = rows(same, scores), remarks(same, scores)
        for line in [f"{env}:", *table(cells), *said]:
            say(line)
        ending = ".png" if len(envs) == 1 else f"-{file_name(env)}.png"
        pictures = [draw(same, scores, folder / f"comparison{ending}", _why_unranked(same, scores))]
        runs = [run for one in same for run in one.runs]
        apart = len(same) == 1 and len(runs) <= len(COLORS)
        labels = [run.name if apart else one.label for one in same for run in one.runs]
        pictures += plot_runs(runs, folder, labels, ending, by)
        parts.append(comparison_page.part(page, same, scores, cells, said, pictures))
        files += pictures
    return [*files, comparison_page.write(page, envs, parts)]


def table(cells: list[list[str]]) -> list[str]:
    """The lines of the table whose `rows` are given, in columns."""
    first, *others = (max(map(len, column)) for column in zip(*cells, strict=True))
    return [
        "  ".join([row[0].ljust(first), *(cell.rjust(width) for cell, width in zip(row[1:], others, strict=True))])
        for row in cells
    ]


def rows(groups: list[Group], scores: Scores) -> list[list[str]]:
    """The cells of the table: a heading, and a row for each group."""
    highest = max((abs(score) for one in groups for score in one.finals(scores)), default=0)
    digits = 0 if highest >= 1000 else 1 if highest >= 100 else 2
    heading = ["", "seeds", "final return", "IQM [95 %]", "worst seed", "minutes"]
    return [heading, *([one.label, *_cells(one, scores, digits)] for one in groups)]


def _cells(one: Group, scores: Scores, digits: int) -> list[str]:
    finals = one.finals(scores)
    seeds = str(len(finals)) if len(finals) == len(one.runs) else f"{len(finals)} of {len(one.runs)}"
    if not finals:
        return [seeds, "–", "–", "–", "–"]
    mean, interval = f"{np.mean(finals):,.{digits}f}", "–"
    if len(finals) > 1:
        low, high = bootstrap_interval(finals)
        mean += f" ± {np.std(finals):,.{digits}f}"
        interval = f"{iqm(finals):,.{digits}f} [{low:,.{digits}f}, {high:,.{digits}f}]"
    minutes = np.median([training_minutes(run)[1][-1] for run in one.runs if run in scores])
    return [seeds, mean, interval, f"{min(finals):,.{digits}f}", f"{minutes:.1f}"]


def remarks(groups: list[Group], scores: Scores) -> list[str]:
    """Sentences on which is better, runs of unequal length, unfinished runs, and groups of few seeds."""
    said: list[str] = []
    lengths = {one.label: one.config["total_steps"] for one in groups}
    if len(set(lengths.values())) > 1:
        each = "; ".join(f"{label}: {steps:,}" for label, steps in lengths.items())
        said.append(f"They have not taken the same number of steps: {each}.")
    unfinished = [run for one in groups for run in one.runs if not is_finished(run)]
    if unfinished:
        said.append(f"Not finished, so in the curves alone: {', '.join(map(str, unfinished))}.")
    if unranked := _why_unranked(groups, scores):
        return [*said, unranked]
    said += [_improvement(*pair, scores) for pair in combinations(groups, 2)]
    few = len(groups) > 1 and min(len(one.finals(scores)) for one in groups) < 5
    return [*said, FEW_SEEDS] if few else said


def _improvement(one: Group, other: Group, scores: Scores) -> str:
    """The probability that the better of two groups is better, with its interval, as a sentence."""
    x, y = one.finals(scores), other.finals(scores)
    if probability_of_improvement(x, y) < 0.5:
        one, other, x, y = other, one, y, x
    low, high = improvement_interval(x, y)
    share = f"{probability_of_improvement(x, y):.0%} [95 %: {low:.0%} to {high:.0%}]"
    return f"{one.label} is better than {other.label} in {share} of the pairs of a seed of each."


def _why_unranked(groups: list[Group], scores: Scores) -> str | None:
    """A sentence on why nothing is ranked; None if every group has enough seeds."""
    if is_ranked(groups, scores):
        return None
    return ONE_SEED if any(len(one.runs) == 1 for one in groups) else UNFINISHED


def is_ranked(groups: list[Group], scores: Scores) -> bool:
    """Whether every group has final returns of two seeds at least."""
    return all(len(one.finals(scores)) > 1 for one in groups)
