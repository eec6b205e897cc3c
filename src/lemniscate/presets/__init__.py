"""Tuned Configs, each with its source and date: one file of TOML for each algorithm, read when it is asked for.

`default` is the Config of an algorithm as it stands: an environment without a preset of its own gets it.

A file has an array `preset` of tables: `name`, `source`, `date`, and `fields`, those that differ from the algorithm's
defaults. What several presets share is a table `base.NAME`; fields or another base with `extends = "NAME"` begin with
what it says. Texts are read as on the command line: "none" is None, for which TOML has no word.
"""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

from lemniscate.algos import ALGORITHMS, find
from lemniscate.errors import UserError, shown, unknown_name
from lemniscate.run.config import RunConfig
from lemniscate.run.fields import read
from lemniscate.system.files import DamagedFileError, at_home, parsing, read_json, write_json


@dataclass(frozen=True)
class Preset:
    """A Config that has been tried, with its provenance."""

    name: str
    config: RunConfig
    source: str
    date: str

    @property
    def fields(self) -> dict[str, Any]:
        """The environment, and the fields that have another value than the algorithm's default, but the seed."""
        ours, defaults = self.config.to_json(), type(self.config)().to_json()
        changed = [name for name, value in ours.items() if value != defaults[name] and name != "seed"]
        return {name: ours[name] for name in dict.fromkeys(["env", *changed])}

    def write(self, file: Path, algorithm: str) -> None:
        """Write it into a file of JSON, with the name of its algorithm."""
        known = {"name": self.name, "algorithm": algorithm, "source": self.source, "date": self.date}
        write_json(file, known | {"fields": self.fields})

    def to_toml(self) -> str:
        """It as a table of TOML, ready to be pasted into the file of its algorithm."""
        provenance = {"name": self.name, "source": self.source, "date": self.date}
        return f"[[preset]]\n{_lines(provenance)}\n[preset.fields]\n{_lines(self.fields)}"


def of(algorithm: str) -> list[Preset]:
    """The presets of an algorithm; those of a module of one's own are its `PRESETS`, if it has any."""
    if algorithm in ALGORITHMS:
        return _stored(algorithm)
    own = getattr(find(algorithm), "PRESETS", [])
    if not isinstance(own, list | tuple) or not all(isinstance(preset, Preset) for preset in own):
        raise UserError(
            f"PRESETS of {algorithm} must be a list of Preset(name, config, source, date), not {shown(own)}."
        )
    return list(own)


def names(algorithm: str) -> list[str]:
    """The names of the presets, each once."""
    return ["default", *dict.fromkeys(preset.name for preset in of(algorithm))]


def best(algorithm: str, env_id: str | None) -> str:
    """The preset that an environment gets unless another is named: the first of its own, or the default."""
    own = (preset.name for preset in of(algorithm) if preset.config.env == env_id)
    return next(own, "default")


def choose(algorithm: str, env_id: str | None, name: str | None) -> tuple[str, RunConfig]:
    """The preset asked for, by name or by its file, or the best known for the environment, or the default.

    Returns (its name, its Config).

    Where several environments have a preset of one name, the environment decides. The Config's `env` is `env_id` if one
    is given. Raises `UserError` with the nearest names for an unknown preset.
    """
    name = best(algorithm, env_id) if name is None else name
    if not isinstance(name, str):
        raise unknown_name("preset", name, names(algorithm))
    named = [preset.config for preset in of(algorithm) if preset.name == name]
    if name == "default":
        named = [find(algorithm).Config()]
    elif name.endswith(".json"):
        name, named = Path(name).stem, [read_preset(at_home(name), algorithm).config]
    if not named:
        raise unknown_name("preset", name, names(algorithm))
    config = next((config for config in named if config.env == env_id), named[0])
    return name, config if env_id is None else config.replace(env=env_id)


def read_preset(file: Path, algorithm: str) -> Preset:
    """The preset that `Preset.write` has stored. Raises `UserError` for no such file, or that of another algorithm."""
    try:
        record = read_json(file)
    except DamagedFileError as error:
        reason = str(error) if file.exists() else f"{file} does not exist."
        raise UserError(f"There is no preset: {reason}") from None
    with parsing(file):
        if "fields" not in record:
            raise UserError(f"{file} is no preset, which `lemniscate tune` writes as preset.json.")
        if record["algorithm"] != algorithm:
            raise UserError(f"{file} is a preset of {record['algorithm']}, not of {algorithm}.")
        config = find(algorithm).Config().replace(**record["fields"])
        return Preset(str(record["name"]), config, str(record["source"]), str(record["date"]))


@cache
def _stored(algorithm: str) -> list[Preset]:
    """The presets in the file of an algorithm of this library."""
    return read_toml(algorithm, (Path(__file__).parent / f"{algorithm}.toml").read_text("utf-8"))


def read_toml(algorithm: str, text: str) -> list[Preset]:
    """The presets in a text of TOML. Raises `UserError` for fields that the algorithm does not have."""
    record, kind = tomllib.loads(text), find(algorithm).Config
    hints = get_type_hints(kind, include_extras=True)

    def fields_of(table: Mapping[str, Any]) -> dict[str, Any]:
        own = dict(table)
        inherited = fields_of(record["base"][own.pop("extends")]) if "extends" in own else {}
        return inherited | own

    def config_of(fields: Mapping[str, Any]) -> RunConfig:
        read_fields = {k: read(k, hints[k], v) if isinstance(v, str) else v for k, v in fields_of(fields).items()}
        return kind().replace(**read_fields)

    return [Preset(p["name"], config_of(p["fields"]), p["source"], p["date"]) for p in record.get("preset", [])]


def _lines(table: Mapping[str, Any]) -> str:
    """The values of a table in TOML, whose notation is JSON's but for None and dictionaries: they become texts."""
    typed = {key: "none" if value is None else value for key, value in table.items()}
    typed |= {key: json.dumps(value) for key, value in table.items() if isinstance(value, dict)}
    return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in typed.items())
