"""The directory of a search: what is searched, Optuna's journal of the trials, and a sweep for each trial.

tune.json        algorithm, Config, search, seeds, number of trials
study.journal    what Optuna knows of the trials
trials/000/…     a sweep of one algorithm with all seeds
preset.json      the settings of the best trial so far

A text such as

    learning_rate=log:1e-4:1e-2, gamma=.9:.999, hidden=64 64|256 256

says what is searched: a range whose orders of magnitude are equally likely, a range whose numbers are, a choice of two.
"""

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import numpy as np

from lemniscate import algos
from lemniscate.errors import UserError, is_installed, missing_extra, shown
from lemniscate.presets import Preset
from lemniscate.report.seeds import iqm
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import TUNE, create_directory
from lemniscate.run.fields import kinds_of, read, unknown_field
from lemniscate.run.metrics import read_metrics
from lemniscate.run.places import Sweep
from lemniscate.run.seeding import derive
from lemniscate.system.files import DamagedFileError, parsing, read_json, replace_file

if TYPE_CHECKING:
    import optuna

JOURNAL, PRESET, TRIALS = "study.journal", "preset.json", "trials"
RETURNS = 100
"""newest training episodes that a trial is compared by before its end"""

REDUCTION = 3
"""of the trials that reach a rung, one of so many goes on; each rung is so many times as far as the one before"""
RUNGS = (1, REDUCTION)
"""ninths of a run, after which a trial is compared with the others that have come so far"""
NINTHS = REDUCTION**2

NOT_SEARCHED = ("env", "backend", "seed", "total_steps", "checkpoint_every", "evaluate_every", "evaluate_episodes")
"""fields that are the same in all trials, or set by the search itself"""


@dataclass(frozen=True)
class Interval:
    """The numbers from `low` to `high`; with `log` uniform in their logarithm, with `whole` whole ones."""

    low: float
    high: float
    log: bool
    whole: bool

    def draw(self, trial: Any, name: str) -> Any:
        """The number that Optuna suggests; of one with a fraction, six digits, which a preset can say."""
        if self.whole:
            return trial.suggest_int(name, self.low, self.high, log=self.log)
        value = float(f"{trial.suggest_float(name, self.low, self.high, log=self.log):.6g}")
        return min(max(value, self.low), self.high)

    def key_of(self, value: Any) -> Any:
        """The suggestion of Optuna that stands for `value`; None if it is outside."""
        return value if isinstance(value, int | float) and self.low <= value <= self.high else None


@dataclass(frozen=True)
class Choice:
    """One of several values, as they were typed."""

    values: Mapping[str, Any]

    def draw(self, trial: Any, name: str) -> Any:
        """The value that Optuna suggests."""
        return self.values[trial.suggest_categorical(name, list(self.values))]

    def key_of(self, value: Any) -> Any:
        """The suggestion of Optuna that stands for `value`; None if it is none of the choices."""
        return next((key for key, choice in self.values.items() if choice == value), None)


Space = dict[str, Interval | Choice]


def read_texts(search: object) -> dict[str, str]:
    """The text of each range by its field, in "learning_rate=log:1e-4:1e-2, gamma=.9:.999" or a dictionary of them."""
    if not isinstance(search, str | Mapping):
        raise UserError(f"search must be a text such as 'gamma=.9:.999', or a dictionary, not {shown(search)}.")
    if isinstance(search, Mapping):
        pairs = [(str(name), "=", _text(name, text)) for name, text in search.items()]
    else:
        pairs = [field.partition("=") for field in re.split(r",\s*(?=[\w-]+\s*=)", search.strip(" ,")) if field]
    for pair in pairs:
        if not all(map(str.strip, pair)):
            written = "".join(pair).strip()
            raise UserError(f"A search is written as field=low:high, field=log:low:high or field=a|b, not {written!r}.")
    names = [name.strip().lstrip("-").replace("-", "_") for name, _, _ in pairs]
    if several := [name for name in names if names.count(name) > 1]:
        raise UserError(f"The search has {several[0]} more than once: one range, or choices as {several[0]}=a|b.")
    if not pairs:
        raise UserError("Search what? Name fields with their ranges, such as learning_rate=log:1e-4:1e-2.")
    return {name: text.strip() for name, (_, _, text) in zip(names, pairs, strict=True)}


def _text(name: object, text: object) -> str:
    """A range of a dictionary, which is a text; a number stands for itself, and is refused as no range."""
    if isinstance(text, str | int | float):
        return str(text)
    raise UserError(f"search[{name!r}] must be a text such as 'log:1e-4:1e-2', '.9:.999' or 'a|b', not {shown(text)}.")


def read_space(texts: Mapping[str, str], config: RunConfig) -> Space:
    """The ranges that the texts stand for. Raises `UserError` for what a search cannot change, or has no room for."""
    hints, space = get_type_hints(type(config), include_extras=True), Space()
    for name, text in texts.items():
        if name not in hints:
            raise unknown_field(name, config.names())
        if name in NOT_SEARCHED:
            raise UserError(f"{name} is the same in all trials: give it as a field, not in the search.")
        space[name] = _range(name, text, hints[name], config)
    return space


def draw(space: Space, trial: Any) -> dict[str, Any]:
    """The fields of a new trial, by name."""
    return {name: values.draw(trial, name) for name, values in space.items()}


def _range(name: str, text: str, hint: Any, config: RunConfig) -> Interval | Choice:
    """The range that a text stands for; every end of it is a value that the Config has room for."""
    ends = re.fullmatch(r"(log:)?(?!log:)([^:|]+):([^:|]+)", text)
    if not ends:
        known = f"write {name}=low:high, {name}=log:low:high or {name}=a|b"
        if ":" in text and kinds_of(hint).keys() & {int, float}:
            raise UserError(f"{name}={text} is no range: {known}.")
        values = {part.strip(): _read(name, hint, part) for part in text.split("|")}
        checked = {key: getattr(config.replace(**{name: value}), name) for key, value in values.items()}
        if len({repr(value) for value in checked.values()}) < max(2, len(checked)):
            raise UserError(f"{name}={text} is no range: {known}.")
        return Choice(checked)
    low, high = (getattr(config.replace(**{name: _read(name, hint, end)}), name) for end in ends.groups()[1:])
    log = ends[1] is not None
    if not all(isinstance(end, int | float) and not isinstance(end, bool) for end in (low, high)):
        raise UserError(f"{name} is no number: give its values as {name}=a|b.")
    if not low < high or (log and low <= 0):
        above = " above 0 and" if log else ""
        raise UserError(f"{name}={text} is no range: its first number must be{above} below its second one.")
    return Interval(low, high, log, isinstance(low, int) and isinstance(high, int))


def _read(name: str, hint: Any, text: str) -> Any:
    kinds, text = kinds_of(hint), text.strip()
    if bool in kinds:
        return {"on": True, "true": True, "off": False, "false": False}.get(text.lower(), text)
    return read(name, hint, text.split() if tuple in kinds else text)


@dataclass(frozen=True)
class Tuned:
    """The result of `tune`: the search's directory, the best settings and their score, and every trial's."""

    path: Path
    preset: Preset
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
        record = {**vars(self), "config": self.config.to_json()}
        del record["path"]
        create_directory(self.path, TUNE, record)

    def sweep(self, name: str, fields: Mapping[str, Any]) -> Sweep:
        """The sweep of one trial."""
        config = self.config.replace(**fields).to_json()
        del config["seed"]
        return Sweep(self.path / TRIALS / name, self.seeds, {self.algorithm: config})

    def write_preset(self, best: "optuna.trial.FrozenTrial") -> Preset:
        """Write the settings of the best trial, with their provenance, into `preset.json`."""
        seeds = ", ".join(map(str, self.seeds))
        which = f"trial {best.number} of {self.trials}, {self.what}, seeds {seeds}, score {best.value:,.1f}"
        settings = draw(self.space, import_optuna().trial.FixedTrial(best.params))
        config = self.config.replace(**settings, checkpoint_every=0, evaluate_every=0, evaluate_episodes=20)
        preset = Preset(self.path.name, config, f"lemniscate tune: {which}", f"{date.today():%Y-%m}")
        preset.write(self.path / PRESET, self.algorithm)
        return preset

    @property
    def rungs(self) -> list[int | None]:
        """The steps to which the runs of a trial go on, one after the other; None is their end.

        After the others, planned checkpoints all of them, the trial may end.
        """
        return [*(ninths * self.config.checkpoint_every for ninths in RUNGS if self.prune), None]

    def study(self) -> "optuna.Study":
        """Optuna's study, new or as the journal has it. Raises `UserError` for one that is damaged."""
        optuna = import_optuna()
        journal, file = optuna.storages.journal, str(self.path / JOURNAL)
        backend = journal.JournalFileBackend(file, journal.JournalFileOpenLock(file))  # the other takes symbolic links
        with parsing(self.path / JOURNAL):
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


def mend(journal: Path) -> None:
    """Cut off the line that a power cut has left half-written; one that is lost is empty. Raises if others are damaged.

    Optuna would write on in that line.
    """
    content = journal.read_bytes() if journal.exists() else b""
    whole = content[: content.rfind(b"\n") + 1]
    with parsing(journal):
        for line in whole.splitlines():
            json.loads(line)
    if whole != content or not whole:
        replace_file(journal, whole)


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


def score_at(runs: Iterable[Path], step: int) -> float | None:
    """The interquartile mean over seeds of the newest training episodes' returns; None if a run has had none.

    Lines of the metrics that were written long after `step`, as in a resumed run, do not count.
    """
    lines = [[line for line in read_metrics(run) if line["step"] <= step + step // 2] for run in runs]
    of = [[ret for line in known for ret in line.get("episode/returns", [])][-RETURNS:] for known in lines]
    return float(iqm([float(np.mean(episodes)) for episodes in of])) if all(of) else None
