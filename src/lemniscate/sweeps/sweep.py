"""Sweeps: every algorithm with every seed, each in a process of its own, one process per CPU core at a time.

A process resumes one run directory, whether its run has begun or not. So an interrupted sweep goes on as it began, and
each of its runs ends in the same bits as if it had been trained alone. A search (`tuner`) trains its runs by the same
`SetOfRuns`.
"""

import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any

from lemniscate.algos import ALGORITHMS, name_of
from lemniscate.api import plots, training
from lemniscate.api.options import RunOptions, own_names, require_importable
from lemniscate.api.policy import path_of
from lemniscate.api.results import final_return
from lemniscate.cluster.connection import Cluster
from lemniscate.envs import registry
from lemniscate.errors import SweepError, UserError, prefix_errors, resume_line, shown
from lemniscate.hub.repository import local_path
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import is_finished, load_networks, locked
from lemniscate.run.environments import device_for, env_arguments, require_memory
from lemniscate.run.metrics import progress_of
from lemniscate.run.places import LOG, Places, Processes, Sweep, failure_of, read_sweep
from lemniscate.run.seeding import torch_defaults
from lemniscate.run.stopping import Stopped, stop_signals_to
from lemniscate.system.console import Line, ProgressBar, pace, say

MOST_SEEDS = 1_000
"""of a sweep, each of which is a directory and a process"""
POLL_SECONDS = 0.3
"""seconds between two looks at the processes"""


@dataclass(frozen=True)
class TrainedSweep:
    """The result of `train_sweep` and `resume_sweep`: the sweep's directory, and the run directories in it."""

    path: Path
    runs: list[Path]


def train_sweep(
    algorithms: str | Iterable[str],
    env: str | None,
    seeds: str | int | Iterable[int],
    *,
    run: str | Path | None = None,
    preset: str | None = None,
    track: str | None = None,
    callbacks: str | Sequence[str] = (),
    report: bool = False,
    progress: bool = True,
    cluster: str | None = None,
    workers: int | None = None,
    **fields: object,
) -> TrainedSweep:
    """Train every algorithm with every seed, and compare them: a table on standard error, pictures in `plots/`.

    Args:
        algorithms: "ppo,sac", or names in a list.
        env: the environment's id, one for all; None if the preset has one of its own.
        seeds: "1-5", "1,3,7", a number, or numbers in a list.
        run: the sweep's directory; by default a new one under `runs/`.
        preset: by name, for every algorithm; the best known for the environment unless given.
        track: as in `train`, for every run; and so `report` and `progress`.
        callbacks: names of functions, as `module:function`: every run calls them in its own process.
        cluster: "ray" or "ray=ADDRESS": train the runs as Ray tasks, wherever there is room.
        workers: the most runs at a time there; by default as many as the cores serve.
        **fields: any fields that the Configs of all the algorithms have.

    Raises:
        UserError: before anything starts, what an algorithm cannot be trained with.
        Stopped: Ctrl-C or SIGTERM, when every run has saved itself; go on with `resume_sweep`.
        SweepError: some runs failed; the others are trained and compared.
    """
    if "seed" in fields:
        raise UserError("Several runs have several seeds: they are given as seeds, not as seed.")
    names, numbers = algorithms_of(algorithms), seeds_of(seeds)
    configs: dict[str, RunConfig] = {}
    for name in names:
        with prefix_errors(name):
            configs[name] = training.config_for(name, env, preset, **fields)
    if len({config.env for config in configs.values()}) > 1:
        raise UserError("These presets are for different environments; name the one of the whole sweep with env.")
    options = RunOptions(track, callbacks, report, progress, cluster=cluster, workers=workers)
    options.shared()
    require_trainable(configs, numbers)
    stem = f"{'-'.join(names)}-{len(numbers)}-seeds"
    path = path_of(run) if run is not None else training.fresh_directory(next(iter(configs.values())).env, stem)
    records = {name: config.to_json() for name, config in configs.items()}
    but_seed = {name: {k: v for k, v in record.items() if k != "seed"} for name, record in records.items()}
    runs = Sweep(path, numbers, but_seed)
    runs.create()
    return _train(runs, options)


def resume_sweep(
    path: str | Path | TrainedSweep,
    *,
    track: str | None = None,
    callbacks: str | Sequence[str] = (),
    report: bool = False,
    progress: bool = True,
    cluster: str | None = None,
    workers: int | None = None,
) -> TrainedSweep:
    """Resume an interrupted sweep: train the runs that are not finished or have not begun. See `resume`."""
    options = RunOptions(track, callbacks, report, progress, cluster=cluster, workers=workers)
    return _train(read_sweep(path_of(path)), options)


def _train(runs: Sweep, options: RunOptions) -> TrainedSweep:
    with locked(runs.path):
        runs.create_runs()
        failed = _Training(runs, options).train()
    if any(map(is_finished, runs.runs)):
        for picture in plots.plot(runs.path):
            say(picture)
    if failed:
        sentences = "".join(f"\n{name}: {sentence}" for name, sentence in failed.items())
        raise SweepError(
            f"{len(failed)} of {len(runs.runs)} runs could not go on; {LOG} in each says more.{sentences}\n"
            f"Try them again with: {resume_line(runs.path)}"
        )
    return TrainedSweep(runs.path, list(runs.runs))


def places_on(cluster: Cluster | None, configs: Iterable[Mapping[str, Any]]) -> Places:
    """The places of a cluster, or of this machine, for runs of such Configs."""
    configs = list(configs)
    threads = max(config["threads"] for config in configs)
    if cluster is None:
        return Processes(threads)
    from lemniscate.cluster.tasks import RayTasks

    return RayTasks(cluster, threads, gpu=any(config["device"].startswith("cuda") for config in configs))


class SetOfRuns(ABC):
    """Runs that are trained at the places of a machine or of a cluster; asked to stop, all of them save themselves.

    Args:
        path: the directory of the set.
        configs: of its runs.
        cluster: where they are trained; None for this machine.
    """

    def __init__(self, path: Path, configs: Iterable[Mapping[str, Any]], cluster: Cluster | None) -> None:
        self.path = path
        self._places = places_on(cluster, configs)
        self._stop_signal, self._told = 0, False
        """the signal that asked to stop, if one has; whether this was said"""
        self._say: Callable[[str], object] = say
        """says a line, if progress is shown"""

    @abstractmethod
    def _begin_runs(self) -> bool:
        """Start runs while there is room; returns whether anything is left that has not ended or not begun."""

    @abstractmethod
    def _run_ended(self, run: Path, code: int) -> None:
        """Take note of the end of a run."""

    @abstractmethod
    def _is_finished(self) -> bool:
        """Whether nothing is left to be done."""

    def _train_all(self) -> None:
        """Train the runs to their ends. Raises `Stopped` after a signal."""
        try:
            with stop_signals_to(self._stop):
                while (not self._stop_signal and self._begin_runs()) or self._places.running:
                    time.sleep(POLL_SECONDS)
                    self._look()
        finally:
            self._places.close()
        if self._stop_signal and not self._is_finished():
            again = resume_line(self.path)
            raise Stopped(f"Stopped; the runs that had begun are saved. Go on with: {again}", self._stop_signal)

    @property
    def _has_room(self) -> bool:
        """Whether another run may be started now."""
        return self._places.free and not self._stop_signal

    def _start(self, run: Path, options: Sequence[str]) -> None:
        self._places.start(run, options)
        if self._stop_signal:  # the signal came while the process was started, before it was among those to be stopped
            self._places.stop([run])

    def _look(self) -> None:
        """Take note of the runs that have ended since the last look."""
        if self._stop_signal and not self._told:  # said here: a handler may interrupt another line
            self._told = True
            self._say("Stopping: each run ends its update and saves itself.")
        for run, code in self._places.ended().items():
            self._run_ended(run, code)

    def _stop(self, signum: int = 0, _frame: FrameType | None = None) -> None:
        """Ask every process to save and stop; asked twice, it does not wait for the end of its update."""
        self._stop_signal = self._stop_signal or signum
        self._places.stop()


class _Training(SetOfRuns):
    """The runs of a sweep that are to be trained, and the sentences of those that failed."""

    def __init__(self, runs: Sweep, options: RunOptions) -> None:
        self._options = ["--score", *options.words()]
        super().__init__(runs.path, runs.configs.values(), options.cluster)
        self._waiting = [run for run in runs.runs if not is_finished(run)]
        self._failed: dict[str, str] = {}
        self._totals = {run: record["config"]["total_steps"] for run, record in runs.runs.items()}
        self._steps = {run: min(progress_of(run)[0], total) for run, total in self._totals.items()}
        self._ended = len(self._totals) - len(self._waiting)
        self._bar = ProgressBar(sum(self._totals.values()), sum(self._steps.values()), options.progress)
        self._say = self._bar.say

    def train(self) -> dict[str, str]:
        """Train every run to its end; returns the sentences of those that failed. Raises `Stopped` after a signal."""
        count, at_a_time = len(self._waiting), self._places.count
        self._say(f"{self.path}: {count} of {len(self._totals)} runs to train, {at_a_time} at a time")
        try:
            self._train_all()
        finally:
            self._bar.close()
        return self._failed

    def _begin_runs(self) -> bool:
        while self._waiting and self._has_room:
            self._start(self._waiting.pop(0), self._options)
        return bool(self._waiting)

    def _is_finished(self) -> bool:
        return all(map(is_finished, self._totals))

    def _look(self) -> None:
        super()._look()
        lines = [self._line(run) for run in self._places.running]
        steps, total = sum(self._steps.values()), sum(self._totals.values())
        runs = f"{self._ended} of {len(self._totals)} runs ended"
        self._bar.show(Line(runs, steps, total, f"{steps:,} of {total:,} steps"), lines)

    def _line(self, run: Path) -> Line:
        """The progress of a run that is under way."""
        step, episode_return, rate = progress_of(run)
        total = self._totals[run]
        self._steps[run] = min(step, total)
        speed = pace(rate, episode_return, total - step, "being evaluated") if rate else "starting"
        return Line(run.name, step, total, f"{step:,} steps  {speed}")

    def _run_ended(self, run: Path, code: int) -> None:
        step = progress_of(run)[0]
        self._steps[run] = min(step, self._totals[run])
        self._ended += 1
        if code == 0 and not is_finished(run):
            sentence = f"stopped by a callback at step {step:,}; go on with: {resume_line(self.path)}"
        elif code == 0:
            sentence = f"done, final return {final_return(run):.1f}"
        elif self._stop_signal:
            sentence = f"stopped at step {step:,}"
        else:
            sentence = self._failed[run.name] = failure_of(run, code)
        self._say(f"{run.name}: {sentence}")


def algorithms_of(names: str | Iterable[str]) -> list[str]:
    """The names in "ppo,sac" or in a list, each once. Raises `UserError` for one that is unknown."""
    several = names.split(",") if isinstance(names, str) else names if isinstance(names, Iterable) else [names]
    split = [name_of(name.strip() if isinstance(name, str) else name) for name in several]
    if not split:
        raise UserError(f"Name at least one algorithm: {', '.join(ALGORITHMS)}.")
    return list(dict.fromkeys(split))


def seeds_of(seeds: str | int | Iterable[int]) -> list[int]:
    """The seeds in "1-5,8", a number or a list, each once."""
    if not isinstance(seeds, str):
        seeds = getattr(seeds, "tolist", lambda: seeds)()  # of NumPy's and torch's arrays
        given = islice(seeds, MOST_SEEDS + 1) if isinstance(seeds, Iterable) else [seeds]
        numbers_of = [getattr(seed, "item", lambda seed=seed: seed)() for seed in given]  # of NumPy's and torch's
        seeds = ",".join(seed if isinstance(seed, str) else shown(seed) for seed in numbers_of)
    numbers: dict[int, None] = {}
    for part in seeds.split(","):
        ends = re.fullmatch(r"([0-9]{1,20})(?:-([0-9]{1,20}))?", part.strip())
        between = range(int(ends[1]), int(ends[2] or ends[1]) + 1) if ends else range(0)
        if not between:
            raise UserError(f"seeds must be numbers such as 1-5 or 1,3,7, not {shown(seeds)}.")
        numbers |= dict.fromkeys(between[: MOST_SEEDS + 1])
        if len(numbers) > MOST_SEEDS:
            raise UserError(f"A sweep takes at most {MOST_SEEDS:,} seeds, and there are more in {shown(seeds)}.")
    return list(numbers)


@torch_defaults()
def require_trainable(configs: dict[str, RunConfig], seeds: list[int]) -> None:
    """Raise `UserError` where a run could not begin: one sentence now, instead of one from each run."""
    for name, config in configs.items():
        require_importable(*own_names(config))
        device = device_for(config.device)
        for seed in seeds:
            config.replace(seed=seed)
        with prefix_errors(name):
            env = registry.make(num_envs=1, **env_arguments(config, backend=config.backend))
            env.close()
            require_memory(config, env.spec, device)
            networks = config.networks(env.spec)
            if config.warm_start:
                load_networks(networks, config, env.spec, local_path)
