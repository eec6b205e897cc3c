"""Runs that differ in their seed alone, and statistics over seeds: Agarwal et al. 2021, arXiv:2108.13264.

Intervals are percentile bootstraps (section 4.1): seeds are drawn again with replacement, of each group on its own.
The random generator has a fixed seed, so the same scores give the same intervals.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lemniscate.run.directory import read_config
from lemniscate.run.places import is_sweep

RESAMPLES = 10_000

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


def differing(kinds: Sequence[Mapping[str, Any]]) -> list[str]:
    """The names of the fields in which Configs differ, besides the seed."""
    names = dict.fromkeys(name for kind in kinds for name in kind if name != "seed")
    return [name for name in names if any(kind.get(name) != kinds[0].get(name) for kind in kinds)]


def _label(kind: dict[str, Any], kinds: list[dict[str, Any]]) -> str:
    """The algorithm; where it has several groups in one environment, also what tells this one from the others."""
    rivals = [other for other in kinds if all(other[name] == kind[name] for name in ("algorithm", "env"))]
    differ = differing(rivals)
    few = differ[:FIELDS]
    if len({tuple(written(rival.get(name)) for name in few) for rival in rivals}) < len(rivals):
        few = differ
    more = [f"and {len(differ) - len(few)} more"] if len(differ) > len(few) else []
    return ", ".join([kind["algorithm"].upper(), *(f"{name} {written(kind.get(name))}" for name in few), *more])


def written(value: Any, between: str = "×") -> str:
    """The value of a field, as a person would write it; `between` stands between several."""
    if isinstance(value, list):
        return between.join(written(one) for one in value) or "none"
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, int | float):
        return f"{value:,}" if isinstance(value, int) else f"{value:.12g}"
    return "none" if value in (None, "", {}) else str(value)


def iqm(scores: ArrayLike) -> np.ndarray:
    """Interquartile mean of [..., n]: that of the middle half, cut points weighted by the part of them inside."""
    ordered = np.sort(np.asarray(scores, dtype=np.float64), axis=-1)
    n = ordered.shape[-1]
    rank = np.arange(n)
    weight = np.clip(np.minimum(rank + 1, 0.75 * n) - np.maximum(rank, 0.25 * n), 0, None)
    return ordered @ (weight / weight.sum())


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> np.ndarray:
    """P(X > Y): the share of pairs, a run of x [..., n] and one of y [..., m], in which x is higher; a tie is half.

    1/(nm) Σᵢ Σⱼ S(xᵢ, yⱼ) with S = 1, ½, 0 for more, equal, less: the paper's probability of improvement on one task,
    which is the U statistic of Mann and Whitney 1947 over nm.
    """
    difference = np.asarray(x, dtype=np.float64)[..., :, None] - np.asarray(y, dtype=np.float64)[..., None, :]
    return (1 + np.sign(difference).mean(axis=(-2, -1))) / 2


def interval(statistic: Callable[..., Any], *groups: ArrayLike, resamples: int = RESAMPLES) -> np.ndarray:
    """95 % interval of a statistic of one group [seeds, …] or several, over resampled seeds of each: [2, …].

    The `statistic` takes an array [resamples, seeds, …] for each group, and returns [resamples, …].
    """
    rng = np.random.default_rng(0)
    scores = [np.asarray(one, dtype=np.float64) for one in groups]
    drawn = [rng.choice(one, (resamples, len(one))) for one in scores]
    return np.quantile(statistic(*drawn), [0.025, 0.975], axis=0)
