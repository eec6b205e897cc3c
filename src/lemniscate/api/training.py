"""The verbs that train: `train` begins a run, `resume` goes on with one."""

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from lemniscate import algos, presets
from lemniscate.api.callbacks import Callback, PolicySnapshot, call_callbacks
from lemniscate.api.options import RunOptions, own_names, require_importable, train_in_processes
from lemniscate.api.policy import TrainedPolicy, TrainedRun, load, path_of
from lemniscate.doctor import Attendance
from lemniscate.envs import registry
from lemniscate.errors import NotStoredError, UserError, is_installed, shown
from lemniscate.hub.repository import local_path
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import extend, is_finished, read_record, require_absent
from lemniscate.run.environments import envs_of, require_several
from lemniscate.run.loggers import LoggerClass
from lemniscate.run.run import Run
from lemniscate.run.seeding import set_seeds, torch_defaults
from lemniscate.run.state import TrainState
from lemniscate.system import named
from lemniscate.system.console import say
from lemniscate.system.files import make_directory, parsing
from lemniscate.system.machine import keep_freed_memory
from lemniscate.system.world import CLUSTER, World, leave_if_imported_again

TRAINING = threading.RLock()
"""held by the thread that trains; a callback of its run may train too"""


def config_for(
    algorithm: str | ModuleType | RunConfig,
    env: str | Callable[..., Any] | None = None,
    preset: str | None = None,
    **fields: object,
) -> RunConfig:
    """The Config of a preset, or the Config given, with some fields changed.

    Raises:
        UserError: an unknown algorithm, environment, preset or field, or a value out of range.
    """
    return choose_config(algorithm, env, preset, fields)[2]


def choose_config(
    algorithm: str | ModuleType | RunConfig,
    env: str | Callable[..., Any] | None,
    preset: str | None,
    fields: Mapping[str, object],
) -> tuple[str, str, RunConfig]:
    """The algorithm's name, the preset's and the Config of `config_for`; raises as that."""
    if isinstance(env, RunConfig) or "config" in fields:
        raise UserError("A Config knows its algorithm and takes its place: lem.train(config).")
    if count := registry.count_of(env):
        fields = {"num_envs": count, **fields}
    env = None if env is None else registry.name_of(env)
    if isinstance(algorithm, RunConfig):
        if preset is not None:
            raise UserError("A Config has a value for every field: it does not go with a preset.")
        name = algos.name_of(sys.modules[type(algorithm).__module__])
        chosen, config = "given", algorithm if env is None else algorithm.replace(env=env, backend=None)
    else:
        name = algos.name_of(algorithm)
        chosen, config = presets.choose(name, env, preset)
    config = config.replace(**{name: name_in_config(value) for name, value in fields.items()})
    _require_followed(config, [name for name in fields if name.startswith("final_")])
    if chosen == "default" and env is None:
        raise UserError("Which environment? Name one with env; `lemniscate envs` lists them.")
    if not config.backend:
        config = config.replace(backend=registry.backend_for(config.env, config.all_wrappers))
    return name, chosen, config


def _require_followed(config: RunConfig, finals: Sequence[str]) -> None:
    """Raise `UserError` where one of these ends of other fields, which were given, is followed by nothing."""
    for final in finals:
        rate = final.removeprefix("final_")
        of_both = () if hasattr(config, rate) else (f"actor_{rate}", f"critic_{rate}")
        if ended := [name for name in config.schedules if name in (rate, *of_both)]:
            raise UserError(f"{ended[0]} {config.schedules[ended[0]]} has its own end: {final} does not go with it.")
        adapted = rate == "learning_rate" and getattr(config, "desired_kl", None) is not None
        if adapted and getattr(config, final) != getattr(type(config), final):
            raise UserError(f"desired_kl adapts the learning rate: {final} needs desired_kl none.")


def name_in_config(value: object) -> object:
    """A value of a Config: functions and classes, and those in a sequence, by their names."""
    if isinstance(value, list | tuple | Iterator):
        return tuple(map(name_in_config, value))
    if isinstance(value, TrainedRun | TrainedPolicy):  # to start warm from
        return str(path_of(value))
    return named.name_of(value) if callable(value) else value


def train(
    algorithm: str | ModuleType | RunConfig,
    env: str | Callable[..., Any] | None = None,
    *,
    run: str | Path | None = None,
    preset: str | None = None,
    track: str | LoggerClass | None = None,
    callbacks: Callback | str | Sequence[Callback | str] = (),
    report: bool = False,
    progress: bool = True,
    processes: int = 1,
    cluster: str | None = None,
    workers: int | None = None,
    storage: str | None = None,
    **fields: object,
) -> TrainedRun:
    """Train a policy.

    Args:
        algorithm: a name in `lemniscate.algos.ALGORITHMS`; a module of your own, or its name; or a Config.
        env: an id, `module:Class`, a class, or a function that makes an environment; a preset may have its own.
        run: where to keep everything; by default a new directory under `runs/`.
        preset: by name; the best known for the environment unless given.
        track: a logger beside the local ones: "wandb", the `module:Class` of your own, or the class itself; it gets
            the final pictures too.
        callbacks: functions of (step, metrics, policy), or names as `module:function` or `module:Class(key=value, …)`.
            They are called after each logged line with a read-only view of its metrics and a copy of the policy, and
            can change nothing in the run; one that returns True stops it, saved. An exception that one raises also
            leaves it saved.
        report: evaluate the final policy, and draw it into `plots/` and `videos/`.
        progress: the live line on standard error.
        processes: of this machine, W; the steps of the environments, estimates and gradients are divided among them.
        cluster: "ray" or "ray=ADDRESS": train in `workers` processes that Ray places, and replaces where they die.
        workers: of the cluster; by default one.
        storage: a folder, or an address in a cloud, that all machines of the cluster reach; by default of this one.
        **fields: any field of the algorithm's Config, such as seed, total_steps or warm_start.

    Raises:
        UserError: see `config_for`; a run directory that exists; an environment that cannot be made, or that the
            algorithm cannot learn; a device, tracker or callback that is not there.
        NonFiniteError: an observation, a reward or a loss is NaN or infinite; the last checkpoint is as it was.
        WorkerError: the process of an environment died, or a pipe or a file of it failed.
        Stopped: Ctrl-C or SIGTERM, when the run has saved itself; go on with `resume`.
    """
    name, _, config = choose_config(algorithm, env, preset, fields)
    options = {"track": track, "callbacks": callbacks, "report": report, "progress": progress}
    options |= {"processes": processes, "cluster": cluster, "workers": workers, "storage": storage}
    return begin(name, config, run, options)


@torch_defaults()
def begin(algorithm: str, config: RunConfig, run: str | Path | None, arguments: Mapping[str, Any]) -> TrainedRun:
    """Train by a Config that is chosen, with the `arguments` of `RunOptions`. Raises as `train`."""
    with join_world() as world:
        options = RunOptions(**arguments)
        path = path_of(run) if run is not None else fresh_directory(config.env, f"{algorithm}-{config.seed}")
        if world.is_first:
            require_absent(path)
        if config.shards == 1:  # each process has one, unless more are asked for
            config = config.replace(shards=world.size)
        world.divide(config.shards)
        return _train(world, world.from_first(path), algorithm, config, options)


def resume(
    run: str | Path | TrainedRun | TrainedPolicy,
    *,
    total_steps: float | None = None,
    env: str | Callable[..., Any] | None = None,
    wrappers: Sequence[str | Callable[..., Any]] | None = None,
    network: str | Callable[..., Any] | None = None,
    curriculum: str | Callable[..., Any] | None = None,
    track: str | LoggerClass | None = None,
    callbacks: Callback | str | Sequence[Callback | str] = (),
    report: bool = False,
    progress: bool = True,
    processes: int = 1,
    cluster: str | None = None,
    workers: int | None = None,
    storage: str | None = None,
) -> TrainedRun:
    """Resume an interrupted run from its newest whole planned checkpoint, and train it to its end.

    A run that is finished stays as it is; with `report` it is evaluated and drawn again. With `total_steps` it goes on,
    with its optimizers, normalizer, replay buffer and random generators. What changes over the whole run (schedules, an
    annealed learning rate) is of the new total from then on.

    Args:
        run: its directory, or what `train` returned.
        total_steps: of the whole run, where they are to be other than they were; above the step where it stands.
        env: only of a run that began with an object that no file holds, such as a lambda: the same object again.
        wrappers: the same; and so `network` and `curriculum`.
        track: as in `train`, like `callbacks`, `report` and `progress`; none of them is saved with the run.
        processes: of this machine; any number that divides the run's `shards`, whatever it began with.
        cluster: as in `train`: go on there, from what its storage has, or else this directory.
        workers: as many as divide the run's `shards`; others stand by.
        storage: the same as when the run began there.

    Raises:
        UserError: no run directory, or one that another process trains in or another version wrote; an object that no
            file holds and that was not passed again; a tracker or a callback that is not there.
        NonFiniteError: an observation, a reward or a loss is NaN or infinite; the last checkpoint is as it was.
        WorkerError: the process of an environment died, or a pipe or a file of it failed.
        Stopped: Ctrl-C or SIGTERM, when the run has saved itself.
    """
    options = {"track": track, "callbacks": callbacks, "report": report, "progress": progress}
    options |= {"processes": processes, "cluster": cluster, "workers": workers, "storage": storage}
    again = {"total_steps": total_steps, "env": None if env is None else registry.name_of(env), "wrappers": wrappers}
    again |= {"network": network, "curriculum": curriculum}
    return resume_run(run, options, {name: name_in_config(x) for name, x in again.items() if x is not None})


@torch_defaults()
def resume_run(run: object, arguments: Mapping[str, Any], changes: Mapping[str, object]) -> TrainedRun:
    """Go on with a run; `changes` are `total_steps` and objects passed again. Raises as `resume`."""
    with join_world() as world:
        options, path = RunOptions(**arguments), path_of(run)
        record = world.from_first(read_record(path) if world.is_first else {})
        with parsing(path):
            algorithm, fields = record["algorithm"], record["config"]
        stored = algos.find(algorithm).Config.from_json(fields)
        config = stored.replace(**changes)
        _require_the_same(path, stored, config)
        world.divide(config.shards)
        if "total_steps" in changes and world.is_first:
            extend(path, config.total_steps)
            if options.progress and (names := _annealed(config)):
                say(f"Over the new total of {config.total_steps:,} steps from here on: {', '.join(names)}.")
        if not world.from_first(world.is_first and is_finished(path)):
            return _train(world, path, algorithm, config, options)
        trained = TrainedRun(path, load(path), 0.0)
        if options.progress and world.is_first:
            say(f"{path} is finished, at step {trained.policy.step:,}: there is nothing to resume.")
        if options.report and world.is_first:
            _report_on(trained)
        return trained


def _require_the_same(path: Path, stored: RunConfig, config: RunConfig) -> None:
    """Raise `UserError` where an object is passed again that the run has by a name, and is another one."""
    for name in ("env", "wrappers", "network", "curriculum"):
        before, now = (getattr(each, name, None) for each in (stored, config))
        names = before if isinstance(before, tuple) else (before or "",)
        if before != now and not any(map(_is_lost, names)):
            raise UserError(
                f"{name} of {path} is {shown(before)}: leave {name} out; with another one it is a run of its own, which"
                " may begin with warm_start."
            )


def _is_lost(name: str) -> bool:
    """Whether no object can be found by a name any more, since no file holds it, or its module has moved."""
    if "<" in name or name.startswith("__main__:"):
        return True
    with suppress(UserError):
        return ":" in name and not named.find_callable(name)
    return True


def _annealed(config: RunConfig) -> list[str]:
    """The fields that make others change over the steps of the whole run, with their values."""
    fractions = () if getattr(config, "desired_kl", None) else ("final_learning_rate", "final_critic_learning_rate")
    fractions = (*fractions, "final_epsilon")
    annealed = [name for name in fractions if name.removeprefix("final_") not in config.schedules]
    fields = {**config.schedules, **{name: getattr(config, name, 1.0) for name in annealed}}
    return [f"{name} {value}" for name, value in fields.items() if value != 1]


def join_world() -> AbstractContextManager[World]:
    """The world of this process: of those that `torchrun` or Ray has started, or its own."""
    leave_if_imported_again()
    if CLUSTER in os.environ:
        from lemniscate.cluster import job

        return job.join_world()
    if "WORLD_SIZE" in os.environ:
        from lemniscate.system import processes

        return processes.join_world()
    return nullcontext(World())


def _train_elsewhere(path: Path, algorithm: str, config: RunConfig, options: RunOptions) -> TrainedRun:
    """Train in other processes, of this machine or of a cluster; each resumes the run, which begins if it is new."""
    require_several(config, options.processes)
    require_importable(*own_names(config))
    began = time.monotonic()
    if options.cluster is None:
        train_in_processes(path, algorithm, config, options)
    else:
        from lemniscate.cluster.job import train_on_ray

        train_on_ray(path, algorithm, config, options.cluster, f"{__name__}:resume", options.shared())
    trained = TrainedRun(path, load(path), time.monotonic() - began)
    if options.cluster is not None and options.reports:  # processes of this machine get --report, and do it themselves
        _report_on(trained)
    return trained


@contextmanager
def _alone() -> Iterator[None]:
    """Raise `UserError` where another thread of this process trains: both would draw from its global generators."""
    if not TRAINING.acquire(blocking=False):
        raise UserError(
            "Another thread of this process is training, and both would draw from the same random numbers; train one"
            " after the other, or each in a process of its own."
        )
    try:
        yield
    finally:
        TRAINING.release()


@_alone()
def _train(world: World, path: Path, algorithm: str, config: RunConfig, options: RunOptions) -> TrainedRun:
    """Train in this process, of several the first alone writes, reports and talks; or where the options say."""
    if options.cluster is not None or (options.processes > 1 and world.size == 1):
        return _train_elsewhere(path, algorithm, config, options)
    progress, home = options.progress and world.is_first, path.absolute()
    set_seeds(config.seed)  # before JAX starts, which reads its flags then
    torch.set_num_threads(config.threads)
    keep_freed_memory()
    envs = envs_of(config, world)
    path, spec = path if path.absolute() == home else home, envs[0].spec  # an environment may have gone to its files

    def record_video(state: TrainState) -> None:
        from lemniscate.api.results import evaluate

        file = home / "videos" / f"step-{state.step}.{'mp4' if is_installed('imageio_ffmpeg') else 'gif'}"
        make_directory(file.parent)
        evaluate(PolicySnapshot(state, spec, config, state.step), episodes=1, video=file)

    attend, callbacks = Attendance(config) if progress else None, options.callbacks if world.is_first else ()
    observer = call_callbacks(callbacks, spec, config, attend) if callbacks or attend else None
    told = {"progress": progress, "record_video": record_video, "observer": observer}
    run = Run(path, algorithm, config, envs, world=world, loggers=options.loggers, locate=local_path, **told)
    pictures: list[Path] = []
    try:
        if world.is_first and (config.video_every or config.video_every_episodes) and not path.exists():
            from lemniscate.report.playback import require_pictures

            require_pictures(config, envs[0])
        for notice in config.notices(spec, envs[0].device) if progress else ():
            say(notice)
        state = algos.find(algorithm).train(config, run)
        if not hasattr(state, "networks"):
            raise UserError(f"train() of {algorithm} must return the state that run.restore gave, not {shown(state)}.")
        run.require_whole(state)
        path = path if path.absolute() == home else home
        if envs[0].backend.once:
            envs[0].close()  # before a report makes another one
        state.release()
        trained = TrainedRun(path, TrainedPolicy(state.networks.cpu(), spec, config, state.step, path), run.seconds)
        if options.reports and world.is_first:
            with world.busy():
                pictures = _report_on(trained)
    finally:
        run.close(pictures)
    try:
        run.require_stored()
    except NotStoredError as error:
        error.run = trained
        raise
    return trained


def _report_on(run: TrainedRun) -> list[Path]:
    """Evaluate a run's final policy and draw it; returns the pictures."""
    from lemniscate.api.plots import report_on  # what most runs do not need: matplotlib's pages

    return report_on(run)


def fresh_directory(env_id: str, name: str) -> Path:
    """A directory under `runs/` that is not there yet."""
    stem = registry.file_name(f"{env_id}-{name}")
    names = (Path("runs") / (stem if n == 1 else f"{stem}-{n}") for n in count(1))
    return next(path for path in names if not path.exists())
