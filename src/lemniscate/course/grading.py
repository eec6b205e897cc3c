"""`lemniscate grade`: a folder of hand-ins, each read in a process of its own (`handin`) and judged in this one.

What comes from there is JSON on what was read, and tensors, numbers and text on what was seen, which `torch.load` reads
with `weights_only`. No verdict comes from there, and nothing that comes from there is executed.
"""

import csv
import io
import json
import multiprocessing
import os
import shutil
import signal
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from hashlib import sha256
from multiprocessing.connection import wait
from pathlib import Path
from shlex import quote
from shutil import get_terminal_size
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import torch
from rich.cells import cell_len, set_cell_size

from lemniscate import course
from lemniscate.course import handin
from lemniscate.course.exercise import TEMPLATES
from lemniscate.errors import UserError, unknown_name
from lemniscate.run.stopping import Stopped
from lemniscate.system.console import Line, ProgressBar, clock, say
from lemniscate.system.files import (
    DamagedFileError,
    at_home,
    filled,
    make_directory,
    open_regular,
    read_json,
    replace_file,
    write_json,
)
from lemniscate.system.machine import cores, version

READING, WHOLE = 60.0, 600.0
"""seconds in which a hand-in is to be read, and in which all of its exercises are to be tried"""
MOST_COPIED, MOST_PRINTED = 2**26, 2_000
"""bytes of a file, and characters of what is printed that are kept"""
IGNORED = {"venv", "site-packages", "node_modules", "wandb"}
DOCUMENTS = (".pdf", ".doc", ".docx", ".pptx", ".html", ".mp4", ".gif", ".png", ".jpg", ".jpeg")
"""what beside a single file is another's hand-in rather than what the file reads"""


class Trial:
    """A hand-in in its process, on a copy."""

    def __init__(self, path: Path, demanded: list[str]) -> None:
        self.path, self._demanded, self._begun_at = path, demanded, time.monotonic()
        self._folder = TemporaryDirectory(prefix="lemniscate-", ignore_cleanup_errors=True)
        self._work = Path(self._folder.name)
        (self._work / "seen").mkdir()
        for file, name in files_of(path).items():
            copy = self._work / "hand-in" / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            with suppress(PermissionError):  # the record says so
                shutil.copyfile(file, copy)
        forks = "forkserver" in multiprocessing.get_all_start_methods()
        context: Any = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:  # these are imported once, for all
            context.set_forkserver_preload([handin.__name__, "gymnasium.wrappers.vector", "torch._dynamo"])
        self.process = context.Process(target=handin.run, args=(self._work, demanded))
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")  # else a child would run the caller's script once more
        try:
            self.process.start()
        finally:
            sys.modules["__main__"] = main

    @property
    def is_lost(self) -> bool:
        """Whether it was over without a word: another hand-in may have killed the server that starts them all."""
        return self.process.exitcode == 255 and not (self._work / "seen" / "read.json").exists()

    @property
    def is_over(self) -> bool:
        """Whether the process has ended, or its time."""
        limit = WHOLE if (self._work / "seen" / "read.json").exists() else READING
        return not self.process.is_alive() or time.monotonic() > self._begun_at + limit

    def end(self) -> None:
        """End the process, with all that it has started, and remove the copy."""
        if self.process.is_alive():
            handin.end_family(self.process.pid)
        with suppress(ProcessLookupError, PermissionError, AttributeError):  # Windows has no groups
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.join()
        self._folder.cleanup()

    def record(self) -> dict[str, Any]:
        """All that was found, as it is stored."""
        try:
            read = json.loads(self._content("seen/read.json"))
            files = {name: str(read["files"][name]) for name in course.EXERCISES if name in read["files"]}
            names, notes, alone = [*map(str, read["names"])], [*map(str, read["notes"])], bool(read["alone"])
        except (ValueError, LookupError, TypeError):
            files, names, alone = {}, [], True
            notes = [f"While it was read, {handin.ending(self.process.exitcode)}."]
        if not any(file.suffix in handin.SUFFIXES for file in files_of(self.path)):
            notes = ["There is no .py and no .ipynb file."]
        closed = [file.name for file in files_of(self.path) if not os.access(file, os.R_OK)]
        notes = [*notes, *(f"{name} cannot be read: you may not open it." for name in closed)]
        for file in files_of(self.path, large=True):
            size = f"{file.stat().st_size / 2**20:,.0f} MB; at most {MOST_COPIED / 2**20:.0f} are read"
            notes = [*notes, f"{file.name} has {size}: clear the outputs of a notebook."]
        asked = [name for name in course.EXERCISES if name in files or name in self._demanded]
        return {
            "hand_in": self.path.name,
            "exercises": {name: self._finding(name, files.get(name), names) for name in asked},
            "notes": notes,
            "printed": self._content("printed", 4 * MOST_PRINTED).decode("utf-8", "replace")[:MOST_PRINTED],
            "without_network": alone,
            "seconds": round(time.monotonic() - self._begun_at, 2),
        }

    def _finding(self, name: str, file: str | None, names: Sequence[str]) -> dict[str, Any]:
        if file is None:
            near = [each for each in get_close_matches(name, names, n=3, cutoff=0.8) if each != name][:2]
            hint = f"; did you mean {' or '.join(near)}?" if near else "."
            sentence = f"there is no function or class {name}{hint}"
            return {"right": False, "found": False, "file": None, "sentence": sentence}
        right, sentence = False, "its results could not be read."
        with suppress(Exception):  # a hand-in may have put there what it likes
            if seen := self._content(f"seen/{name}.pt"):
                finding = course.EXERCISES[name].judge(name, torch.load(io.BytesIO(seen), weights_only=True))
                right, sentence = finding.right, finding.sentence
            else:
                sentence = self._content(f"seen/{name}.txt").decode() or "it was not tried in time."
        return {"right": right, "found": True, "file": file, "sentence": sentence}

    def _content(self, name: str, most: int = 2**26) -> bytes:
        """The content of a file that the hand-in's process has written; of a link or a pipe nothing."""
        with suppress(DamagedFileError), open_regular(self._work / name) as file:
            return file.read(most)
        return b""


def files_of(path: Path, large: bool = False) -> dict[Path, Path]:
    """The files of a hand-in, with their names in its copy; beside a single file, those that are no code, too.

    With `large`, those that are too large to be read, of code.
    """
    root, every = (path, path.rglob("*")) if path.is_dir() else (path.parent, path.parent.iterdir())
    found = {file: file.relative_to(root) for file in sorted(every) if file.is_file()}
    installed = {file.parent for file in found if file.name == "pyvenv.cfg"}  # whatever the folder's name
    installed |= {file.parent.parent for file in found if file.parent.name == "conda-meta"}
    return {
        file: name
        for file, name in found.items()
        if (file == path or root == path or file.suffix.lower() not in (*handin.SUFFIXES, *DOCUMENTS))
        and not any(part.startswith((".", "__")) or part in IGNORED for part in name.parts if part != "__init__.py")
        and not (installed - {root}).intersection(file.parents)
        and (file.stat().st_size > MOST_COPIED) is large
        and (file.suffix in handin.SUFFIXES or not large)
    }


def grade(folder: str | Path, exercises: str | Sequence[str] = (), *, to: str | Path | None = None) -> dict[str, Any]:
    """Judge a folder of hand-ins; prints a table, and returns what `findings.json` has.

    A hand-in is a .py or .ipynb file, or a folder with several. Its definitions count; each is tried in a process of
    its own, with limits on time and memory and, where the system lets it, without a network. `to` gets `findings.json`,
    for each hand-in `page.html` and Gradescope's `results.json`, and for each exercise a test file for Otter-Grader.
    What has not changed is not judged again.

    Args:
        folder: of the hand-ins; nothing is written there.
        exercises: names such as "gae,Agent", which every hand-in is to have; by default those that are found.
        to: the folder for what is written; by default that of the hand-ins with `-grades` behind its name.

    Raises:
        UserError: a folder that does not exist or has no hand-in; an unknown exercise; a folder that cannot be written.
        Stopped: Ctrl-C; the same call goes on.
    """
    folder = at_home(folder)
    demanded = _demanded(exercises)
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder: name the one that has the hand-ins.")
    visible = [path for path in sorted(folder.iterdir()) if not path.name.startswith((".", "__"))]
    hand_ins = [path for path in visible if path.is_dir() or (path.suffix in handin.SUFFIXES and path.is_file())]
    _tell_left_out(visible, hand_ins)
    if not hand_ins:
        raise UserError(f"{folder} has no hand-in: a .py file, a .ipynb file or a folder for each.")
    path = at_home(to) if to else folder.resolve().with_name(f"{folder.resolve().name}-grades")
    if path.resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{path} is in the folder of the hand-ins: choose another --to.")
    try:
        records = list(_records(hand_ins, demanded, path))
        found = {name for record in records for name in record["exercises"]}
        names = [name for name in course.EXERCISES if name in found]
        grades = {"folder": str(folder), "lemniscate": version(), "exercises": names, "hand_ins": records}
        text = json.dumps(grades, indent=1, ensure_ascii=False)
        replace_file(
            path / "findings.json", text.encode(errors="backslashreplace")
        )  # half a character is none of UTF-8
        make_directory(path / "otter")
        for name in names:
            replace_file(path / "otter" / f"{name}.py", filled(TEMPLATES / "otter.py.j2", {}, name=name).encode())
    except OSError as error:
        raise UserError(f"{error.filename or path} cannot be read or written: {error.strerror or error}.") from error
    except KeyboardInterrupt:
        options = f" --exercises {','.join(demanded)}" * bool(demanded) + f" --to {quote(str(path))}"
        again = f"Go on with: lemniscate grade {quote(str(folder))}{options}"
        raise Stopped(f"Stopped; what was judged is kept. {again}", signal.SIGINT) from None
    columns = min(get_terminal_size((112, 24)).columns, 140)
    say(filled(TEMPLATES / "grades.txt.j2", FILTERS, **grades, columns=columns))
    say(f"Everything is in {path}")
    return grades


def _demanded(exercises: str | Sequence[str]) -> list[str]:
    """The names of exercises, each once. Raises `UserError` for one that there is not, and where none is left."""
    named = exercises.split(",") if isinstance(exercises, str) else exercises
    demanded = list(dict.fromkeys(name.strip() for name in named if name.strip()))
    if exercises and not demanded:
        raise UserError("exercises names none: give some, such as gae,Agent, or leave it out.")
    for name in demanded:
        if name not in course.EXERCISES:
            raise unknown_name("exercise", name, course.EXERCISES)
    return demanded


def _tell_left_out(visible: Sequence[Path], hand_ins: Sequence[Path]) -> None:
    """Say which files, of which a student may think as a hand-in, are not looked into."""
    if others := [path.name for path in visible if path not in hand_ins]:
        named = ", ".join(others[:12]) + f" and {len(others) - 12} more" * (len(others) > 12)
        say(f"Left out: {named}; a hand-in is a .py or .ipynb file, or a folder with several.")


def marks(record: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """For each exercise ✓ right, ✗ wrong, – not there."""
    found = [record["exercises"].get(name, {"found": False}) for name in names]
    return ["–" if not each["found"] else "✓" if each["right"] else "✗" for each in found]


FILTERS = {"cells": set_cell_size, "cell_len": cell_len, "marks": marks}
"""the functions that the template of the table calls"""


def as_csv(grades: Mapping[str, Any]) -> str:
    """A row for each hand-in: how many are right, then 1, 0, or nothing where an exercise is not there."""
    text, names = io.StringIO(), grades["exercises"]
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["hand_in", "right", "of", *names, "notes"])
    for record in grades["hand_ins"]:
        row = [{"✓": 1, "✗": 0, "–": ""}[mark] for mark in marks(record, names)]
        table.writerow([record["hand_in"], row.count(1), len(row), *row, " ".join(record["notes"])])
    return text.getvalue()


def _records(hand_ins: list[Path], demanded: list[str], to: Path) -> Iterator[dict[str, Any]]:
    """The record of each hand-in, which is judged and stored where none is there of what it now contains."""
    judge, digests, waiting = [*Path(__file__).parent.glob("*.py"), *filter(Path.is_file, TEMPLATES.iterdir())], {}, []
    for path in hand_ins:
        digest = sha256(json.dumps([version(), demanded, path.name]).encode())
        for file in (*sorted(judge), *files_of(path)):
            digest.update(os.fsencode(f"\0{file}\0{file.stat().st_size}\0"))
            with suppress(PermissionError):
                digest.update(file.read_bytes())
        digests[path] = digest.hexdigest()
        with suppress(DamagedFileError):
            if read_json(to / path.name / "record.json")["digest"] == digests[path]:
                continue
        waiting.append(path)
    begun, total, done = time.monotonic(), len(hand_ins), len(hand_ins) - len(waiting)
    running, before, bar, again = list[Trial](), done, ProgressBar(total, done), set[Path]()
    try:
        while waiting or running:
            while waiting and len(running) < (1 if again else cores()):
                running.append(Trial(waiting.pop(0), demanded))
            wait([trial.process.sentinel for trial in running], timeout=0.5)
            for trial in [trial for trial in running if trial.is_over]:
                if trial.is_lost and trial.path not in again:  # once more, behind all others and alone
                    again.add(trial.path)
                    waiting.append(trial.path)
                    running.remove(trial)
                    trial.end()
                    continue
                record = trial.record()
                running.remove(trial)
                trial.end()
                _store(to / trial.path.name, record, digests[trial.path])
                done += 1
            pace = (time.monotonic() - begun) / max(done - before, 1)
            bar.show(Line(f"{done} of {total} hand-ins", done, total, f"{clock(pace * (total - done))} left"))
    finally:
        for trial in running:
            trial.end()
        bar.close()
    return (read_json(to / path.name / "record.json")["record"] for path in hand_ins)


def _store(folder: Path, record: Mapping[str, Any], digest: str) -> None:
    """Write the page for the student, the results for Gradescope, and the record, which says that all is there."""
    from lemniscate.report.pages import write_page  # draws, too, which the check of one function need not wait for

    make_directory(folder)
    replace_file(folder / "results.json", filled(TEMPLATES / "results.json.j2", {}, **record).encode())
    right = sum(finding["right"] for finding in record["exercises"].values())
    subtitle = f"{right} of {len(record['exercises'])} exercises are right."
    write_page(folder / "page.html", "hand_in.html.j2", title=record["hand_in"], subtitle=subtitle, **record)
    write_json(folder / "record.json", {"digest": digest, "record": record})
