"""Whether the files of a run or a sweep are whole, and what can be done where one is not. Nothing is changed."""

from collections.abc import Iterator
from pathlib import Path

from lemniscate.envs.check import BAD, GOOD, NOTE, Finding
from lemniscate.errors import UserError, resume_line
from lemniscate.run import checkpoint
from lemniscate.run.directory import (
    BEST,
    CONFIG,
    FINAL,
    LOCK,
    SWEEP,
    TUNE,
    is_finished,
    locked,
    lost,
    require_no_search,
)
from lemniscate.run.metrics import METRICS, damage, read_metrics
from lemniscate.run.places import is_sweep, read_sweep
from lemniscate.system.files import DamagedFileError, is_whole, parsing, read_json


def is_stored(path: Path) -> bool:
    """Whether a directory is that of a run, of a sweep or of a search, whole or not."""
    return any((path / name).exists() for name in (CONFIG, SWEEP, TUNE, "checkpoints"))


def each_finding(path: Path) -> Iterator[Finding]:
    """The findings in the files of a run, or of each run of a sweep, one by one. Raises `UserError` for a search."""
    require_no_search(path)
    if not is_sweep(path):
        yield from _of_run(path)
        return
    try:
        sweep = read_sweep(path)
    except UserError as error:
        yield Finding(BAD, f"{error} Its runs can be resumed and plotted one by one.")
        runs = sorted(folder for folder in path.iterdir() if is_stored(folder))
    else:
        yield Finding(GOOD, f"{SWEEP}: {', '.join(sweep.configs)} with {len(sweep.seeds)} seeds.")
        runs = list(sweep.runs)
    for run in runs:
        for finding in _of_run(run):
            yield Finding(finding.grade, f"{run.name}: {finding.sentence}")


def verdict(path: Path, found: list[Finding]) -> str:
    """The verdict on a run or a sweep, and its remedy, in a sentence or two."""
    damaged = sum(finding.grade == BAD for finding in found)
    if not damaged:
        return f"{path} is whole."
    planned = any(each.record.get("planned") for each in _checkpoints(path)[0])
    repairable = is_whole(path / SWEEP) if is_sweep(path) else planned
    files = f"{damaged} finding{'s' * (damaged > 1)} above, marked ✗"
    if not is_sweep(path) and _is_finished(path):
        return f"{path} is damaged: {files}. It is finished, so that resume changes nothing; its policy serves."
    if repairable:
        return f"{path} is damaged: {files}. What can be repaired, this repairs: {resume_line(path)}"
    return f"{path} is damaged: {files}. There is nothing that it can be repaired from."


def _of_run(path: Path) -> Iterator[Finding]:
    whole, broken = _checkpoints(path)
    if path.exists():
        yield _config(path, whole)
    yield from broken
    yield _going_on(path, whole)
    yield from _metrics(path, whole)
    if (path / FINAL).exists():
        if is_whole(path / FINAL):
            yield Finding(GOOD, f"{FINAL}: the scores of the final policy.")
        else:
            yield Finding(BAD, f"{path / FINAL} is damaged; its scores are computed again where they are asked for.")
    if left := sorted(file.relative_to(path).as_posix() for file in path.rglob("*.tmp")):
        yield Finding(NOTE, f"Left by a write that was interrupted, and harmless: {', '.join(left)}.")
    if (path / LOCK).exists() and _is_locked(path):
        yield Finding(NOTE, "It is being trained by another process, and may have changed meanwhile.")


def _checkpoints(path: Path) -> tuple[list[checkpoint.Checkpoint], list[Finding]]:
    """The checkpoints that are whole, the best before those by step, and what is wrong with the others."""
    whole, broken = [], []
    folders = [path / "checkpoints" / f"step-{step}" for step in checkpoint.list_steps(path / "checkpoints")]
    for folder in [path / "checkpoints" / BEST, *folders]:
        try:
            if folder.is_dir():
                whole.append(checkpoint.read(folder))
        except UserError as error:
            broken.append(Finding(BAD, str(error)))
    return whole, broken


def _config(path: Path, whole: list[checkpoint.Checkpoint]) -> Finding:
    """Whether the config is whole, or can be taken from a checkpoint."""
    try:
        record = read_json(path / CONFIG)
        with parsing(path / CONFIG):
            what = f"{record['algorithm']} on {record['config']['env']}"
    except DamagedFileError as error:
        copy = f"{whole[-1].path} has a copy, which is taken." if whole else "No checkpoint has a copy."
        return Finding(BAD, f"{error} {copy}")
    return Finding(GOOD, f"{CONFIG}: {what}.")


def _going_on(path: Path, whole: list[checkpoint.Checkpoint]) -> Finding:
    """The whole checkpoints, and what `resume` would do."""
    planned = [found for found in whole if found.record.get("planned")]
    if not checkpoint.list_steps(path / "checkpoints"):
        if not read_metrics(path):
            return Finding(GOOD, "It has not begun.")
        if is_whole(path / CONFIG) and (gone := lost(path)):
            return Finding(BAD, gone)
        return Finding(NOTE, "There is no checkpoint yet: resume would begin at step 0.")
    if not planned:
        return Finding(NOTE, "There is no whole planned checkpoint: resume would begin at step 0.")
    try:
        with parsing(planned[-1].path):
            steps = ", ".join(f"{found.numbers['step']:,}" for found in whole if found.path.name != BEST)
            # The run may have been extended since.
            record = read_json(path / CONFIG) if is_whole(path / CONFIG) else planned[-1].record
            last, total = planned[-1].numbers["step"], record["config"]["total_steps"]
            what = "it is finished" if last >= total else f"resume goes on from step {last:,}"
    except DamagedFileError as error:
        return Finding(BAD, str(error))
    return Finding(GOOD, f"Whole checkpoints: {steps}; {what}.")


def _metrics(path: Path, whole: list[checkpoint.Checkpoint]) -> Iterator[Finding]:
    steps = [found.record.get("logged") for found in whole]
    logged = max((step for step in steps if isinstance(step, int)), default=0)
    if sentence := damage(path, logged):
        kept = "" if _is_finished(path) else " The other lines serve; resume keeps the damaged file beside the new one."
        yield Finding(BAD, f"{sentence}{kept}")
    elif lines := read_metrics(path):
        yield Finding(GOOD, f"{METRICS}: {len(lines):,} lines up to step {lines[-1]['step']:,}.")


def _is_finished(path: Path) -> bool:
    """Whether nothing is left to train, so that nothing is repaired either."""
    return is_whole(path / CONFIG) and is_finished(path)


def _is_locked(path: Path) -> bool:
    try:
        with locked(path):
            return False
    except UserError:
        return True
    except OSError:  # read-only: nobody can train there
        return False
