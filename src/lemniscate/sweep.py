"""Sets of runs: every algorithm with every seed, each in a process of its own, as many at once as cores serve.

A process resumes one run directory, whether its run has begun or not; so an interrupted set goes on as it began, and
each of its runs ends in the bits that it would have ended in alone.
"""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from filelock import FileLock, Timeout

from lemniscate import api
from lemniscate.algos import ALGORITHMS
from lemniscate.envs import registry
from lemniscate.errors import SweepError, UserError, prefix_errors, unknown_name
from lemniscate.report.pictures import say
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import is_finished
from lemniscate.run.loggers import read_metrics
from lemniscate.run.progress import SweepProgress
from lemniscate.run.run import Stopped
from lemniscate.run.sweep_file import Sweep, read_sweep

LOG = "log.txt"
"""what a run of a set says, in its directory"""

ENOUGH = 2**17
"""bytes at the end of a run's metrics that are looked at for its progress"""

PAUSE = 0.3
"""seconds between two looks"""


@dataclass(frozen=True)
class TrainedSweep:
    """What `train_sweep` leaves: the set's directory, and the run directories in it."""

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
    report: bool = False,
    progress: bool = True,
    **fields: object,
) -> TrainedSweep:
    """Train every algorithm with every seed, and compare them: a table on standard error, pictures in `plots/`.

    Args:
        algorithms: "ppo,sac", or names in a list.
        env: the environment's id, one for all; None if the preset has one of its own.
        seeds: "1-5", "1,3,7", a number, or numbers in a list.
        run: the set's directory; by default a new one under `runs/`.
        preset: by name, for every algorithm; the best known for the environment unless given.
        track: as in `train`, for every run.
        report: as in `train`, for every run.
        progress: the live lines on standard error.
        **fields: any fields that the Configs of all the algorithms have.

    Raises:
        UserError: before anything starts, what an algorithm cannot be trained with.
        Stopped: Ctrl-C or SIGTERM, when every run has saved itself; go on with `resume_sweep`.
        SweepError: some runs failed; the others are trained and compared.
    """
    names, numbers = algorithms_of(algorithms), _seeds_of(seeds)
    configs: dict[str, RunConfig] = {}
    for name in names:
        with prefix_errors(name):
            configs[name] = api.config_for(name, env, preset, **fields)
    if len({config.env for config in configs.values()}) > 1:
        raise UserError("These presets are for different environments; name the one of the whole set with env.")
    _require_trainable(configs, numbers, track)
    stem = f"{'-'.join(names)}-{len(numbers)}-seeds"
    path = Path(run) if run is not None else api.fresh_directory(next(iter(configs.values())).env, stem)
    records = {name: config.to_json() for name, config in configs.items()}
    but_seed = {name: {k: v for k, v in record.items() if k != "seed"} for name, record in records.items()}
    runs = Sweep(path, numbers, but_seed)
    runs.create()
    return _train(runs, track, report, progress)


def resume_sweep(
    path: str | Path, *, track: str | None = None, report: bool = False, progress: bool = True
) -> TrainedSweep:
    """Go on with an interrupted set: with the runs that are not finished, and those that never began."""
    api.loggers_with(track)
    return _train(read_sweep(Path(path)), track, report, progress)


def at_once(threads: int) -> int:
    """How many runs of so many threads the cores that this process may use can serve; at least one."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // threads)


def _train(runs: Sweep, track: str | None, report: bool, progress: bool) -> TrainedSweep:
    options = [*(["--track", track] if track else []), *(["--report"] if report else [])]
    try:
        with FileLock(runs.path / ".lock", timeout=0):
            runs.create_runs()
            failed = _Crew(runs, options, progress).train()
    except Timeout:
        raise UserError(f"{runs.path} is being trained by another process.") from None
    if any(map(is_finished, runs.runs)):
        for picture in api.plot(runs.path):
            say(picture)
    if failed:
        sentences = "".join(f"\n{name}: {sentence}" for name, sentence in failed.items())
        raise SweepError(f"{len(failed)} of {len(runs.runs)} runs could not go on; {LOG} in each says more.{sentences}")
    return TrainedSweep(runs.path, list(runs.runs))


class _Crew:
    """The processes that train a set, and what became of those that failed."""

    def __init__(self, runs: Sweep, options: list[str], progress: bool) -> None:
        self._runs, self._options = runs, options
        self._waiting = [run for run in runs.runs if not is_finished(run)]
        self._going: dict[Path, subprocess.Popen] = {}
        self._failed: dict[str, str] = {}
        self._stop_signal = 0
        totals = {run.name: record["config"]["total_steps"] for run, record in runs.runs.items()}
        steps = {run.name: _so_far(run)[0] for run in runs.runs}
        self._bars = SweepProgress(totals, steps, progress)

    def train(self) -> dict[str, str]:
        """Every run to its end; returns the sentence of each that failed. Raises `Stopped` after a signal."""
        path, count, told = self._runs.path, len(self._waiting), False
        places = at_once(max(config["threads"] for config in self._runs.configs.values()))
        try:
            self._bars.say(f"{path}: {count} of {len(self._runs.runs)} runs to train, {places} at a time")
            with self._heeding_signals():
                while self._going or (self._waiting and not self._stop_signal):
                    while self._waiting and len(self._going) < places and not self._stop_signal:
                        self._start(self._waiting.pop(0))
                    self._look()
                    if self._stop_signal and not told:
                        told = True
                        self._bars.say("Stopping: each run ends its update and saves itself.")
                    time.sleep(PAUSE)
        finally:
            self._stop()
            for process in self._going.values():
                process.wait()
            self._bars.close()
        if self._stop_signal and not all(map(is_finished, self._runs.runs)):
            said = f"Stopped; what had begun is saved. Go on with: lemniscate resume {path}"
            raise Stopped(said, self._stop_signal)
        return self._failed

    def _start(self, run: Path) -> None:
        """In a session of its own: Ctrl-C at the terminal comes here alone, and each run gets it from here, once."""
        command = [sys.executable, "-m", "lemniscate.cli", "resume", str(run), "--score", *self._options]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        with (run / LOG).open("a") as log:
            self._going[run] = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, start_new_session=True
            )
        if self._stop_signal:  # it came while the process was being made
            self._going[run].terminate()

    def _look(self) -> None:
        """How far is each run; and who has ended, and how?"""
        for run, process in list(self._going.items()):
            step, episode_return, rate = _so_far(run)
            self._bars.update(run.name, step, episode_return, rate)
            code = process.poll()
            if code is None:
                continue
            del self._going[run]
            if code == 0:
                sentence = f"done, final return {api.final_return(run):.1f}"
            elif self._stop_signal:
                sentence = f"stopped at step {step:,}"
            else:
                sentence = self._failed[run.name] = _why(run, code)
            self._bars.end(run.name, sentence)

    def _stop(self, signum: int = 0, _frame: FrameType | None = None) -> None:
        """Ask every process to save and stop; asked again, they do not wait for the end of an update."""
        self._stop_signal = self._stop_signal or signum
        for process in self._going.values():
            process.terminate()

    @contextmanager
    def _heeding_signals(self) -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        heard = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:  # nohup ignores it, and so do we then
            heard.append(signal.SIGHUP)
        previous = {signum: signal.signal(signum, self._stop) for signum in heard}
        try:
            yield
        finally:
            for signum, handler in previous.items():
                signal.signal(signum, handler)


def _so_far(run: Path) -> tuple[int, float | None, float | None]:
    """(step, mean return of the last 100 episodes, steps per second) of a run, as far as it has told."""
    lines = read_metrics(run, ENOUGH)
    returns = [ret for line in lines for ret in line.get("episode/returns", [])][-100:]
    rates = [line["time/steps_per_second"] for line in lines if "time/steps_per_second" in line]
    mean = sum(returns) / len(returns) if returns else None
    return (lines[-1]["step"] if lines else 0), mean, (rates[-1] if rates else None)


def _why(run: Path, code: int) -> str:
    """What a process that failed said last, or what ended it."""
    if code < 0 or code in (130, 143):
        return f"{signal.strsignal(-code if code < 0 else code - 128)}."
    said = (run / LOG).read_text().split("\n")
    return next((line for line in reversed(said) if line.strip()), f"Exit code {code}.")


def algorithms_of(names: str | Iterable[str]) -> list[str]:
    """Each name once, of "ppo,sac" or of a list. Raises `UserError` for one that is unknown."""
    split = [name.strip() for name in (names.split(",") if isinstance(names, str) else names)]
    if not split:
        raise UserError(f"Name at least one algorithm: {', '.join(ALGORITHMS)}.")
    for name in split:
        if name not in ALGORITHMS:
            raise unknown_name("algorithm", name, ALGORITHMS)
    return list(dict.fromkeys(split))


def _seeds_of(seeds: str | int | Iterable[int]) -> list[int]:
    """Each seed once, of "1-5,8", a number or a list."""
    if not isinstance(seeds, str):
        seeds = ",".join(map(str, seeds if isinstance(seeds, Iterable) else [seeds]))
    numbers: list[int] = []
    for part in seeds.split(","):
        ends = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        between = range(int(ends[1]), int(ends[2] or ends[1]) + 1) if ends else ()
        if not between:
            raise UserError(f"seeds must be numbers such as 1-5 or 1,3,7, not {seeds!r}.")
        numbers += between
    return list(dict.fromkeys(numbers))


def _require_trainable(configs: dict[str, RunConfig], seeds: list[int], track: str | None) -> None:
    """Raise `UserError` where a run could not begin: better one sentence now than one from each of them."""
    api.loggers_with(track)
    some = next(iter(configs.values()))
    env = registry.make(some.env, 1, backend=some.backend)
    env.close()
    for name, config in configs.items():
        api.device_for(config.device)
        for seed in seeds:
            config.replace(seed=seed)
        with prefix_errors(name):
            config.networks(env.spec)
