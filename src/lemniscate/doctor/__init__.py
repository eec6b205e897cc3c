"""The doctor: what is wrong with a run, in words. `rules` is a table of faults; `evidence` is what they look at."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from lemniscate.doctor.evidence import Evidence, usual_ranges, with_ratios
from lemniscate.doctor.rules import (
    CAUSES,
    CERTAIN,
    HINT,
    KINDS,
    LIKELY,
    RULES,
    Rule,
    findings,
    settings_far_out,
    without_consequences,
)
from lemniscate.run.config import RunConfig
from lemniscate.run.fields import field_help
from lemniscate.run.metrics import read_metrics
from lemniscate.system.console import say

PAGE = "docs/doctor.md"


@dataclass(frozen=True)
class Diagnosis:
    """A finding about a run.

    Attributes:
        name: of the fault, its anchor in `docs/doctor.md`.
        sure: "certain", "likely" or "possible"; a "hint" is no fault, but what to do next.
        seen: what was seen, with numbers.
        means: what it means.
        remedy: what to change.
        source: where that is known from.
        metric: what is drawn beside it, with its `steps` and `values`.
    """

    name: str
    sure: str
    seen: str
    means: str
    remedy: str
    source: str
    metric: str
    steps: list[int]
    values: list[float]

    def __str__(self) -> str:
        return self.listed(112)

    def listed(self, width: int) -> str:
        """The finding in a few lines, wrapped at `width` columns."""
        said = f"{self.seen} {self.means}", f"→ {self.remedy}.", f"{self.sure}; {PAGE}#{self.name}; {self.source}"
        lines = [line for part in said for line in wrap(part, width - 2, break_long_words=False)]
        return "\n  ".join(lines)


def diagnose(evidence: Evidence) -> list[Diagnosis]:
    """The findings of all rules, causes first: beside a cause that is certain or likely no symptom is named."""
    both = without_consequences([*findings(evidence), *settings_far_out(evidence)])
    found = sorted(both, key=lambda each: KINDS.index(each[0].kind))
    caused = any(rule.kind in CAUSES and rule.sure in (CERTAIN, LIKELY) for rule, _ in found)
    faulty = any(rule.sure != HINT for rule, _ in found)
    return [
        _diagnosis(evidence, rule, seen)
        for rule, seen in found
        if not (caused and rule.kind == "symptom") and not (faulty and rule.name == "does-not-learn")
    ]


def _diagnosis(evidence: Evidence, rule: Rule, seen: str) -> Diagnosis:
    lines = [line for line in evidence.log if rule.metric in line]
    chosen = [lines[i] for i in np.linspace(0, len(lines) - 1, min(100, len(lines))).astype(int)]
    steps, values = [line["step"] for line in chosen], [line[rule.metric] for line in chosen]
    remedy = rule.remedy_for(evidence.config)
    return Diagnosis(rule.name, rule.sure, seen, rule.means, remedy, rule.source, rule.metric, steps, values)


IN_PLAY = {rule.name for rule in RULES if rule.kind == "environment"} | {"action-by-sign"}
IN_PLAY -= {"seed-ignored", "reward-zero", "reward-large", "no-episode"}
"""faults that random play shows and that the check of an environment has no sentence for"""


def random_play_faults(looks: Sequence[Mapping[str, float]]) -> list[str]:
    """A text for each fault of an environment that the signals of some looks at random play show."""
    lines = [{"step": i, **look} for i, look in enumerate(looks)]
    found = findings(Evidence({}, {}, {}, {}, lines, {}))
    return [f"{seen} {rule.means} {rule.remedy_for({})}." for rule, seen in found if rule.name in IN_PLAY]


class Attendance:
    """Says, while a run is trained, what is certainly wrong with it: a line for each finding, once.

    It is called with the step and the metrics of each line that has signals; `was_paid` is set where an episode's
    return was not 0.
    """

    def __init__(self, config: RunConfig) -> None:
        self._config = config.to_json()
        self._looks = list[dict[str, Any]]()
        self._said, self.was_paid = set[str](), False

    def __call__(self, step: int, metrics: Mapping[str, float]) -> None:
        """Speak of what the lines so far show; three of them are too few."""
        self._looks.append({"step": step, **metrics})
        if len(self._looks) <= 3:
            return
        for rule, seen in findings(Evidence(self._config, {}, {}, {}, self._looks, {})):
            untrue = self.was_paid and rule.name == "reward-zero"  # of the newest steps, which is all that is seen here
            if rule.sure == CERTAIN and rule.name not in self._said and not untrue:
                self._said.add(rule.name)
                say(f"{seen} {rule.means} {rule.remedy_for(self._config)}.")


def evidence_of(
    run: Path,
    config: RunConfig,
    recommended: Sequence[RunConfig],
    scores: Mapping[str, Any],
    repeats: bool | None,
    varies: bool | None,
) -> Evidence:
    """The evidence on the run in a directory.

    Args:
        run: the directory.
        config: its settings.
        recommended: the Configs that are known to learn its environment, the default last. Of these the one that is
            nearest to the run's is what it is compared with.
        scores: of its final evaluation; empty where there is none.
        repeats: whether its environment begins alike from one seed; None where that was not tried.
        varies: whether it begins otherwise from another one; None as well.
    """
    given = with_ratios(config.to_json())
    known = [with_ratios(one.to_json()) for one in recommended]
    nearest = min(known, key=lambda one: sum(one[name] != value for name, value in given.items()))
    tried = {name: {str(one[name]) for one in (nearest, known[-1])} for name in nearest}
    usual = usual_ranges(field_help(type(config)))
    return Evidence(given, nearest, tried, usual, read_metrics(run), scores, repeats, varies)
