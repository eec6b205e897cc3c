"""The record of a preset, and a preset in a file of its own."""

from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

from lemniscate.algos import find
from lemniscate.errors import UserError
from lemniscate.run.config import RunConfig
from lemniscate.system.files import DamagedFileError, parsing, read_json, write_json


@dataclass(frozen=True)
class Preset:
    """A Config that has been tried, with its provenance."""

    name: str
    config: RunConfig
    source: str
    date: str


@dataclass(frozen=True)
class StoredPreset:
    """A Config with its provenance, in JSON: the fields in which it differs from the algorithm's defaults."""

    name: str
    algorithm: str
    config: RunConfig
    source: str
    date: str

    @property
    def fields(self) -> dict[str, object]:
        """The fields that have another value than the default."""
        ours, defaults = self.config.to_json(), type(self.config)().to_json()
        changed = [name for name, value in ours.items() if value != defaults[name] and name != "seed"]
        return {name: ours[name] for name in dict.fromkeys(["env", *changed])}

    def write(self, file: Path) -> None:
        """Write it into a file."""
        known = {"name": self.name, "algorithm": self.algorithm, "source": self.source, "date": self.date}
        write_json(file, known | {"fields": self.fields})

    def to_python(self) -> str:
        """It as a value of `lemniscate.presets`, ready to be pasted there."""
        fields = "".join(f"\n        {name}={_literal(value)}," for name, value in self.fields.items())
        source = "".join(f'\n    "{part}"' for part in wrap(self.source, 100, drop_whitespace=False))
        config = f"{self.algorithm}.Config({fields}\n    )"
        return f'Preset(\n    "{self.name}",\n    {config},{source},\n    "{self.date}",\n)'


def read_preset(file: Path, algorithm: str) -> StoredPreset:
    """The preset in a file.

    Raises:
        UserError: no such file, or that of another algorithm.
    """
    try:
        record = read_json(file)
    except DamagedFileError as error:
        reason = str(error) if file.exists() else f"{file} does not exist."
        raise UserError(f"There is no preset: {reason}") from None
    with parsing(file):
        if record["algorithm"] != algorithm:
            raise UserError(f"{file} is a preset of {record['algorithm']}, not of {algorithm}.")
        config = find(algorithm).Config().replace(**record["fields"])
        return StoredPreset(str(record["name"]), algorithm, config, str(record["source"]), str(record["date"]))


def _literal(value: object) -> str:
    """A value of JSON as Python has it; lists are tuples, and texts have double quotes."""
    if isinstance(value, list):
        return f"({', '.join(map(_literal, value))}{',' * (len(value) == 1)})"
    return f'"{value}"' if isinstance(value, str) else repr(value)
