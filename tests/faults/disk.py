"""A disk that is watched and that can fail (`disk.c`), and the states that one may hold after a power cut."""

import random
import shutil
import subprocess
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from forks import LEMNISCATE, Forks, command

HERE = Path(__file__).parent


@cache
def library():
    """`disk.c`, compiled."""
    built = Path(mkdtemp(prefix="disk-")) / "disk.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", built, HERE / "disk.c", "-ldl"], check=True)
    return built


class Trials:
    """Commands of lemniscate on a watched disk."""

    def __init__(self):
        self._forks = Forks(
            f"{LEMNISCATE}; import ctypes; disk = ctypes.CDLL('{library()}')", LD_PRELOAD=str(library())
        )

    def run(self, root, *arguments, log="", fail=(0, 0, 0), kill=0, after=None):
        """Run a command while the disk below `root` is watched; returns its exit code and what it wrote.

        Args:
            root: the directory; it exists. Nothing is watched below "".
            arguments: of the command.
            log: a file for the events.
            fail: (first event, last event, errno) that fail.
            kill: the number of the event before which the process kills itself.
            after: seconds from its start, after which it is killed.
        """
        watched = f"{str(root)!r}.encode(), {str(log)!r}.encode(), {fail[0]}, {fail[1]}, {fail[2]}, {kill}"
        before = f"from __main__ import disk; disk.disk_watch({watched})"
        process = command(*arguments, before=before, server=self._forks)
        if after is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(after)
            process.kill()
        said = "".join(process.communicate())
        return process.returncode, said

    def close(self):
        """End the process that they are forked from."""
        self._forks.close()


@dataclass(frozen=True)
class Event:
    """One call that changed the disk. `offset` of a resize is the size; `second` is the new name in a rename."""

    kind: str
    path: Path
    second: Path
    offset: int
    content: bytes


def read_log(file):
    """The events in a log."""
    text, events = Path(file).read_bytes(), []
    while text:
        line, _, text = text.partition(b"\n")
        kind, offset, length, names = line.decode().split(" ", 3)
        first, second = names.split("\t")
        events.append(Event(kind, Path(first), Path(second), int(offset), text[: int(length)]))
        text = text[int(length) :]
    return events


@dataclass
class Node:
    """A file or, with `entries`, a directory: what the system shows, and what is certain to be on the disk."""

    entries: dict[str, "Node"] | None = None
    content: bytearray = field(default_factory=bytearray)
    synced: bytes = b""
    synced_entries: dict[str, "Node"] = field(default_factory=dict)


class Disk:
    """A model of the directory `root`: apply events, then ask for a state that a power cut may leave.

    Certain is what was synced: the bytes of a file, the names in a directory. Of everything else each file and each
    directory may have any part: the old, the new, or (of the bytes of a file) a piece of the new.
    """

    def __init__(self, root):
        self.root, self.tree = Path(root), Node({})

    def _find(self, path):
        node = self.tree
        for name in Path(path).relative_to(self.root).parts:
            node = node.entries[name]
        return node

    def apply(self, event):
        """Do what the event did."""
        if event.kind == "sync":
            self._see_rename(event.path)
            node = self._find(event.path)
            if node.entries is None:
                node.synced = bytes(node.content)
            else:
                node.synced_entries = dict(node.entries)
        elif event.kind in ("write", "truncate", "resize"):
            content = self._find(event.path).content
            if event.kind == "write":
                content.extend(bytes(max(0, event.offset - len(content))))
                content[event.offset : event.offset + len(event.content)] = event.content
            else:
                size = event.offset if event.kind == "resize" else 0
                del content[size:]
                content.extend(bytes(size - len(content)))
        else:
            folder = self._find(event.path.parent)
            if event.kind in ("create", "mkdir"):
                folder.entries[event.path.name] = Node({} if event.kind == "mkdir" else None)
            elif event.kind == "remove":
                folder.entries.pop(event.path.name, None)
            elif event.kind == "rename":
                self._find(event.second.parent).entries[event.second.name] = folder.entries.pop(event.path.name)

    def _see_rename(self, path):
        """Give a file its name: safetensors renames by a system call that is not the C library's, then it is synced."""
        entries = {} if path == self.root else self._find(path.parent).entries
        unnamed = [name for name in entries if name.startswith(".tmp")]
        if unnamed and path.name not in entries:
            entries[path.name] = entries.pop(unnamed[0])

    def write_state(self, folder, rng, how):
        """Write a state after a power cut into the empty directory `folder`.

        `how` is "synced" (only what is certain), "names" (all names, only certain bytes), "all" (everything), or "any"
        (of each file and directory something between, drawn with `rng`).
        """
        self._write(self.tree, Path(folder), rng, how)

    def _write(self, node, path, rng, how):
        if node.entries is None:
            path.write_bytes(self._content(node, rng, how))
            return
        path.mkdir(exist_ok=True)
        for name, child in self._entries(node, rng, how).items():
            self._write(child, path / name, rng, how)

    def _content(self, node, rng, how):
        if how in ("synced", "names") or (how == "any" and rng.random() < 0.3):
            return node.synced
        if how == "all" or rng.random() < 0.5:
            return bytes(node.content)
        torn, length, certain = bytearray(node.content), len(node.content), len(node.synced)
        begin = rng.randrange(length + 1)  # some of the new bytes have not arrived
        end = rng.randrange(begin, length + 1)
        torn[begin:end] = node.synced[begin:end].ljust(end - begin, b"\0")
        return bytes(torn[: rng.randrange(certain, length + 1)] if certain < length and rng.random() < 0.5 else torn)

    def _entries(self, node, rng, how):
        if how == "synced":
            return node.synced_entries
        if how in ("names", "all"):
            return node.entries
        entries = {}
        for name in {**node.synced_entries, **node.entries}:
            side = node.entries if rng.random() < 0.5 else node.synced_entries
            if name in side:
                entries[name] = side[name]
        return entries


def states(events, root, seed=0, every=1, draws=1):
    """(events so far, kind, writer of the state) for power cuts after each `every`-th event, `draws` of kind "any"."""
    disk, rng = Disk(root), random.Random(seed)
    for number, event in enumerate(events, start=1):
        disk.apply(event)
        if number % every == 0:
            for how in ("synced", "names", "all", *["any"] * draws):
                yield number, how, lambda folder, how=how: disk.write_state(folder, rng, how)


def fresh(folder):
    """The directory, new and empty."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder
