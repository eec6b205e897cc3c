"""The evidence on a run: its settings beside the recommended ones, its lines of metrics, its final scores."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lemniscate.run.fields import number

HORIZONS = ("gamma", "gae_lambda", "td_lambda")
"""fields whose size is that of 1 / (1 − x)"""


@dataclass(frozen=True)
class Evidence:
    """The input of the rules.

    Attributes:
        config: the fields of the run's Config.
        recommended: those of the nearest preset for its environment, or of the algorithm's defaults.
        tried: for each field the values, as texts, of that preset and of the defaults.
        usual: the usual range of each field that has one, from its help.
        log: the lines of its metrics.
        scores: of its final evaluation; empty where there is none.
        repeats: whether its environment begins alike from one seed; None where that was not tried.
        varies: whether it begins otherwise from another seed; None where that was not tried.
    """

    config: Mapping[str, Any]
    recommended: Mapping[str, Any]
    tried: Mapping[str, set[str]]
    usual: Mapping[str, tuple[float, float]]
    log: Sequence[Mapping[str, Any]]
    scores: Mapping[str, Any]
    repeats: bool | None = None
    varies: bool | None = None

    @cached_property
    def returns(self) -> np.ndarray:
        """The return of every whole training episode, in order: [episodes]."""
        return np.array([ret for line in self.log for ret in line.get("episode/returns", [])], dtype=np.float64)

    @cached_property
    def lengths(self) -> np.ndarray:
        """The length of every whole training episode, in order: [episodes]."""
        return np.array([n for line in self.log for n in line.get("episode/lengths", [])], dtype=np.float64)

    def values(self, name: str) -> np.ndarray:
        """A metric of every line that has it, in order."""
        return np.array([line[name] for line in self.log if name in line], dtype=np.float64)

    def last_half(self, name: str) -> np.ndarray:
        """A metric in the last half of the lines that have it, in order."""
        values = self.values(name)
        return values[len(values) // 2 :]

    def late(self, name: str) -> float:
        """The median of a metric in the last half of its lines; NaN, of which no rule speaks, if there is none."""
        return float(np.median(half)) if len(half := self.last_half(name)) else np.nan

    def median(self, name: str, least: int = 3) -> float:
        """The median of a metric; NaN if fewer than `least` lines have it."""
        return float(np.median(values)) if len(values := self.values(name)) >= least else np.nan

    def last(self, name: str) -> float:
        """The last value of a metric; NaN if there is none."""
        return float(next(iter(self.values(name)[::-1]), np.nan))

    def early(self, name: str) -> float:
        """The first value of a metric; NaN if there is none."""
        return float(next(iter(self.values(name)), np.nan))

    def greatest(self, name: str) -> float:
        """The greatest value of a metric; NaN if there is none."""
        return float(self.values(name).max(initial=-np.inf)) if len(self.values(name)) else np.nan

    @property
    def sees_nothing(self) -> bool:
        """Whether no number of the observation ever changes."""
        return self.late("observation/constant") == 1

    @property
    def returns_alike(self) -> bool:
        """Whether all episodes have the same return, of ten or more."""
        return len(self.returns) >= 10 and bool(np.ptp(self.returns) <= 1e-6 * (1 + abs(self.returns[0])))

    @property
    def is_slow(self) -> bool:
        """Whether no number of the observation moves by a twentieth of its standard deviation in a step."""
        pace = self.values("observation/pace")
        return len(pace) >= 3 and bool(np.median(pace) < 0.05)

    @property
    def spread_left(self) -> float:
        """The share of its spread that a policy kept in the first half of the run, where it collapsed; else NaN.

        That is to a tenth in a quarter of the run, or to a hundredth in half of it, without a rise of the returns. SAC
        and REPPO choose their entropy.
        """
        std = self.values("policy_std")
        spread = std if len(std) else self.values("losses/entropy")
        chosen = {"initial_temperature", "min_temperature"} & set(self.config)
        if len(spread) < 8 or spread[0] <= 0 or self.gain > 10 or chosen:
            return np.nan
        quarter, half = spread[[len(spread) // 4, len(spread) // 2]] / spread[0]
        return max(0.0, min(quarter, half)) if quarter < 0.1 or half < 0.01 else np.nan

    @property
    def is_settled(self) -> bool:
        """Whether the last fifth of the returns hardly vary, so that there is nothing left to explain."""
        last = self.ends[1]
        return len(last) > 0 and bool(last.std() <= 0.05 * abs(last.mean()))

    @property
    def is_paid(self) -> bool:
        """Whether what is seen explains rewards, or they are always the same."""
        return self.late("reward/explained") > 0.1 or self.late("reward/std") == 0

    @property
    def begins(self) -> bool:
        """Whether Q has hardly begun: it comes slowly, and the first policies are worse than chance."""
        greedy = "final_epsilon" in self.config and self.q_steps < 5_000
        return greedy or ("tau" in self.config and bool(self.log) and self.log[-1]["step"] < 20_000)

    @property
    def q_steps(self) -> float:
        """The gradient steps that Q(s, a) has had, from replay or from epochs of rollouts."""
        known = self.config
        of_epochs = known["epochs"] / known["minibatch_size"] if {"epochs", "minibatch_size"} <= set(known) else 0.0
        learned = self.log[-1]["step"] - known.get("learning_starts", 0) if self.log else 0
        return known.get("replay_ratio", of_epochs) * max(0, learned)

    @cached_property
    def rose(self) -> bool:
        """Whether the last fifth of the episodes is better than the first: by three standard errors, and by 0.3 std."""
        first, last = self.ends
        return self.gain > 3 and bool(last.mean() - first.mean() > 0.3 * np.hypot(first.std(), last.std()))

    @cached_property
    def gain(self) -> float:
        """The difference between the last fifth of the episodes and the first, in standard errors; 0 for under ten."""
        first, last = self.ends
        if len(last) < 2:
            return 0.0
        error = np.hypot(first.std(), last.std()) / np.sqrt(len(last))
        return float((last.mean() - first.mean()) / max(error, 1e-9))

    @cached_property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """The returns of the first and of the last fifth of the episodes."""
        fifth = len(self.returns) // 5
        return self.returns[:fifth], self.returns[len(self.returns) - fifth :]

    def as_recommended(self, field: str) -> bool:
        """Whether a field has the value that it has in the nearest preset or by default."""
        return str(self.config.get(field)) in self.tried.get(field, ())

    def beyond(self, field: str, low: float, high: float) -> float:
        """The factor by which a field is outside its usual range, negative below it; 0 inside, or as recommended."""
        value, last = first_number(self.config.get(field)), last_number(self.config.get(field))
        if value is None or last is None or self.as_recommended(field):
            return 0.0
        value = last if last > high else value  # a schedule may fall to 0
        if field == "buffer_size" and value >= self.config["total_steps"]:  # all of the run
            return 0.0
        if field in HORIZONS:
            value, low, high = (1 / max(1 - x, 1e-4) for x in (value, low, high))
        elif field == "initial_log_std":
            value, low, high = np.exp((value, low, high))
        if value < low:
            return -low / value if value > 0 else -np.inf
        return value / high if value > high else 0.0


def with_ratios(config: Mapping[str, Any]) -> dict[str, Any]:
    """A Config with the numbers that are made of several fields: updates for each step, and rows of a rollout."""
    found, envs = dict(config), config.get("num_envs", 1)
    if "num_updates" in config:
        found["replay_ratio"] = config["num_updates"] / (envs * config.get("update_every", 1))
    if "num_steps" in config:
        found["rollout_rows"] = envs * config["num_steps"]
    return found


def first_number(value: Any) -> float | None:
    """A number of a Config as it is, the first of a schedule "FIRST>LAST"; None for anything else."""
    value = number(value.partition(">")[0]) if isinstance(value, str) else value
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def last_number(value: Any) -> float | None:
    """A number of a Config as it is, the last of a schedule "FIRST>LAST"; None for anything else."""
    return first_number(value.rpartition(">")[2] if isinstance(value, str) else value)


def usual_ranges(texts: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """The usual range of each field whose help says one, as "usually 0.9 to 0.999"."""
    said = re.compile(r"usually (-?[\d.,e-]+) to (-?[\d.,e-]*\d)")
    return {
        name: (float(found[1].replace(",", "")), float(found[2].replace(",", "")))
        for name, text in texts.items()
        if (found := said.search(text))
    }
