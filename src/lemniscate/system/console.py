"""Text for people: lines and a progress bar, on standard error or below the cell of a notebook.

Standard output is left to programs; in a notebook nothing reads it, and standard error looks like a failure there.
"""

import os
import select
import sys
import time
from contextlib import suppress
from typing import Any, TextIO

from lemniscate.system.notebook import CellText, drawn_bar


def in_notebook() -> bool:
    """Whether this is a cell of a notebook, which can show pictures, and not a terminal."""
    if "IPython" not in sys.modules:
        return False
    from IPython.core.getipython import get_ipython

    return hasattr(get_ipython(), "kernel")


def talks() -> bool:
    """Whether this process is the one of its run that talks: rank 0, or the only one."""
    return os.environ.get("RANK", "0") == "0"


def say(text: object) -> None:
    """Print one line, if there is any, on standard error; in a notebook on standard output.

    A line that is not taken within a second, since a pager stands still, or not at all any more, is left out: no run
    waits or ends for want of a reader.
    """
    stream = sys.stdout if in_notebook() else sys.stderr
    with suppress(OSError):
        if str(text) and _takes_a_line(stream):
            print(text, file=stream, flush=True)


def _takes_a_line(stream: TextIO, seconds: float = 1.0) -> bool:
    try:
        return bool(select.select((), (stream,), (), seconds)[1])
    except (OSError, ValueError, TypeError):  # no file of the system
        return True


class ProgressBar:
    """Steps, steps per second, return and time left: a live bar in a terminal, a live line in a notebook, else ten."""

    def __init__(self, total: int, done: int, visible: bool = True) -> None:
        self._cell = CellText() if visible and in_notebook() else None
        self._bar: Any = _live_bar(total, done) if visible and not self._cell else None
        self._lines = visible and not self._cell and not self._bar
        self._total, self._tenth = total, 10 * done // total
        self._started, self._done_before = time.monotonic(), done

    def update(self, step: int, episode_return: float | None) -> None:
        """Show that `step` is reached, and the mean return of the last episodes."""
        seconds = time.monotonic() - self._started + 1e-9
        rate = (step - self._done_before) / seconds
        ret = "–" if episode_return is None else f"{episode_return:.1f}"
        steps, speed = f"{step:,} of {self._total:,} steps", f"{rate:,.0f} steps/s"
        left = f"{(self._total - step) / rate:.0f} s left" if step < self._total else f"{seconds:.0f} s"
        if self._bar:
            self._bar.update(self._bar.task_ids[0], completed=step, steps=steps, speed=speed, ret=ret)
        elif self._cell:
            self._cell.show(f"{drawn_bar(step / self._total)} {steps}  {speed}  return {ret}  {left}")
        elif self._lines and 10 * step // self._total > self._tenth:
            self._tenth = 10 * step // self._total
            say(f"{steps}  {speed}  return {ret}  {left}")

    def close(self) -> None:
        """Leave the terminal as it was, or the last line below the cell."""
        if self._bar:
            with suppress(OSError):  # the terminal may be gone
                self._bar.stop()
        if self._cell:
            self._cell.flush()


def _live_bar(total: int, done: int) -> Any:
    """A started bar with one task; None where standard error is no terminal."""
    from rich.console import Console  # here, because commands that train nothing need not wait for it
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        return None
    numbers = TextColumn("{task.percentage:>3.0f}%  {task.fields[speed]}  return {task.fields[ret]}  left")
    bar = Progress(TextColumn("{task.fields[steps]}"), BarColumn(), numbers, TimeRemainingColumn(), console=console)
    bar.add_task("", total=total, completed=done, steps="", speed="", ret="–")
    bar.start()
    return bar
