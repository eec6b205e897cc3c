"""Where metrics go. A logger is one small class with `write` and `close`, and one line in `LOGGERS`."""

import json
import math
import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from lemniscate.envs.episodes import Episodes

Metrics = Mapping[str, float]
NO_EPISODES = Episodes([], [])


class Logger(Protocol):
    """One place for metrics."""

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Take the metrics of one update, and the whole episodes that ended in it."""
        ...

    def close(self, pictures: list[Path]) -> None:
        """Flush; take the run's final pictures along if there is a place for them."""
        ...


class JsonLines:
    """`metrics.jsonl`, one line an update: always written. A resumed run first drops the lines it will write again."""

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        self._path = path / "metrics.jsonl"
        lines = [line for line in read_metrics(path) if line["step"] <= step] if step else []
        temporary = self._path.with_suffix(".tmp")
        temporary.write_text("".join(json.dumps(line) + "\n" for line in lines))
        temporary.replace(self._path)
        self._file = self._path.open("a")

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Append a line; `episode/returns` and `episode/lengths` are lists, in the order in which episodes ended.

        What is not a number is left out: JSON has no word for it.
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
    """Event files in `tensorboard/`, with the config as a table under Text."""

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(path / "tensorboard"), purge_step=step + 1 if step else None)
        rows = "\n".join(f"|{name}|{value}|" for name, value in config.items())
        self._writer.add_text("config", f"|field|value|\n|-|-|\n{rows}")

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Add a scalar for each metric."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)

    def close(self, pictures: list[Path]) -> None:
        """Flush and close."""
        self._writer.close()


class WeightsAndBiases:
    """W&B (extra `wandb`). Without a key or a network it records offline, and says how to upload later."""

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        wandb: Any = import_module("wandb")
        self._wandb = wandb
        mode = os.environ.get("WANDB_MODE", "online")
        if mode == "online" and not os.environ.get("WANDB_API_KEY") and not wandb.login(prompt=False):
            mode = "offline"
        options = {
            "project": os.environ.get("WANDB_PROJECT", "lemniscate"),
            "name": os.environ.get("WANDB_NAME", path.name),
            "tags": [str(config["env"]), *filter(None, os.environ.get("WANDB_TAGS", "").split(","))],
            "config": dict(config),
            "dir": str(path),
            "id": _stable_id(path),
            "resume": "allow" if mode == "online" else None,
        }
        settings = wandb.Settings(init_timeout=20, silent=True)
        try:
            self._run = wandb.init(mode=mode, settings=settings, **options)
        except (wandb.errors.CommError, wandb.errors.AuthenticationError):
            mode = "offline"
            wandb.teardown()
            self._run = wandb.init(mode=mode, settings=settings, **{**options, "resume": None})
        if mode == "offline":
            print(f"W&B records offline; upload later with: wandb sync {path}/wandb/offline-run-*", file=sys.stderr)

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Log one row."""
        self._run.log(dict(metrics), step=step)

    def close(self, pictures: list[Path]) -> None:
        """Upload the pictures and finish."""
        if pictures:
            self._run.log(
                {picture.stem: self._wandb.Image(str(picture)) for picture in pictures if picture.suffix == ".png"}
            )
        self._run.finish()


LOGGERS: dict[str, Callable[[Path, Mapping[str, Any], int], Logger]] = {
    "jsonl": JsonLines,
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
}


def read_metrics(path: Path, last_bytes: int | None = None) -> list[dict[str, Any]]:
    """The lines of a run's `metrics.jsonl`, or those within its end; a last one that a crash cut off is left out."""
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


def _stable_id(path: Path) -> str:
    """One id for a run directory, so that a resumed run continues its own curve."""
    file = path / "wandb-id"
    if not file.exists():
        file.write_text(os.urandom(6).hex())
    return file.read_text()
