"""Runs grouped by all of their settings but the seed."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lemniscate.run.directory import read_config
from lemniscate.run.sweep_file import is_sweep

FIELDS = 3
"""the most fields that a label names, if they tell the groups apart"""

Scores = Mapping[Path, float]
"""final return of each run that is finished"""


@dataclass(frozen=True)
class Group:
    """Runs in one environment that differ in nothing but the seed."""

    label: str
    runs: list[Path]
    algorithm: str
    config: Mapping[str, Any]
    """of its first run"""

    @property
    def env(self) -> str:
        """The name of the environment."""
        return self.config["env"]

    def finals(self, scores: Scores) -> list[float]:
        """The final return of each seed that has one."""
        return [scores[run] for run in self.runs if run in scores]


def group(runs: Iterable[Path]) -> list[Group]:
    """Groups in the order of their first run. Runs alike even in their seed are distinguished by their directory."""
    found: dict[Path, dict[str, Any]] = {}
    for run in runs:
        algorithm, config = read_config(run)
        found[run] = {"algorithm": algorithm, **config}
    times = Counter(map(_key, found.values()))
    twins = {_key(kind, but="seed") for kind in found.values() if times[_key(kind)] > 1}
    for run, kind in found.items():
        if _key(kind, but="seed") in twins:
            kind["directory"] = str(run.parent if is_sweep(run.parent) else run)
    groups: dict[str, list[Path]] = {}
    for run, kind in found.items():
        groups.setdefault(_key(kind, but="seed"), []).append(run)
    kinds = [found[members[0]] for members in groups.values()]
    return [
        Group(_label(kind, kinds), members, *read_config(members[0]))
        for kind, members in zip(kinds, groups.values(), strict=True)
    ]


def _key(kind: dict[str, Any], but: str = "") -> str:
    return json.dumps({name: value for name, value in kind.items() if name != but}, sort_keys=True)


def _label(kind: dict[str, Any], kinds: list[dict[str, Any]]) -> str:
    """The algorithm; where it has several groups in one environment, also what tells this one from the others."""
    rivals = [other for other in kinds if all(other[name] == kind[name] for name in ("algorithm", "env"))]
    names = [name for name in dict.fromkeys(name for rival in rivals for name in rival) if name != "seed"]
    differ = [name for name in names if len({_word(rival.get(name)) for rival in rivals}) > 1]
    few = differ[:FIELDS]
    if len({tuple(_word(rival.get(name)) for name in few) for rival in rivals}) < len(rivals):
        few = differ
    more = [f"and {len(differ) - len(few)} more"] if len(differ) > len(few) else []
    return ", ".join([kind["algorithm"].upper(), *(f"{name} {_word(kind.get(name))}" for name in few), *more])


def _word(value: Any) -> str:
    if isinstance(value, list):
        return "×".join(map(str, value))
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
