"""Text for people: lines and progress, on standard error or below the cell of a notebook.

Standard output is left to programs; in a notebook nothing reads it, and standard error looks like a failure there.
"""

import os
import select
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from datetime import timedelta
from typing import Any, NamedTuple, TextIO


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
    with suppress(OSError, ValueError):
        if str(text) and _takes_a_line(stream):
            print(text, file=stream, flush=True)


def _takes_a_line(stream: TextIO, seconds: float = 1.0) -> bool:
    try:
        return bool(select.select((), (stream,), (), seconds)[1])
    except (OSError, ValueError, TypeError):  # no file of the system
        return True


def pace(rate: float, episode_return: float | None, steps_left: int, at_the_end: str) -> str:
    """The speed of a run in steps per second, its return, and the time that is left, or else what is at the end."""
    ret = "–" if episode_return is None else f"{episode_return:.1f}"
    left = f"{clock(steps_left / rate)} left" if rate and steps_left > 0 else at_the_end
    return f"{rate:,.0f} steps/s  return {ret}  {left}"


def clock(seconds: float) -> str:
    """Hours, minutes and seconds: 0:00:18."""
    return str(timedelta(seconds=round(seconds)))


class Line(NamedTuple):
    """A line of a progress display: `done` of `total` steps, with a short text before the bar and one after it."""

    name: str
    done: int
    total: int
    text: str


class Place:
    """A place below the cell for one object, which the next one replaces; a saved notebook holds the last."""

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, shown: Any, **how: Any) -> None:
        """Show an object in the place of the one before; `how` is for IPython's `display`."""
        from IPython.display import display

        if self._handle is None:
            self._handle = display(shown, display_id=True, **how)
        else:
            self._handle.update(shown, **how)


class ProgressBar:
    """The progress of one run, or of several: live bars in a terminal, live lines in a notebook, else ten lines.

    `done` of the `total` steps of all runs together were taken before.
    """

    def __init__(self, total: int, done: int, visible: bool = True) -> None:
        self._cell = Place() if visible and in_notebook() else None
        self._text, self._shown_at = "", -float("inf")
        """the newest text below the cell, and when one was shown there"""
        self._bars: Any = _live() if visible and not self._cell else None
        self._visible, self._total, self._tenth = visible, total, 10 * done // total
        self._started = self._updated_at = time.monotonic()
        self._step, self._learned = done, True

    def update(self, step: int, episode_return: float | None, learned: bool = True) -> None:
        """Show that a single run has reached `step`, and the mean return of its last episodes.

        The time left is by the speed since the last call, and unknown where a part of that was not `learned` from.
        """
        now, total, known = time.monotonic(), self._total, learned and self._learned
        rate = (step - self._step) / (now - self._updated_at + 1e-9)
        self._step, self._updated_at, self._learned = step, now, learned
        passed = f"{clock(now - self._started)} {'so far' if step < total else 'in all'}"
        name = f"{step:,} of {total:,} steps"
        if step > total:
            name = f"{step:,} steps, the end of the update that reached {total:,}"
        self.show(Line(name, step, total, pace(rate, episode_return, known * (total - step), passed)))

    def show(self, whole: Line, runs: Sequence[Line] = ()) -> None:
        """Show how far all have come together, and each of the runs that are under way."""
        tenth = 10 * whole.done // self._total
        if self._bars:
            self._bars.update(_table(whole, *runs))
        elif self._cell or (self._visible and tenth > self._tenth):
            text = f"{whole.name}  {whole.text}"
            for run in runs:
                text += f"\n  {run.name}: {run.text}"
            if self._cell:
                filled = round(20 * min(1.0, whole.done / self._total))
                self._text = f"{'━' * filled}{'╌' * (20 - filled)} {text}"
                if time.monotonic() - self._shown_at >= 0.2:
                    self._show_text(self._cell)
            else:
                self._tenth = tenth
                say(text)

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        if self._bars:
            with suppress(OSError):  # the terminal may be gone
                self._bars.console.print(text, highlight=False, markup=False, soft_wrap=True)
        elif self._visible:
            say(text)

    def close(self) -> None:
        """Leave the terminal as it was, or the last line below the cell."""
        if self._bars:
            with suppress(OSError):
                self._bars.stop()
        if self._cell and self._text:
            self._show_text(self._cell)

    def _show_text(self, cell: Place) -> None:
        cell.show({"text/plain": self._text}, raw=True)  # no widget, which a saved notebook cannot show
        self._shown_at = time.monotonic()


def _live() -> Any:
    """Rich's display of what changes, begun; None where standard error is no terminal."""
    from rich.console import Console  # here, because commands that train nothing need not wait for it
    from rich.live import Live

    console = Console(stderr=True)
    if not console.is_terminal:
        return None
    live = Live(console=console, refresh_per_second=10)
    live.start()
    return live


def _table(*lines: Line) -> Any:
    from rich.progress_bar import ProgressBar as Bar
    from rich.table import Column, Table

    table = Table.grid(*[Column(no_wrap=True) for _ in range(3)], padding=(0, 1))
    for name, done, total, text in lines:
        table.add_row(name, Bar(total, done, width=20), f"{min(100, 100 * done / total):>3.0f}%  {text}")
    return table
