"""Destinations of metrics. A logger is one class with `write` and `close`; a tracker is a logger on request."""

import json
import math
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

from lemniscate.envs.episodes import Episodes

Metrics = Mapping[str, float]
NO_EPISODES = Episodes([], [])


class Logger(Protocol):
    """One place for metrics. Made as `Class(run directory, config, step)`; a resumed run has a step above 0."""

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Write the metrics of one update, and the whole episodes that ended in it."""
        ...

    def close(self, pictures: list[Path]) -> None:
        """Write what is still pending, and the final pictures of the run where the logger takes pictures."""
        ...


LoggerClass = Callable[[Path, Mapping[str, Any], int], Logger]


class JsonLines:
    """`metrics.jsonl`, one line per update. A resumed run first removes the lines after its checkpoint."""

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        self._path = path / "metrics.jsonl"
        lines = [line for line in read_metrics(path) if line["step"] <= step] if step else []
        temporary = self._path.with_suffix(".tmp")
        temporary.write_text("".join(json.dumps(line) + "\n" for line in lines))
        temporary.replace(self._path)
        self._file = self._path.open("a")

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Append a line; `episode/returns` and `episode/lengths` are lists, in the order in which episodes ended.

        Metrics that are NaN or infinite are left out: JSON has no such numbers.
        """
        line: dict[str, Any] = {"step": step} | {name: x for name, x in metrics.items() if math.isfinite(x)}
        if episodes.returns:
            line |= {"episode/returns": [float(f"{r:.6g}") for r in episodes.returns]}
            line |= {"episode/lengths": episodes.lengths}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()

    def close(self, pictures: list[Path]) -> None:
        """Close the file."""
        self._file.close()


class TensorBoard:
    """Event files in the run directory, with the config as a table under Text.

    TensorBoard names a run after the directory that its events lie in: under `--logdir runs` by the run's own name. The
    file begins with the first line, so that a run with nothing left to do adds none; that of a resumed run tells
    TensorBoard to forget what was logged after the checkpoint.
    """

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        self._path, self._config, self._step = path, config, step

    @cached_property
    def _writer(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter

        writer = SummaryWriter(str(self._path), purge_step=self._step + 1 if self._step else None)
        rows = "\n".join(f"|{name}|{value}|" for name, value in self._config.items())
        writer.add_text("config", f"|field|value|\n|-|-|\n{rows}")
        return writer

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Add a scalar for each metric."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)

    def close(self, pictures: list[Path]) -> None:
        """Flush and close."""
        if "_writer" in vars(self):
            self._writer.close()


TRACKERS = {"wandb": ("wandb", "lemniscate.run.wandb_logger:WeightsAndBiases")}
"""name: (the extra that installs it, module:Class); beside these, any `module:Class` of a user's own"""


def read_metrics(path: Path, last_bytes: int | None = None) -> list[dict[str, Any]]:
    """The lines of a run's `metrics.jsonl`, without a last one that a crash cut off.

    Args:
        path: the run directory.
        last_bytes: read only the lines that lie whole within the last so many bytes.
    """
    file = path / "metrics.jsonl"
    if not file.exists():
        return []
    lines = []
    with file.open("rb") as text:
        start = file.stat().st_size - last_bytes if last_bytes else 0
        if start > 0:
            text.seek(start - 1)
            text.readline()
        for line in text:
            try:
                lines.append(json.loads(line))
            except ValueError:
                break
    return lines
