"""The directory of a search: what is searched, Optuna's journal of the trials, and a sweep for each trial.

tune.json        algorithm, Config, search, seeds, number of trials
study.journal    what Optuna knows of the trials
trials/000/…     a sweep of one algorithm with all seeds
preset.json      the settings of the best trial so far
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lemniscate import algos
from lemniscate.errors import UserError, is_installed, missing_extra
from lemniscate.presets.preset import StoredPreset
from lemniscate.report.seeds import iqm
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import TUNE, create_directory, is_finished
from lemniscate.run.metrics import read_metrics
from lemniscate.run.places import Sweep
from lemniscate.run.seeding import derive
from lemniscate.sweeps.space import Space, read_space
from lemniscate.system.files import DamagedFileError, parsing, read_json

if TYPE_CHECKING:
    import optuna

JOURNAL, PRESET, TRIALS = "study.journal", "preset.json", "trials"
FIELDS = ("algorithm", "config", "search", "seeds", "trials", "prune")
RETURNS = 100
"""newest training episodes that a trial is compared by before its end"""

REDUCTION = 3
"""of the trials that reach a rung, one of so many goes on; each rung is so many times as far as the one before"""
RUNGS = (1, REDUCTION)
"""ninths of a run, after which a trial is compared with the others that have come so far"""
NINTHS = REDUCTION**2


@dataclass(frozen=True)
class Tuned:
    """The result of `tune`: the search's directory, the best settings and their score, and every trial's."""

    path: Path
    preset: StoredPreset
    score: float
    trials: list[dict[str, Any]]


@dataclass(frozen=True)
class Search:
    """A search, as stored in `tune.json`."""

    path: Path
    algorithm: str
    config: RunConfig
    """of every trial, but for what is searched and the seed"""
    search: dict[str, str]
    seeds: list[int]
    trials: int
    prune: bool

    @property
    def space(self) -> Space:
        """The ranges of what is searched."""
        return read_space(self.search, self.config)

    @property
    def what(self) -> str:
        """The searched fields and their ranges, as on the command line."""
        return ", ".join(f"{name}={text}" for name, text in self.search.items())

    def create(self) -> None:
        """Write `tune.json` into a new directory. Raises `UserError` if the directory exists already."""
        record = {name: getattr(self, name) for name in FIELDS} | {"config": self.config.to_json()}
        create_directory(self.path, TUNE, record)

    def sweep(self, name: str, fields: Mapping[str, Any]) -> Sweep:
        """The sweep of one trial."""
        config = self.config.replace(**fields).to_json()
        but_seed = {name: value for name, value in config.items() if name != "seed"}
        return Sweep(self.path / TRIALS / name, self.seeds, {self.algorithm: but_seed})

    def preset(self, which: str, settings: Mapping[str, Any], score: float) -> StoredPreset:
        """The best settings, with their provenance."""
        seeds = ", ".join(map(str, self.seeds))
        source = f"lemniscate tune: {which}, {self.what}, seeds {seeds}, score {score:,.1f}"
        config = self.config.replace(**settings, evaluate_every=0, evaluate_episodes=20)
        return StoredPreset(self.path.name, self.algorithm, config, source, f"{date.today():%Y-%m}")

    def rungs(self) -> list[int]:
        """The steps after which a trial may end, planned checkpoints all of them."""
        return [ninths * self.config.checkpoint_every for ninths in RUNGS] if self.prune else []

    def study(self) -> "optuna.Study":
        """Optuna's study, new or as the journal has it."""
        optuna = import_optuna()
        backend = optuna.storages.journal.JournalFileBackend(str(self.path / JOURNAL))
        return optuna.create_study(
            storage=optuna.storages.JournalStorage(backend),
            study_name="lemniscate",
            direction="maximize",
            pruner=optuna.pruners.SuccessiveHalvingPruner(min_resource=1, reduction_factor=REDUCTION),
            load_if_exists=True,
        )

    def ask(self, study: "optuna.Study") -> "optuna.Trial":
        """A new trial. What is proposed depends on the trials that are known, not on the process that asks."""
        few = max(2, min(10, self.trials // 3))
        seed = derive(self.seeds[0], len(study.trials))
        study.sampler = import_optuna().samplers.TPESampler(seed=seed, n_startup_trials=few)
        return study.ask()


def import_optuna() -> Any:
    """Optuna, which says nothing by itself. Raises `UserError` where it is not installed."""
    if not is_installed("optuna"):
        raise missing_extra("optuna", "tune")
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def read_search(path: Path) -> Search:
    """The search in a directory. Raises `UserError` if there is none."""
    try:
        record = read_json(path / TUNE)
    except DamagedFileError as error:
        raise UserError(f"{path} is not a search: {error}") from None
    with parsing(path / TUNE):
        algorithm = str(record["algorithm"])
        config = algos.find(algorithm).Config.from_json(record["config"])
        seeds = [int(seed) for seed in record["seeds"]]
        search = {str(name): str(text) for name, text in record["search"].items()}
        return Search(path, algorithm, config, search, seeds, int(record["trials"]), bool(record["prune"]))


def has_come(run: Path, step: int | None) -> bool:
    """Whether a run has come to this step, or, without one, to its end."""
    if step is None:
        return is_finished(run)
    lines = read_metrics(run)
    return bool(lines) and lines[-1]["step"] >= step


def score_at(runs: Iterable[Path], step: int) -> float | None:
    """The interquartile mean over seeds of the newest training episodes' returns; None if a run has had none."""
    of = [[ret for line in read_metrics(run) for ret in _returns(line, step)][-RETURNS:] for run in runs]
    return float(iqm([float(np.mean(episodes)) for episodes in of])) if all(of) else None


def _returns(line: Mapping[str, Any], step: int) -> list[float]:
    """The episode returns of a line of the metrics; none if it was written long after `step`, as in a resumed run."""
    return line.get("episode/returns", []) if line["step"] <= step + step // 2 else []


def final_score(runs: Iterable[Path]) -> float:
    """The interquartile mean over seeds of the final policies' returns."""
    return float(iqm([read_metrics(run)[-1]["evaluation/return"] for run in runs]))


def as_text(params: Mapping[str, Any]) -> str:
    """Optuna's values of a trial as a line says them."""
    shown = {name: f"{value:.3g}" if isinstance(value, float) else value for name, value in params.items()}
    return ", ".join(f"{name} {value}" for name, value in shown.items())
