"""Destinations of metrics. A logger is one class with `write` and `close`; a tracker is a logger on request."""

import inspect
import math
import os
import time
from collections.abc import Callable, Mapping
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from lemniscate.envs.vec_env import Episodes
from lemniscate.errors import UserError, shown
from lemniscate.run.metrics import METRICS, read_metrics, to_line
from lemniscate.system import named
from lemniscate.system.console import say
from lemniscate.system.files import open_regular, replace_file

Metrics = Mapping[str, float]
NO_EPISODES = Episodes([], [])


class Logger(Protocol):
    """One place for metrics. Made as `Class(run directory, config, step)`; a resumed run has a step above 0."""

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Write the metrics of one update, and the whole episodes that ended in it."""

    def close(self, pictures: list[Path]) -> None:
        """Write what is still pending, and the final pictures of the run where the logger takes pictures."""


LoggerClass = Callable[[Path, Mapping[str, Any], int], Logger]


def require_logger(thing: Any) -> Any:
    """A logger, or a class of them, as it is. Raises `UserError` for what is none."""
    methods = [(getattr(thing, name, None), count) for name, count in (("write", 3), ("close", 1))]
    if isinstance(thing, type):  # what its objects get otherwise, they show
        own = [(inspect.getattr_static(thing, name, None), count) for name, count in (("write", 4), ("close", 2))]
        methods = [(method, count) for method, count in own if inspect.isfunction(method)]
    if not all(named.takes(method, count) for method, count in methods):
        raise UserError(f"{shown(thing)} is no logger: that has write(step, metrics, episodes) and close(pictures).")
    return thing


class JsonLines:
    """`metrics.jsonl`, one line per update. A resumed run first removes the lines after its checkpoint.

    Lines that the disk refuses are kept, and written with the next one that it takes.
    """

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        self._path = path / METRICS
        if self._path.is_dir():
            raise UserError(f"{self._path} is a directory, where the lines of metrics have their file: move it away.")
        lines = [line for line in read_metrics(path) if line["step"] <= step] if step else []
        replace_file(self._path, b"".join(map(to_line, lines)))
        self._file = self._path.open("ab", buffering=0)  # what a buffer held would be lost in a crash
        self._unwritten = b""
        self._failed = False

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Append a line; `episode/returns` and `episode/lengths` are lists, in the order in which episodes ended.

        Metrics that are NaN or infinite are left out: JSON has no such numbers.
        """
        line: dict[str, Any] = {"step": step} | {name: x for name, x in metrics.items() if math.isfinite(x)}
        if episodes.returns:  # six digits: the lists are most of the file
            line |= {"episode/returns": [float(f"{r:.6g}") for r in episodes.returns]}
            line |= {"episode/lengths": episodes.lengths}
        self._unwritten += to_line(line)
        self._flush()

    def close(self, pictures: list[Path]) -> None:
        """Close the file."""
        self._flush()
        if self._unwritten:
            say(f"{self._path} lacks its last {len(self._unwritten.splitlines())} lines: the disk refused them.")
        self._file.close()

    def _flush(self) -> None:
        try:
            while self._unwritten:  # the disk may take a part
                self._unwritten = self._unwritten[self._file.write(self._unwritten) :]
            self._failed = False
        except OSError as error:
            if not self._failed:
                say(f"{self._path} cannot be written: {error.strerror}. Its lines are kept until it can.")
            self._failed = True


class TensorBoard:
    """Event files in the run directory, with the config as a table under Text.

    TensorBoard names a run after the directory that its events lie in: under `--logdir runs` by the run's own name. The
    file begins with the first line, so that a run with nothing left to do adds none; that of a resumed run tells
    TensorBoard to forget what was logged after the checkpoint.
    """

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        self._path, self._config, self._step = path, config, step
        self._failed = False

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Add a scalar for each metric. After an error of the disk, nothing more is written."""
        values = [{"tag": name, "simple_value": value} for name, value in metrics.items()]
        if not self._failed:
            try:
                self._add(self._records, step=step, summary={"value": values})
            except OSError as error:
                self._failed = True
                say(f"TensorBoard's events end before step {step:,}: {error.strerror}. {METRICS} goes on.")

    def close(self, pictures: list[Path]) -> None:
        """Close the file."""
        if "_records" in vars(self):
            self._records.close()

    @cached_property
    def _records(self) -> Any:
        """A new file of events, begun. Nothing is buffered, nor written by a thread: what fails, fails at its call."""
        from tensorboard.summary.writer.record_writer import RecordWriter
        from torch.utils.tensorboard.summary import text

        goes_on = self._step > 0 or any(self._path.glob("events.out.tfevents.*"))
        name = f"events.out.tfevents.{time.time_ns()}.{os.getpid()}"
        records = RecordWriter((self._path / name).open("xb", buffering=0))
        rows = "\n".join(f"|{name}|{value}|" for name, value in self._config.items())
        self._add(records, file_version="brain.Event:2")
        if goes_on:
            self._add(records, step=self._step + 1, session_log={"status": "START"})
        self._add(records, summary=text("config", f"|field|value|\n|-|-|\n{rows}"))
        return records

    @staticmethod
    def _add(records: Any, **parts: Any) -> None:
        event = import_module("tensorboard.compat.proto.event_pb2").Event
        records.write(event(wall_time=time.time(), **parts).SerializeToString())


class WeightsAndBiases:
    """A run of Weights & Biases (extra `wandb`).

    Without a key or a network it is recorded offline, and a line says how to upload it later. `WANDB_PROJECT`,
    `WANDB_NAME`, `WANDB_TAGS` and `WANDB_MODE` of the environment have their usual meaning.
    """

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        self._wandb: Any = import_module("wandb")
        given, mode = os.environ, os.environ.get("WANDB_MODE", "online")
        if mode == "online" and not given.get("WANDB_API_KEY") and not self._wandb.login(prompt=False):
            mode = "offline"
        options = {
            "project": given.get("WANDB_PROJECT", "lemniscate"),
            "name": given.get("WANDB_NAME", path.name),
            "tags": [str(config["env"]), *filter(None, given.get("WANDB_TAGS", "").split(","))],
            "config": dict(config),
            "dir": str(path),
            "id": _stable_id(path),
            "settings": self._wandb.Settings(init_timeout=20, silent=True),
        }
        try:
            self._run = self._wandb.init(mode=mode, resume="allow" if mode == "online" else None, **options)
        except (self._wandb.errors.CommError, self._wandb.errors.AuthenticationError):
            mode = "offline"
            self._wandb.teardown()
            self._run = self._wandb.init(mode=mode, resume=None, **options)
        if mode == "offline":
            say(f"W&B records offline; upload later with: wandb sync {path}/wandb/offline-run-*")

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Log one row."""
        self._run.log(dict(metrics), step=step)

    def close(self, pictures: list[Path]) -> None:
        """Upload the pictures and finish."""
        images = {file.stem: self._wandb.Image(str(file)) for file in pictures if file.suffix == ".png"}
        if images:
            self._run.log(images)
        self._run.finish()


def _stable_id(path: Path) -> str:
    """The W&B id of a run directory, kept in a file so that a resumed run continues its own curve."""
    file = path / "wandb-id"
    if not os.path.lexists(file):
        replace_file(file, os.urandom(6).hex().encode())
    with open_regular(file) as text:
        return text.read(100).decode(errors="replace")


TRACKERS = {"wandb": ("wandb", "lemniscate.run.loggers:WeightsAndBiases")}
"""name: (the extra that installs it, module:Class); beside these, any `module:Class` of a user's own"""
