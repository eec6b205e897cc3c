"""Text for people: lines and a progress bar on standard error. Standard output is left to programs."""

import sys
import time
from typing import Any


def say(text: object) -> None:
    """Print one line on standard error."""
    print(text, file=sys.stderr, flush=True)


class ProgressBar:
    """Steps, steps per second, return and time left: a live bar in a terminal or a notebook, else ten lines a run."""

    def __init__(self, total: int, done: int, visible: bool = True) -> None:
        from rich.console import Console  # here, because commands that train nothing need not wait for it

        console = Console(stderr=True)
        live = visible and (console.is_terminal or console.is_jupyter)
        self._bar: Any = _live_bar(console) if live else None
        self._lines = visible and not live
        self._total, self._tenth = total, 10 * done // total
        self._started, self._done_before = time.monotonic(), done
        if self._bar:
            self._task = self._bar.add_task("", total=total, completed=done, steps="", speed="", ret="–")
            self._bar.start()

    def update(self, step: int, episode_return: float | None) -> None:
        """Show that `step` is reached, and the mean return of the last episodes."""
        rate = (step - self._done_before) / (time.monotonic() - self._started + 1e-9)
        ret = "–" if episode_return is None else f"{episode_return:.1f}"
        steps, speed = f"{step:,} of {self._total:,} steps", f"{rate:,.0f} steps/s"
        if self._bar:
            self._bar.update(self._task, completed=step, steps=steps, speed=speed, ret=ret)
        elif self._lines and 10 * step // self._total > self._tenth:
            self._tenth = 10 * step // self._total
            left = max(0.0, (self._total - step) / rate)
            say(f"{steps}  {speed}  return {ret}  {left:.0f} s left")

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._bar:
            self._bar.stop()


def _live_bar(console: Any) -> Any:
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    numbers = TextColumn("{task.percentage:>3.0f}%  {task.fields[speed]}  return {task.fields[ret]}  left")
    return Progress(TextColumn("{task.fields[steps]}"), BarColumn(), numbers, TimeRemainingColumn(), console=console)
