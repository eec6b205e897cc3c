"""The live line on the terminal: steps, steps per second, return, time left. On standard error."""

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn


class ProgressBar:
    """A bar where there is a terminal or a notebook, a line at each tenth of the run where there is not."""

    def __init__(self, total: int, done: int, visible: bool = True) -> None:
        self._console = Console(stderr=True)
        self._live = visible and (self._console.is_terminal or self._console.is_jupyter)
        self._lines = visible and not self._live
        self._total, self._tenth = total, 10 * done // total
        self._start, self._from = time.monotonic(), done
        if self._live:
            self._bar = Progress(
                TextColumn("{task.fields[steps]}"),
                BarColumn(),
                TextColumn("{task.percentage:>3.0f}%  {task.fields[speed]}  return {task.fields[ret]}  left"),
                TimeRemainingColumn(),
                console=self._console,
            )
            self._task = self._bar.add_task("", total=total, completed=done, steps="", speed="", ret="–")
            self._bar.start()

    def update(self, step: int, episode_return: float | None) -> None:
        """Move on to `step`."""
        rate = (step - self._from) / (time.monotonic() - self._start + 1e-9)
        ret = "–" if episode_return is None else f"{episode_return:.1f}"
        steps, speed = f"{step:,} of {self._total:,} steps", f"{rate:,.0f} steps/s"
        if self._live:
            self._bar.update(self._task, completed=step, steps=steps, speed=speed, ret=ret)
        elif self._lines and 10 * step // self._total > self._tenth:
            self._tenth = 10 * step // self._total
            left = max(0.0, (self._total - step) / rate)
            print(f"{steps}  {speed}  return {ret}  {left:.0f} s left", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Leave the terminal as it was."""
        if self._live:
            self._bar.stop()
