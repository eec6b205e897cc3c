"""Processes that end together: the watch of a run's processes over each other, and of one over its owner.

In a run of several processes, one that dies, hangs or fails is named to all: a thread of every process writes to the
common store twice a second what its process does, and reads what the others write. A process that works for another,
such as the worker of an environment, ends with it, however that ends.
"""

import faulthandler
import json
import math
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from lemniscate.errors import UserError
from lemniscate.system.console import say

PATIENCE = "LEMNISCATE_PATIENCE"
"""the environment variable that has the seconds a process may take for a step; 8 by default"""
EVERY = 0.5
"""seconds between two looks"""
BUSY = 30.0
"""seconds that a busy process may be silent: a compiler, or a simulator that is being made, may let no thread run"""
GRACE = 1.0
"""seconds that a process has to end by itself once one of them has failed"""
OWNED = "LEMNISCATE_OWNED"
"""in the environment of a process that works for another: the file of the pipe from there"""
DEAD = " does not answer any more: it was killed or stopped, or its machine is gone."


@dataclass
class Beat:
    """The last message of another process, and the time since which it is unchanged, by this machine's clock."""

    said: dict[str, Any]
    beats_at: float
    steps_at: float


def patience() -> float:
    """The seconds in the variable `PATIENCE`. Raises `UserError` where it is no such number."""
    text = os.environ.get(PATIENCE, "8")
    with suppress(ValueError):
        if 0 < float(text) < math.inf:
            return float(text)
    raise UserError(f"{PATIENCE} must be a number of seconds above 0, not {text!r}.")


class Watch:
    """One process's part of the watch; the `store` is a connection of its own to what the processes share."""

    def __init__(self, store: Any, rank: int, size: int) -> None:
        self.steps = 0
        """counts whatever this process does"""
        self._more: Callable[[], int] = int
        self._store, self._rank, self._size = store, rank, size
        self._doing, self._patience = "busy", patience()
        self._others: dict[int, Beat] = {}
        self._closed, self._nowhere = threading.Event(), open(os.devnull, "w")  # noqa: SIM115, PTH123
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @contextmanager
    def state(self, doing: str) -> Iterator[None]:
        """Inside, this process is "waiting" for others or "busy", and nobody counts its seconds."""
        before, self._doing = self._doing, doing
        if doing == "busy":
            faulthandler.cancel_dump_traceback_later()
        try:
            yield
        finally:
            self._doing = before
            self.steps += 1

    def begin(self, steps: Callable[[], int]) -> None:
        """From here on this process makes steps: these, and what it counts here."""
        self._more, self._doing = steps, "steps"

    def fail(self, reason: str) -> str:
        """Tell the others why this process ends; returns the sentence, empty if another one has failed before."""
        self._accuse(self._rank, f": {reason}")
        fault = self.fault()
        return fault["sentence"] if fault and fault["by"] == self._rank else ""

    def why(self) -> str:
        """Why the others cannot be reached; waits for one of them to be found out. Empty if another process says it."""
        deadline = time.monotonic() + self._patience + GRACE
        while not (fault := self.fault()) and time.monotonic() < deadline:
            time.sleep(EVERY / 2)
            for rank, beat in self._others.items():
                if beat.said["doing"] != "left" and time.monotonic() - beat.beats_at > 4 * EVERY:
                    self._accuse(rank, DEAD)
        if not fault:
            return "The connection to the other processes is lost."
        return fault["sentence"] if fault["by"] == self._rank and fault["rank"] != self._rank else ""

    def close(self) -> None:
        """Say goodbye, and stop watching."""
        self._closed.set()
        self._thread.join()

    def _run(self) -> None:
        count = 0
        with suppress(RuntimeError):  # the store is gone, with the process that ran it
            while not self._closed.is_set():
                count += 1
                if self._doing != "busy":  # ends this process even where C code never lets this thread run again
                    faulthandler.dump_traceback_later(self._patience + GRACE, exit=True, file=self._nowhere)
                self._say(count)
                if fault := self.fault():
                    self._end(fault)
                self._look()
                self._closed.wait(EVERY)
            faulthandler.cancel_dump_traceback_later()
            self._doing = "left"
            self._say(count + 1)
            return
        faulthandler.cancel_dump_traceback_later()

    def _say(self, count: int) -> None:
        doing = {"doing": self._doing, "steps": self.steps + self._more(), "count": count}
        where = {"pid": os.getpid(), "host": socket.gethostname()}
        self._store.set(f"beat-{self._rank}", json.dumps(doing | where))

    def _look(self) -> None:
        now = time.monotonic()
        for rank in set(range(self._size)) - {self._rank}:
            if not self._store.check([f"beat-{rank}"]):
                continue
            said, last = json.loads(self._store.get(f"beat-{rank}")), self._others.get(rank)
            silence = max(BUSY, self._patience) if said["doing"] == "busy" else self._patience
            if last is None or said["count"] != last.said["count"]:
                moved = last is None or said["steps"] != last.said["steps"] or said["doing"] != "steps"
                self._others[rank] = Beat(said, now, now if last is None or moved else last.steps_at)
            elif said["doing"] != "left" and now - last.beats_at > silence:
                self._accuse(rank, DEAD)
            if said["doing"] == "steps" and now - self._others[rank].steps_at > self._patience:
                slow = f"where steps may take longer, set {PATIENCE}"
                self._accuse(rank, f" has made no step for {self._patience:g} s; {slow}.")

    def _accuse(self, rank: int, reason: str) -> None:
        """Name the process at fault in the store, unless one is named already."""
        said = self._others[rank].said if rank in self._others else {"host": socket.gethostname(), "pid": 0}
        sentence = f"Rank {rank} on {said['host']}{reason}"
        fault = {"rank": rank, "host": said["host"], "pid": said["pid"], "sentence": sentence, "by": self._rank}
        with suppress(RuntimeError):
            self._store.compare_set("fault", "", json.dumps(fault))

    def fault(self) -> dict[str, Any] | None:
        """The report on the process at fault; None if there is none, or if the store cannot be reached."""
        with suppress(RuntimeError):
            if self._store.check(["fault"]):
                return json.loads(self._store.get("fault"))
        return None

    def _end(self, fault: dict[str, Any]) -> None:
        """End the process at fault if it is on this machine, and this one if it does not end by itself."""
        if fault["pid"] and fault["rank"] != self._rank and fault["host"] == socket.gethostname():
            with suppress(ProcessLookupError, PermissionError):
                os.kill(fault["pid"], signal.SIGKILL)
        if not self._closed.wait(GRACE):
            if fault["by"] == self._rank and fault["rank"] != self._rank:
                say(f"{fault['sentence']} All processes of the run end.")
            os._exit(1)


def end_with_owner() -> bool:
    """End this process with its owner, if it was started with `OWNED`; returns whether it was."""
    pipe = os.environ.pop(OWNED, None)
    if pipe and sys.platform != "linux":  # a run of a sweep
        end_when_closed(0)
    elif pipe:
        end_when_closed(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK))
    return bool(pipe)


def end_when_closed(pipe: int) -> None:
    """Have the system end this process once nobody holds the writing end of `pipe`, whose reading end this is.

    The signal comes from the kernel, so it also ends a process that is caught in a loop. No data may come.
    """
    if sys.platform != "linux":  # there no signal comes from a pipe: a thread has to wait
        threading.Thread(target=lambda: os.read(pipe, 1) or os._exit(1), daemon=True).start()
        return
    import fcntl

    fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)  # sends SIGIO, which terminates
    if select.select([pipe], [], [], 0)[0]:  # closed before
        os._exit(1)
