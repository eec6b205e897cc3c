"""The verb that begins a run, and the Config of one."""

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from lemniscate import algos, presets
from lemniscate.api.callbacks import Callback, call_callbacks, find_callbacks
from lemniscate.api.launch import launch_run, train_there
from lemniscate.api.policy import TrainedPolicy
from lemniscate.api.results import evaluate, report_on
from lemniscate.api.stored import TrainedRun, load, path_of
from lemniscate.cluster.connection import find_cluster
from lemniscate.envs import registry
from lemniscate.errors import NotStoredError, UserError, is_installed, missing_extra, shown, unknown_name
from lemniscate.report import playback
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import require_absent
from lemniscate.run.environments import envs_of, make_envs
from lemniscate.run.loggers import TRACKERS, JsonLines, LoggerClass, TensorBoard
from lemniscate.run.run import Run
from lemniscate.run.seeding import set_seeds
from lemniscate.run.state import TrainState
from lemniscate.system import named
from lemniscate.system.console import say
from lemniscate.system.files import make_directory
from lemniscate.system.world import CLUSTER, World


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
    if isinstance(env, RunConfig) or "config" in fields:
        raise UserError("A Config knows its algorithm and takes its place: lem.train(config).")
    env = None if env is None else registry.name_of(env)
    if isinstance(algorithm, RunConfig):
        if preset is not None:
            raise UserError("A Config has a value for every field: it does not go with a preset.")
        name, config = "given", algorithm if env is None else algorithm.replace(env=env, backend=None)
    else:
        name, config = presets.choose(algos.name_of(algorithm), env, preset)
    config = config.replace(**{name: name_in_config(value) for name, value in fields.items()})
    if name == "default" and env is None:
        raise UserError("Which environment? Name one with env; `lemniscate envs` lists them.")
    return config if config.backend else config.replace(backend=registry.backend_for(config.env, config.wrappers))


def name_in_config(value: object) -> object:
    """A value of a Config: functions and classes, and those in a sequence, by their names."""
    if isinstance(value, list | tuple):
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
        processes: of this machine, W; environments, minibatches and replay are divided among them. See `shards`.
        cluster: "ray" or "ray=ADDRESS": train in `workers` processes that Ray places, and replaces where they die.
        workers: of the cluster; by default one.
        storage: a folder, or an address in a cloud, that all machines of the cluster reach; by default of this one.
        **fields: any field of the algorithm's Config, such as seed, total_steps or warm_start.

    Raises:
        UserError: see `config_for`; a run directory that exists; an environment that cannot be made, or that the
            algorithm cannot learn; a device, tracker or callback that is not there.
        NonFiniteError: an observation, a reward or a loss is NaN or infinite; the last checkpoint is as it was.
        WorkerError: the process of an environment died.
        Stopped: Ctrl-C or SIGTERM, when the run has saved itself; go on with `resume`.
    """
    there = find_cluster(cluster, workers, storage) if cluster or workers or storage else None
    with together() as world:
        config = config_for(algorithm, env, preset, **fields)
        name = algos.name_of(sys.modules[type(config).__module__] if isinstance(algorithm, RunConfig) else algorithm)
        path = path_of(run) if run is not None else fresh_directory(config.env, f"{name}-{config.seed}")
        loggers, functions = loggers_with(track), find_callbacks(callbacks) if callbacks else []
        if world.is_first:
            require_absent(path)
        if there is not None:
            return train_there(path, name, config, there, track, callbacks, report, progress)
        if processes > 1:
            launched = launch_run(path, name, config, processes, track, callbacks, report, progress)
            return TrainedRun(path, load(path, trust=True), launched)
        if config.shards == 1:  # each process has one, unless more are asked for
            config = config.replace(shards=world.size)
        world.divide(config.shards)
        path = world.from_first(path)
        return train_here(world, path, name, config, loggers, functions, report or track is not None, progress)


def together() -> AbstractContextManager[World]:
    """The world of this process: of those that `torchrun` or Ray has started, or its own."""
    if CLUSTER in os.environ:
        from lemniscate.cluster.job import together
    elif "WORLD_SIZE" in os.environ:
        from lemniscate.system.processes import together
    else:
        return nullcontext(World())
    return together()


def train_here(
    world: World,
    path: Path,
    algorithm: str,
    config: RunConfig,
    loggers: tuple[LoggerClass, ...],
    callbacks: Sequence[Callback],
    report: bool,
    progress: bool,
) -> TrainedRun:
    """Train in this process; of several, the first alone writes, reports and talks."""
    progress, report = progress and world.is_first, report and world.is_first
    set_seeds(config.seed)  # before JAX starts, which reads its flags then
    torch.set_num_threads(config.threads)
    envs = make_envs(config) if world.size == 1 else envs_of(config, world)
    spec = envs[0].spec

    def copy_networks(state: TrainState) -> Any:
        networks = config.networks(spec)
        networks.load_state_dict(state.networks.state_dict())
        return networks

    def film(state: TrainState) -> None:
        kind = "mp4" if is_installed("imageio_ffmpeg") else "gif"
        policy = TrainedPolicy(copy_networks(state), spec, config, state.step)
        make_directory(path / "videos")
        evaluate(policy, episodes=1, video=path / "videos" / f"step-{state.step}.{kind}")

    observer = call_callbacks(callbacks, copy_networks, spec, config) if callbacks and world.is_first else None
    surroundings = {"loggers": loggers, "progress": progress, "film": film, "observer": observer}
    run = Run(path, algorithm, config, envs, world=world, **surroundings)
    pictures: list[Path] = []
    try:
        if world.is_first and (config.video_every or config.video_every_episodes) and not path.exists():
            playback.require_pictures(config, envs[0])
        for notice in config.notices(spec, envs[0].device) if progress else ():
            say(notice)
        state = algos.find(algorithm).train(config, run)
        trained = TrainedRun(path, TrainedPolicy(state.networks.cpu(), spec, config, state.step, path), run.seconds)
        if report:
            pictures = report_on(trained)
    finally:
        run.close(pictures)
    try:
        run.require_stored()
    except NotStoredError as error:
        error.run = trained
        raise
    return trained


def loggers_with(track: str | LoggerClass | None) -> tuple[LoggerClass, ...]:
    """The local loggers, and the tracker asked for. Raises `UserError` if it does not exist or is not installed."""
    if track is None:
        return JsonLines, TensorBoard
    if isinstance(track, str) and ":" not in track:
        if track not in TRACKERS:
            raise unknown_name("tracker", track, TRACKERS)
        extra, track = TRACKERS[track]
        if not is_installed(extra):
            raise missing_extra(extra, extra)
    if not (isinstance(track, str) or callable(track)):
        raise UserError(f"track must be a logger's name or class, not {shown(track)}.")
    return JsonLines, TensorBoard, named.find(track) if isinstance(track, str) else track


def fresh_directory(env_id: str, name: str) -> Path:
    """A directory under `runs/` that is not there yet."""
    stem = registry.file_name(f"{env_id}-{name}")
    names = (Path("runs") / (stem if n == 1 else f"{stem}-{n}") for n in count(1))
    return next(path for path in names if not path.exists())
