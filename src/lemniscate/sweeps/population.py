"""Population-based training: the settings change while the runs are trained.

Jaderberg et al. 2017, arXiv:1711.09846, sections 3 and 4. All members of a population take a tenth of their steps; then
each of the worst quarter goes on as a copy of one of the best quarter, with settings near to its own. A member is a run
for each seed, compared by the interquartile mean over them.

    population.json    for each tenth: the settings of every member, and of whom it is a copy
    trials/003-04/…    the runs of member 3 since its fourth tenth
"""

import time
from dataclasses import replace
from shutil import copytree
from types import FrameType
from typing import Any

import numpy as np

from lemniscate.cluster.connection import Cluster
from lemniscate.errors import SweepError, resume_line
from lemniscate.report import tuning as pictures
from lemniscate.run.directory import CONFIG, LOCK
from lemniscate.run.places import LOG, failure_of
from lemniscate.run.seeding import derive
from lemniscate.run.stopping import Stopped, stop_signals_to
from lemniscate.run.sweep_file import Sweep, is_sweep
from lemniscate.sweeps.space import sample, vary
from lemniscate.sweeps.study import PRESET, TENTHS, Search, Tuned, as_text, final_score, has_come, score_at
from lemniscate.sweeps.sweep import POLL_SECONDS, places_on
from lemniscate.system.console import say
from lemniscate.system.files import read_json, remove, write_json

POPULATION = "population.json"
QUARTER = 4


class Population:
    """The members of a population, and the processes that train their runs.

    Args:
        search: what is searched; its trials are the members.
        progress: a line on standard error for each copy.
        cluster: where the runs are trained; None for this machine.
    """

    def __init__(self, search: Search, progress: bool, cluster: Cluster | None) -> None:
        self._search, self._space, self._progress = search, search.space, progress
        self._places = places_on(cluster, [search.config.to_json()])
        self._file, self._stop_signal = search.path / POPULATION, 0
        self._tenths: list[list[dict[str, Any]]] = read_json(self._file)["tenths"] if self._file.exists() else []

    def train(self) -> Tuned:
        """Train all members to their end. Raises `Stopped` after a signal."""
        count, seeds = self._search.trials, len(self._search.seeds)
        if not self._tenths:
            self._append([{"settings": settings, "copy_of": None} for settings in self._first_settings()])
        self._say(
            f"{self._search.path}: a population of {count}, with {seeds} seeds each, {self._places.count} runs at a"
            f" time, tenth {len(self._tenths)} of {TENTHS}: {self._search.what}"
        )
        try:
            with stop_signals_to(self._stop):
                scores = self._train_tenth()
                while len(self._tenths) < TENTHS:
                    self._append(self._next(scores))
                    scores = self._train_tenth()
        finally:
            self._places.close()
        return self._result(scores)

    def _first_settings(self) -> list[dict[str, Any]]:
        """The preset's settings as they are, and others from anywhere in the ranges."""
        rng = np.random.default_rng(derive(self._search.seeds[0]))
        own = {name: getattr(self._search.config, name) for name in self._space}
        return [own, *(sample(self._space, rng) for _ in range(self._search.trials - 1))]

    def _append(self, members: list[dict[str, Any]]) -> None:
        self._tenths.append(members)
        write_json(self._file, {"tenths": self._tenths})

    def _next(self, scores: list[float]) -> list[dict[str, Any]]:
        """The members of the next tenth: the worst quarter as copies of the best one, once all have ended episodes."""
        tenth = len(self._tenths)
        rng = np.random.default_rng(derive(self._search.seeds[0], tenth))
        order = sorted(range(len(scores)), key=lambda member: -scores[member])
        quarter = 0 if any(map(np.isnan, scores)) else -(-len(order) // QUARTER)
        best, worst = order[:quarter], order[len(order) - quarter :]
        if max(scores) == -np.inf:
            raise SweepError(f"Every member of the population failed; {LOG} in each of its runs says why.")
        members = [{"settings": dict(old["settings"]), "copy_of": None} for old in self._tenths[-1]]
        for member in sorted(worst):
            source = int(rng.choice(best))
            if scores[source] > scores[member]:
                settings = vary(self._space, self._tenths[-1][source]["settings"], rng)
                members[member] = {"settings": settings, "copy_of": source}
                self._say(
                    f"tenth {tenth}: member {member}, {scores[member]:,.1f}, goes on as a copy of member {source},"
                    f" {scores[source]:,.1f}, with {as_text(settings)}"
                )
        return members

    def _train_tenth(self) -> list[float]:
        """Train every member to the end of the newest tenth.

        Returns their scores: -inf of one that failed, nan of one that no episode has ended of.
        """
        tenth = len(self._tenths)
        sweeps = [self._sweep(member, tenth) for member in range(self._search.trials)]
        for member, sweep in enumerate(sweeps):
            self._make(member, sweep)
        last = tenth == TENTHS
        until = None if last else tenth * self._search.config.checkpoint_every
        options = [] if last else ["--callbacks", f"lemniscate.api.options:StopAt(steps={until})"]
        waiting = [run for sweep in sweeps for run in sweep.runs if not has_come(run, until)]
        failed = set()
        while self._places.running or (waiting and not self._stop_signal):
            while waiting and self._places.free and not self._stop_signal:
                self._places.start(waiting.pop(0), options)
            time.sleep(POLL_SECONDS)
            for run, code in self._places.ended().items():
                if code and not self._stop_signal:
                    failed.add(run)
                    self._say(f"{run}: {failure_of(run, code)} ({run / LOG} says more)")
        if self._stop_signal:
            again = resume_line(self._search.path)
            raise Stopped(f"Stopped; the runs that had begun are saved. Go on with: {again}", self._stop_signal)
        return [-np.inf if failed & set(sweep.runs) else self._score(sweep, until) for sweep in sweeps]

    def _score(self, sweep: Sweep, step: int | None) -> float:
        score = final_score(sweep.runs) if step is None else score_at(sweep.runs, step)
        return np.nan if score is None else score

    def _sweep(self, member: int, tenth: int) -> Sweep:
        """The runs of a member in a tenth, counted from 1: in the directory that was made when it was copied last."""
        since = max((t for t in range(1, tenth) if self._tenths[t][member]["copy_of"] is not None), default=0)
        return self._search.sweep(f"{member:03d}-{since + 1:02d}", self._tenths[since][member]["settings"])

    def _make(self, member: int, sweep: Sweep) -> None:
        """Make the directory of a member, new or as a copy, unless it is there."""
        source = self._tenths[-1][member]["copy_of"]
        if not is_sweep(sweep.path):
            if source is None:
                sweep.create()
            else:
                self._copy(self._sweep(source, len(self._tenths) - 1), sweep)
        sweep.create_runs()

    def _copy(self, source: Sweep, sweep: Sweep) -> None:
        """The runs of another member with their checkpoints, and with configs of their own: whole or not at all."""
        new = replace(sweep, path=sweep.path.with_name("incoming"))
        remove(new.path)
        new.create()
        new.create_runs()
        for theirs, ours in zip(source.runs, new.runs, strict=True):
            copytree(theirs, ours, dirs_exist_ok=True, ignore=lambda _, names: {CONFIG, LOCK, LOG} & set(names))
        new.path.rename(sweep.path)

    def _result(self, scores: list[float]) -> Tuned:
        best = int(np.argmax(scores))
        if not np.isfinite(scores[best]):
            raise SweepError(f"Every member of the population failed; {LOG} in each of its runs says why.")
        path, settings = self._search.path, [member["settings"] for member in self._tenths[-1]]
        preset = self._search.preset(f"member {best} in its last tenth", settings[best], scores[best])
        preset.write(path / PRESET)
        self._say(f"Best of {len(scores)} members: number {best}, score {scores[best]:,.1f}.")
        self._say(f"Its runs are in {self._sweep(best, TENTHS).path}; its settings changed on the way: {self._file}")
        for picture in pictures.draw_population(self._tenths, best, list(self._space), path / "plots"):
            self._say(str(picture))
        trials = [{"number": i, "score": scores[i], **settings[i]} for i in range(len(scores))]
        return Tuned(path, preset, scores[best], trials)

    def _stop(self, signum: int = 0, _frame: FrameType | None = None) -> None:
        """Ask every process to save and stop; asked twice, it does not wait for the end of its update."""
        self._stop_signal = self._stop_signal or signum
        self._places.stop()

    def _say(self, text: str) -> None:
        if self._progress:
            say(text)
