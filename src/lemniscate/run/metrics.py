"""`metrics.jsonl`: a line of JSON for each update, each ending in the CRC-32 of what is before it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zlib import crc32

from lemniscate.system.console import say
from lemniscate.system.files import DamagedFileError, open_regular

METRICS = "metrics.jsonl"
MARK = b', "crc32": "'
PROGRESS_BYTES = 2**17
"""bytes at the end of a run's metrics that its progress is read from"""


def to_line(record: Mapping[str, Any]) -> bytes:
    """A record, which is not empty, as a line."""
    body = json.dumps(record)[:-1].encode()
    return body + MARK + f'{crc32(body):08x}"}}\n'.encode()


def from_line(line: bytes) -> dict[str, Any] | None:
    """The record of a line; None if the line is not whole."""
    body, _, rest = line.rpartition(MARK)  # the last one, since a name in the record may hold the mark as well
    return json.loads(body + b"}") if rest == f'{crc32(body):08x}"}}\n'.encode() else None


def read_metrics(path: Path, last_bytes: int | None = None) -> list[dict[str, Any]]:
    """The whole lines of a run's metrics; damaged ones, and a last one that a crash cut off, are left out.

    With `last_bytes` only of the lines that lie whole within the last so many bytes.
    """
    return [record for record in map(from_line, _lines(path, last_bytes)) if record is not None]


def progress_of(run: Path) -> tuple[int, float | None, float | None]:
    """(step, mean return of the last 100 episodes, steps per second) in the last lines of a run's metrics."""
    lines = read_metrics(run, PROGRESS_BYTES)
    returns = [ret for line in lines for ret in line.get("episode/returns", [])][-100:]
    rates = [line["time/steps_per_second"] for line in lines if "time/steps_per_second" in line]
    mean = sum(returns) / len(returns) if returns else None
    return (lines[-1]["step"] if lines else 0), mean, (rates[-1] if rates else None)


def damage(path: Path, logged: int) -> str | None:
    """The damage of a run's metrics, in a sentence. `logged` is the step that they are known to reach."""
    file, lines = path / METRICS, _lines(path)
    if lines and not lines[-1].endswith(b"\n"):  # cut off by a crash
        lines.pop()
    records = list(map(from_line, lines))
    damaged = [str(number) for number, record in enumerate(records, start=1) if record is None]
    if damaged:
        several = f"lines {', '.join(damaged[:5])}{' and others' if len(damaged) > 5 else ''} are"
        return f"{file}: {several if len(damaged) > 1 else f'line {damaged[0]} is'} damaged, and left out."
    last = max((record["step"] for record in records if record), default=0)
    return f"{file} ends at step {last:,}; its lines up to step {logged:,} are lost." if last < logged else None


def _lines(path: Path, last_bytes: int | None = None) -> list[bytes]:
    file = path / METRICS
    if not file.exists() and not file.is_symlink():
        return []
    try:
        with open_regular(file) as text:
            start = file.stat().st_size - last_bytes if last_bytes else 0
            if start > 0:
                text.seek(start - 1)
                text.readline()
            return text.readlines()
    except DamagedFileError as error:
        say(error)
        return []
