"""The verbs that begin or continue a run: train, resume; and the Config and the environments of one."""

import sys
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from lemniscate import algos, named, presets
from lemniscate.callbacks import Callback, call_callbacks, find_callbacks
from lemniscate.console import say
from lemniscate.envs import registry
from lemniscate.errors import NotStoredError, UserError, is_installed, missing_extra, shown, unknown_name
from lemniscate.policy import TrainedPolicy
from lemniscate.report import playback
from lemniscate.results import draw_run, evaluate
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import is_finished, read_record, require_absent
from lemniscate.run.environments import make_envs
from lemniscate.run.files import make_directory, parsing
from lemniscate.run.loggers import TRACKERS, JsonLines, LoggerClass, TensorBoard
from lemniscate.run.run import Run
from lemniscate.run.seeding import set_seeds
from lemniscate.run.state import TrainState
from lemniscate.run.trust import is_signed, require_trusted
from lemniscate.stored import TrainedRun, load, own_code_of, path_of


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
    config = config.replace(**{name: _named(value) for name, value in fields.items()})
    if name == "default" and env is None:
        raise UserError("Which environment? Name one with env; `lemniscate envs` lists them.")
    return config if config.backend else config.replace(backend=registry.backend_for(config.env, config.wrappers))


def _named(value: object) -> object:
    """A value of a Config: functions and classes, and those in a sequence, by their names."""
    if isinstance(value, list | tuple):
        return tuple(map(_named, value))
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
        **fields: any field of the algorithm's Config, such as seed, total_steps or warm_start.

    Raises:
        UserError: see `config_for`; a run directory that exists; an environment that cannot be made, or that the
            algorithm cannot learn; a device, tracker or callback that is not there.
        NonFiniteError: an observation, a reward or a loss is NaN or infinite; the last checkpoint is as it was.
        WorkerError: the process of an environment died.
        Stopped: Ctrl-C or SIGTERM, when the run has saved itself; go on with `resume`.
    """
    config = config_for(algorithm, env, preset, **fields)
    algorithm = algos.name_of(sys.modules[type(config).__module__] if isinstance(algorithm, RunConfig) else algorithm)
    path = path_of(run) if run is not None else fresh_directory(config.env, f"{algorithm}-{config.seed}")
    loggers, functions = loggers_with(track), find_callbacks(callbacks) if callbacks else []
    require_absent(path)
    return _train(path, algorithm, config, loggers, functions, report or track is not None, progress)


def resume(
    run: str | Path | TrainedRun | TrainedPolicy,
    *,
    env: str | Callable[..., Any] | None = None,
    wrappers: Sequence[str | Callable[..., Any]] | None = None,
    network: str | Callable[..., Any] | None = None,
    track: str | LoggerClass | None = None,
    callbacks: Callback | str | Sequence[Callback | str] = (),
    report: bool = False,
    progress: bool = True,
    trust: bool = False,
) -> TrainedRun:
    """Resume an interrupted run from its newest whole planned checkpoint, and train it to its end.

    A run that is finished stays as it is; with `report` it is evaluated and drawn again.

    Args:
        run: its directory, or what `train` returned.
        env: only of a run that began with an object that no file holds, such as a lambda: the same object again.
        wrappers: the same.
        network: the same.
        track: as in `train`, and the following; none of them is saved with the run.
        callbacks: functions that see each logged line.
        report: evaluate the final policy, and draw it.
        progress: the live line on standard error.
        trust: import the code that the run names as `module:name` also if the run is not of this user and machine.

    Raises:
        UserError: no run directory, or one that another process trains in or another version wrote; an object that no
            file holds and that was not passed again; a tracker or a callback that is not there.
        NonFiniteError: an observation, a reward or a loss is NaN or infinite; the last checkpoint is as it was.
        WorkerError: the process of an environment died.
        Stopped: Ctrl-C or SIGTERM, when the run has saved itself.
    """
    path = path_of(run)
    again = {"env": env, "wrappers": wrappers, "network": network}
    given = {name: _named(value) for name, value in again.items() if value is not None}
    record = read_record(path)
    with parsing(path):
        algorithm, fields = record["algorithm"], record["config"]
        code = own_code_of({"algorithm": algorithm, "config": {**fields, **given}})
        require_trusted(path, code, trusted=trust or is_signed(record))
    config = algos.find(algorithm).Config.from_json(fields).replace(**given)
    loggers, functions = loggers_with(track), find_callbacks(callbacks) if callbacks else []
    if is_finished(path):
        return _finished(path, report, progress, trust)
    return _train(path, algorithm, config, loggers, functions, report or track is not None, progress)


def _finished(path: Path, report: bool, progress: bool, trust: bool) -> TrainedRun:
    """A run that has taken all its steps, as it is; with `report` it is evaluated and drawn again."""
    run = TrainedRun(path, load(path, trust=trust), 0.0)
    if progress:
        say(f"{path} is finished, at step {run.policy.step:,}: there is nothing to resume.")
    if report:
        _report(run)
    return run


def _train(
    path: Path,
    algorithm: str,
    config: RunConfig,
    loggers: tuple[LoggerClass, ...],
    callbacks: Sequence[Callback],
    report: bool,
    progress: bool,
) -> TrainedRun:
    set_seeds(config.seed)  # before JAX starts, which reads its flags then
    torch.set_num_threads(config.threads)
    envs = make_envs(config)
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

    observer = call_callbacks(callbacks, copy_networks, spec, config) if callbacks else None
    run = Run(path, algorithm, config, envs, loggers=loggers, progress=progress, film=film, observer=observer)
    pictures: list[Path] = []
    try:
        if (config.video_every or config.video_every_episodes) and not path.exists():
            playback.require_pictures(config, envs[0])
        for notice in config.notices(spec, envs[0].device) if progress else ():
            say(notice)
        state = algos.find(algorithm).train(config, run)
        trained = TrainedRun(path, TrainedPolicy(state.networks.cpu(), spec, config, state.step, path), run.seconds)
        if report:
            pictures = _report(trained)
    finally:
        run.close(pictures)
    try:
        run.require_stored()
    except NotStoredError as error:
        error.run = trained
        raise
    return trained


def _report(run: TrainedRun) -> list[Path]:
    """Evaluate a run's final policy, draw it, and name the files; returns the pictures."""
    files = draw_run(run, film=True)
    for file in files:
        say(file)
    return [file for file in files if file.suffix == ".png"]


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
