"""A logger of one's own: metrics into a CSV file.

    cd examples
    lemniscate train ppo --env CartPole-v1 --total-steps 20_000 --track own_logger:Csv

A logger is made with the run directory, the settings, and the step that the run begins or resumes at.
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lemniscate.envs.vec_env import Episodes


class Csv:
    """`metrics.csv`, one row for each metric of each update: step, name, value; after a resume no step twice."""

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        file = path / "metrics.csv"
        text = file.read_text().splitlines() if file.exists() else []
        rows = [row for row in csv.reader(text) if len(row) == 3 and int(row[0]) <= step]
        self._file = file.open("w", newline="")
        self._writer = csv.writer(self._file)
        self._writer.writerows(rows)
        self._file.flush()

    def write(self, step: int, metrics: Mapping[str, float], episodes: Episodes | None = None) -> None:
        """Append the metrics of one update."""
        self._writer.writerows((step, name, value) for name, value in metrics.items())
        self._file.flush()

    def close(self, pictures: list[Path]) -> None:
        """Close the file."""
        self._file.close()
