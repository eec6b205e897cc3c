"""The record of a preset."""

from dataclasses import dataclass

from lemniscate.run.config import RunConfig


@dataclass(frozen=True)
class Preset:
    """A Config that has been tried, with its provenance."""

    name: str
    config: RunConfig
    source: str
    date: str
