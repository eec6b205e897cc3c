"""The directory of a sweep: several algorithms times several seeds, a run directory for each.

    sweep.json        the seeds, and the Config of each algorithm
    ppo-1/, sac-1/…   the runs

A run that has not begun is a directory with only a `config.json`; it is resumed from step 0, like any other.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lemniscate.errors import UserError
from lemniscate.run.directory import CONFIG, SWEEP, TUNE, create_directory
from lemniscate.system.files import DamagedFileError, parsing, read_json


@dataclass(frozen=True)
class Sweep:
    """The directory of a sweep and its `sweep.json`: the seeds, and the Config of each algorithm without its seed."""

    path: Path
    seeds: list[int]
    configs: dict[str, dict[str, Any]]

    @property
    def runs(self) -> dict[Path, dict[str, Any]]:
        """The run directories and the content of their `config.json`, ordered by seed, then by algorithm."""
        return {
            self.path / f"{algorithm}-{seed}": {"algorithm": algorithm, "config": {**config, "seed": seed}}
            for seed in self.seeds
            for algorithm, config in self.configs.items()
        }

    def create(self) -> None:
        """Write `sweep.json` into a new directory. Raises `UserError` if the directory exists already."""
        create_directory(self.path, SWEEP, {"seeds": self.seeds, "configs": self.configs})

    def create_runs(self) -> None:
        """Create the run directories that do not exist yet."""
        for path, record in self.runs.items():
            if not (path / CONFIG).exists():
                create_directory(path, CONFIG, record)


def is_sweep(path: Path) -> bool:
    """Whether a directory is that of a sweep."""
    return (path / SWEEP).exists()


def is_search(path: Path) -> bool:
    """Whether a directory is that of a search for settings, which has a sweep for each trial."""
    return (path / TUNE).exists()


def read_sweep(path: Path) -> Sweep:
    """The sweep in a directory. Raises `UserError` if there is none."""
    try:
        record = read_json(path / SWEEP)
    except DamagedFileError as error:
        reason = f": {error}" if (path / SWEEP).exists() else f": it holds no {SWEEP} that can be read."
        raise UserError(f"{path} is not a sweep{reason}") from None
    with parsing(path / SWEEP):
        sweep = Sweep(path, [int(seed) for seed in record["seeds"]], dict(record["configs"]))
        if unsafe := [name for name in sweep.configs if not re.fullmatch(r"[\w.:-]*\w", name) or ".." in name]:
            raise ValueError(f"{unsafe[0]!r} is no name of an algorithm")
        return sweep
