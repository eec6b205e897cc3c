"""The progress of runs, as their metrics say it, and the live lines of a sweep: a bar for all, and one for each run."""

from collections.abc import Mapping
from contextlib import suppress
from datetime import timedelta
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from lemniscate.run.metrics import read_metrics
from lemniscate.system.console import in_notebook, say
from lemniscate.system.notebook import CellText, drawn_bar

PROGRESS_BYTES = 2**17
"""bytes at the end of a run's metrics that its progress is read from"""


def progress_of(run: Path) -> tuple[int, float | None, float | None]:
    """(step, mean return of the last 100 episodes, steps per second) in the last lines of a run's metrics."""
    lines = read_metrics(run, PROGRESS_BYTES)
    returns = [ret for line in lines for ret in line.get("episode/returns", [])][-100:]
    rates = [line["time/steps_per_second"] for line in lines if "time/steps_per_second" in line]
    mean = sum(returns) / len(returns) if returns else None
    return (lines[-1]["step"] if lines else 0), mean, (rates[-1] if rates else None)


class SweepProgress:
    """Bars in a terminal, lines in a notebook, else one at each tenth of the sweep. The end of a run is a line."""

    def __init__(self, totals: Mapping[str, int], steps: Mapping[str, int], visible: bool = True) -> None:
        self._console = Console(stderr=True)
        self._cell = CellText() if visible and in_notebook() else None
        self._live = visible and not self._cell and self._console.is_terminal
        self._visible, self._lines = visible, visible and not self._live and not self._cell
        self._totals = totals
        self._steps = {name: min(step, totals[name]) for name, step in steps.items()}
        self._under_way: dict[str, str] = {}
        """one line about each run that is under way"""
        self._tasks: dict[str, TaskID] = {}
        self._ended = sum(self._steps[name] >= total for name, total in totals.items())
        self._tenth = 10 * sum(self._steps.values()) // sum(totals.values())
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TextColumn("{task.percentage:>3.0f}%  {task.fields[said]}"),
            console=self._console,
            transient=True,
            disable=not self._live,
        )
        self._whole = self._bars.add_task("all", total=sum(totals.values()), said="")
        self._bars.start()

    def update(self, name: str, step: int, episode_return: float | None, rate: float | None) -> None:
        """Show that a run has reached `step`, at `rate` steps per second in its last update."""
        total = self._totals[name]
        self._steps[name] = min(step, total)
        ret = "–" if episode_return is None else f"{episode_return:.1f}"
        left = f"{timedelta(seconds=round((total - step) / rate))} left" if rate and step < total else "being evaluated"
        line = f"{step:,} steps  {rate:,.0f}/s  return {ret}  {left}" if rate else "starting"
        self._under_way[name] = line
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(name, total=total, said="")
        self._bars.update(self._tasks[name], completed=step, said=line)
        self._show_total()

    def end(self, name: str, sentence: str) -> None:
        """Show that a run has ended, and how."""
        if name in self._tasks:
            self._bars.remove_task(self._tasks.pop(name))
        self._under_way.pop(name, None)
        self._ended += 1
        self.say(f"{name}: {sentence}")
        self._show_total()

    def say(self, text: str) -> None:
        """Print a line above the bars."""
        if self._live:
            with suppress(OSError):  # the terminal may be gone
                self._console.print(text, highlight=False, markup=False, soft_wrap=True)
        elif self._visible:
            say(text)

    def close(self) -> None:
        """Leave the terminal as it was."""
        with suppress(OSError):
            self._bars.stop()
        if self._cell:
            self._cell.flush()

    def _show_total(self) -> None:
        taken, total = sum(self._steps.values()), sum(self._totals.values())
        said = f"{self._ended} of {len(self._totals)} runs ended, {taken:,} of {total:,} steps"
        self._bars.update(self._whole, completed=taken, said=said)
        lines = "".join(f"\n  {name}: {line}" for name, line in self._under_way.items())
        if self._cell:
            self._cell.show(f"{drawn_bar(taken / total)} {said}{lines}")
        if self._lines and 10 * taken // total > self._tenth:
            self._tenth = 10 * taken // total
            say(f"{10 * self._tenth} % of all steps{lines}")
