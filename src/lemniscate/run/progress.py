"""The live line on the terminal: steps, steps per second, return, time left. On standard error."""

import sys
import time
from collections.abc import Mapping
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


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


class SweepProgress:
    """A bar for a set of runs and one for each that is going on; without a terminal, lines at each tenth of the set.

    What has ended is told in a line that stays.
    """

    def __init__(self, totals: Mapping[str, int], steps: Mapping[str, int], visible: bool = True) -> None:
        self._console = Console(stderr=True)
        live = visible and (self._console.is_terminal or self._console.is_jupyter)
        self._visible, self._lines = visible, visible and not live
        self._totals = totals
        self._steps = {name: min(step, totals[name]) for name, step in steps.items()}
        self._going: dict[str, str] = {}
        """what is to be said of each run that is going on"""
        self._tasks: dict[str, TaskID] = {}
        self._over = sum(self._steps[name] >= total for name, total in totals.items())
        self._tenth = 10 * sum(self._steps.values()) // sum(totals.values())
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TextColumn("{task.percentage:>3.0f}%  {task.fields[said]}"),
            console=self._console,
            transient=True,
            disable=not live,
        )
        self._whole = self._bars.add_task("all", total=sum(totals.values()), said="")
        self._bars.start()

    def update(self, name: str, step: int, episode_return: float | None, rate: float | None) -> None:
        """A run that is going on has come to `step`, lately at `rate` steps per second."""
        total = self._totals[name]
        self._steps[name] = min(step, total)
        ret = "–" if episode_return is None else f"{episode_return:.1f}"
        left = f"{timedelta(seconds=round((total - step) / rate))} left" if rate and step < total else "being evaluated"
        self._going[name] = f"{step:,} steps  {rate:,.0f}/s  return {ret}  {left}" if rate else "starting"
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(name, total=total, said="")
        self._bars.update(self._tasks[name], completed=step, said=self._going[name])
        self._count()

    def end(self, name: str, sentence: str) -> None:
        """A run is over, or could not go on."""
        if name in self._tasks:
            self._bars.remove_task(self._tasks.pop(name))
        self._going.pop(name, None)
        self._over += 1
        self.say(f"{name}: {sentence}")
        self._count()

    def say(self, text: str) -> None:
        """A line that stays."""
        if self._visible:
            self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def close(self) -> None:
        """Leave the terminal as it was."""
        self._bars.stop()

    def _count(self) -> None:
        taken, total = sum(self._steps.values()), sum(self._totals.values())
        said = f"{self._over} of {len(self._totals)} runs over, {taken:,} of {total:,} steps"
        self._bars.update(self._whole, completed=taken, said=said)
        if self._lines and 10 * taken // total > self._tenth:
            self._tenth = 10 * taken // total
            going = "".join(f"\n  {name}: {said}" for name, said in self._going.items())
            print(f"{10 * self._tenth} % of all steps{going}", file=sys.stderr, flush=True)
