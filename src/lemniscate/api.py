"""The verbs: train, resume, load, evaluate, watch, plot, make_envs."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from lemniscate import algos, named, presets
from lemniscate.callbacks import Callback, watch_with
from lemniscate.console import say
from lemniscate.envs import registry
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError, is_installed, missing_extra, unknown_name
from lemniscate.policy import TrainedPolicy
from lemniscate.report import compare, curves, playback
from lemniscate.report import pictures as pictures_of
from lemniscate.report.groups import group
from lemniscate.run import checkpoint
from lemniscate.run.config import RunConfig
from lemniscate.run.directory import find_checkpoint, is_finished, read_config, require_absent
from lemniscate.run.evaluate import Evaluation
from lemniscate.run.evaluate import evaluate as evaluate_module
from lemniscate.run.loggers import TRACKERS, JsonLines, LoggerClass, TensorBoard, read_metrics
from lemniscate.run.q_bias import critic_of
from lemniscate.run.run import Run
from lemniscate.run.seeding import set_seeds
from lemniscate.run.state import TrainState
from lemniscate.run.sweep_file import is_sweep, read_sweep

FINAL_EPISODES = 100
"""that a run's final policy is judged by where runs are compared"""


@dataclass(frozen=True)
class TrainedRun:
    """The result of `train` and `resume`: the run directory, the final policy, the seconds of the training loop."""

    path: Path
    policy: TrainedPolicy
    seconds: float


def config_for(
    algorithm: str | ModuleType,
    env: str | Callable[..., Any] | None = None,
    preset: str | None = None,
    **fields: object,
) -> RunConfig:
    """The Config of a preset, with some fields changed.

    Raises:
        UserError: an unknown algorithm, environment, preset or field, or a value out of range.
    """
    env = None if env is None else registry.name_of(env)
    name, config = presets.choose(algos.name_of(algorithm), env, preset)
    if name == "default" and env is None:
        raise UserError("Which environment? Name one with env; `lemniscate envs` lists them.")
    config = config.replace(**{name: _named(value) for name, value in fields.items()})
    return config if config.backend else config.replace(backend=registry.backend_for(config.env, config.wrappers))


def _named(value: object) -> object:
    """A value of a Config: functions and classes, and those in a sequence, by their names."""
    if isinstance(value, list | tuple):
        return tuple(map(_named, value))
    return named.name_of(value) if callable(value) else value


def make_envs(config: RunConfig) -> tuple[VecEnv, VecEnv]:
    """Two vectors of environments that share nothing: one for training, staggered, and one for evaluation.

    They are restarted with seeds of different streams, so no start of one is ever a start of the other.
    """
    device = str(device_for(config.device))
    world = {"kwargs": config.env_kwargs, "wrappers": config.wrappers, "backend": config.backend}
    train_env = registry.make(config.env, config.num_envs, device=device, stagger=True, **world)
    return train_env, _evaluation_env(config, config.evaluate_episodes, device=device)


def train(
    algorithm: str | ModuleType,
    env: str | Callable[..., Any] | None = None,
    *,
    run: str | Path | None = None,
    preset: str | None = None,
    track: str | LoggerClass | None = None,
    callbacks: Sequence[Callback | str] = (),
    report: bool = False,
    progress: bool = True,
    **fields: object,
) -> TrainedRun:
    """Train a policy.

    Args:
        algorithm: a name in `lemniscate.algos.ALGORITHMS`; a module of your own, or its name.
        env: an id, `module:Class`, a class, or a function that makes an environment; a preset may have its own.
        run: where to keep everything; by default a new directory under `runs/`.
        preset: by name; the best known for the environment unless given.
        track: a logger beside the local ones: "wandb", the `module:Class` of your own, or the class itself; it gets
            the final pictures too.
        callbacks: functions of (step, metrics, policy), or their names as `module:function`. They are called after
            each logged line with a read-only view of its metrics and a copy of the policy, and can change nothing in
            the run; one that returns True stops it, saved. An exception that one raises also leaves it saved.
        report: evaluate the final policy, and draw it into `plots/` and `videos/`.
        progress: the live line on standard error.
        **fields: any field of the algorithm's Config, such as seed, total_steps or warm_start.

    Raises:
        UserError: see `config_for`; a run directory that exists.
    """
    algorithm = algos.name_of(algorithm)
    config = config_for(algorithm, env, preset, **fields)
    path = Path(run) if run is not None else fresh_directory(config.env, f"{algorithm}-{config.seed}")
    loggers = loggers_with(track)
    require_absent(path)
    set_seeds(config.seed)  # before JAX starts, which reads its flags then
    envs = make_envs(config)
    if config.video_every:
        playback.require_pictures(config, envs[0])
    return _train(path, algorithm, config, envs, loggers, callbacks, report or track is not None, progress)


def resume(
    run: str | Path,
    *,
    env: str | Callable[..., Any] | None = None,
    wrappers: Sequence[str | Callable[..., Any]] | None = None,
    network: str | Callable[..., Any] | None = None,
    track: str | LoggerClass | None = None,
    callbacks: Sequence[Callback | str] = (),
    report: bool = False,
    progress: bool = True,
) -> TrainedRun:
    """Resume an interrupted run from its newest whole planned checkpoint, and train it to its end.

    `env`, `wrappers` and `network` are only for a run that began with objects that no file holds, such as a lambda: the
    same objects again. The other arguments are those of `train`, and are not saved with the run.
    """
    path = Path(run)
    algorithm, fields = read_config(path)
    again = {"env": env, "wrappers": wrappers, "network": network}
    config = algos.find(algorithm).Config.from_json(fields)
    config = config.replace(**{name: _named(value) for name, value in again.items() if value is not None})
    loggers = loggers_with(track)
    set_seeds(config.seed)
    return _train(path, algorithm, config, make_envs(config), loggers, callbacks, report or track is not None, progress)


def load(path: str | Path) -> TrainedPolicy:
    """The policy of a run (its newest whole checkpoint) or of one checkpoint. Nothing in the files is executed.

    Raises:
        UserError: neither a run nor a checkpoint, or a run without a whole checkpoint; a damaged checkpoint.
    """
    found = find_checkpoint(Path(path))
    algorithm, spec = algos.find(found.record["algorithm"]), checkpoint.spec_from_json(found.record["spec"])
    config = algorithm.Config.from_json(found.record["config"])
    networks = config.networks(spec)
    networks.load_state_dict(found.tensors_of("networks"))
    return TrainedPolicy(networks, spec, config, found.numbers["step"])


def evaluate(
    policy: TrainedPolicy,
    env: str | Callable[..., Any] | None = None,
    episodes: int = 100,
    seed: int = 0,
    *,
    deterministic: bool = True,
    backend: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
) -> Evaluation:
    """Play whole episodes from starts drawn with `seed`, none of which training ever saw.

    Args:
        policy: from `load` or `train`.
        env: an id, `module:Class`, a class, or a function that makes an environment; by default the one of training.
        episodes: how many.
        seed: of the starts.
        deterministic: act by the mode of the distribution.
        backend: simulation backend; that of training unless named, or by the id if `env` is another.
        env_kwargs: arguments of the environment that are to be other than in training.

    Raises:
        UserError: numbers out of range; an environment that cannot be made, or whose spaces differ.
    """
    if episodes < 1:
        raise UserError(f"episodes must be a whole number at least 1, not {episodes}.")
    _check_seed(seed)
    vec = _evaluation_env(policy.config, episodes, env=env, env_kwargs=env_kwargs, backend=backend)
    if not vec.spec.fits(policy.spec):
        vec.close()
        raise UserError(
            f"A policy for {policy.spec.env_id} cannot act in {vec.spec.env_id}: observation or action spaces differ."
        )
    try:
        critic = critic_of(policy.networks, policy.config)
        return evaluate_module(policy.module, vec, episodes, seed, deterministic, critic)
    finally:
        vec.close()


def watch(policy: TrainedPolicy, *, seed: int = 0, video: str | Path | None = None) -> str | None:
    """Show one episode: below the cell in a notebook, in a window elsewhere, or recorded into a file.

    Args:
        policy: from `load` or `train`.
        seed: of the start.
        video: a .gif, .webp or .mp4 to record into.

    Returns:
        A sentence on what was recorded, if anything.

    Raises:
        UserError: nothing to show it on, or another kind of file.
    """
    _check_seed(seed)
    if video is not None:
        playback.check_film(Path(video))
    env = _scene_env(policy)
    if env and video is not None:
        return playback.film_flight(policy.module, env, Path(video), seed)
    if env:
        return playback.show_flight(policy.module, env, seed)
    if video is not None:
        return playback.film_episode(policy.act, policy.config, Path(video), seed)
    return playback.show_episode(policy.act, policy.config, seed)


def plot(*runs: str | Path) -> list[Path]:
    """Draw the curves of a run into its `plots/`, or compare several, grouped by all but the seed.

    In a notebook they are also shown below the cell.

    Where the environment has a scene, flights are drawn too; where there is a Q, its predictions beside the returns.

    A set is its runs, and has a `plots/` of its own; what else is compared is drawn into `plots/` here, with a table on
    standard error. Compared are the final policies of finished runs, over 100 episodes each. Returns the pictures.
    """
    paths = [Path(run) for run in runs]
    found = [run for path in paths for run in _members(path)]
    folder = paths[0] / "plots" if len(paths) == 1 else Path("plots")
    if found != paths[:1]:
        return compare.report(group(found), _final_returns(found), folder)
    pictures = curves.plot_runs(found, folder)
    if any((paths[0] / "checkpoints").glob("step-*")):
        policy = load(paths[0])
        if critic_of(policy.networks, policy.config):
            q_bias = evaluate(policy, episodes=policy.config.evaluate_episodes).q_bias
            pictures += [curves.draw_q_bias(q_bias, paths[0], folder / "q.png")] if q_bias else []
        if env := _scene_env(policy):
            flights = policy.config.evaluate_episodes
            pictures += pictures_of.draw_flight(policy.module, env, folder, flights, seed=0)
    if playback.in_notebook():
        playback.show_pictures(pictures)
    return pictures


def final_return(run: str | Path) -> float:
    """Mean return of a run's newest policy over 100 episodes; kept in `final.json` until there is a newer policy."""
    path = Path(run)
    file = path / "final.json"
    known: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    if known.get("step") not in checkpoint.list_steps(path / "checkpoints")[-1:]:
        policy = load(path)
        say(f"Evaluating {path}: {FINAL_EPISODES} episodes.")
        scores = evaluate(policy, episodes=FINAL_EPISODES, seed=0)
        known = {"step": policy.step, "seed": 0, **scores.to_json()}
        temporary = file.with_suffix(".tmp")
        temporary.write_text(json.dumps(known) + "\n")
        temporary.replace(file)
    return known["mean_return"]


def _final_returns(runs: list[Path]) -> dict[Path, float]:
    """The final returns of the finished runs; a line names each run that cannot be evaluated here."""
    returns: dict[Path, float] = {}
    for run in filter(is_finished, runs):
        try:
            returns[run] = final_return(run)
        except UserError as error:
            say(f"{run} has no final return: {error}")
    return returns


def _members(path: Path) -> list[Path]:
    """A run itself, or those of a set that have something to show."""
    if not is_sweep(path):
        read_config(path)
    runs = [run for run in (read_sweep(path).runs if is_sweep(path) else [path]) if read_metrics(run)]
    if not runs:
        raise UserError(f"{path} has no metrics to plot yet.")
    return runs


def _train(
    path: Path,
    algorithm: str,
    config: RunConfig,
    envs: tuple[VecEnv, VecEnv],
    loggers: tuple[LoggerClass, ...],
    callbacks: Sequence[Callback | str],
    draw: bool,
    progress: bool,
) -> TrainedRun:
    module, spec = algos.find(algorithm), envs[0].spec
    torch.set_num_threads(config.threads)

    def copy_networks(state: TrainState) -> Any:
        networks = config.networks(spec)
        networks.load_state_dict(state.networks.state_dict())
        return networks

    def film(state: TrainState) -> None:
        kind = "mp4" if is_installed("imageio_ffmpeg") else "gif"
        policy = TrainedPolicy(copy_networks(state), spec, config, state.step)
        watch(policy, video=path / "videos" / f"step-{state.step}.{kind}")

    watcher = watch_with(callbacks, copy_networks, spec, config) if callbacks else None
    run = Run(path, algorithm, config, envs, loggers=loggers, progress=progress, film=film, watch=watcher)
    pictures: list[Path] = []
    try:
        for notice in config.notices(spec, envs[0].device) if progress else ():
            say(notice)
        state = module.train(config, run)
        if draw:
            critic = critic_of(state.networks, config)
            pictures = pictures_of.report(state.policy, run.eval_env, path, config.evaluate_episodes, critic)
    finally:
        run.close(pictures)
    return TrainedRun(path, TrainedPolicy(state.networks.cpu(), spec, config, state.step), run.seconds)


def _scene_env(policy: TrainedPolicy) -> VecEnv | None:
    """Environments to draw flights in, where the backend has a scene for them."""
    config = policy.config
    if not hasattr(registry.backend_class(config.backend or registry.backend_for(config.env)), "scene"):
        return None
    env = _evaluation_env(config, config.evaluate_episodes)
    return env if env.scene else None


def _check_seed(seed: int) -> None:
    if seed < 0:
        raise UserError(f"seed must be a whole number at least 0, not {seed}.")


def _evaluation_env(
    config: RunConfig,
    episodes: int,
    *,
    env: str | Callable[..., Any] | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    backend: str | None = None,
    device: str = "cpu",
) -> VecEnv:
    """A few environments of a run, or of another `env`; as many as in training where a program is compiled for these.

    `env_kwargs` change those of the run; in another environment they are the only ones.
    """
    name = config.env if env is None else registry.name_of(env)
    kwargs = {**(config.env_kwargs if name == config.env else {}), **(env_kwargs or {})}
    if env is None and backend is None:
        backend = registry.for_evaluation(config.backend)
    served_by = backend or registry.backend_for(name, config.wrappers)
    num_envs = config.num_envs if registry.is_compiled(served_by) else min(episodes, 16)
    return registry.make(name, num_envs, kwargs=kwargs, wrappers=config.wrappers, device=device, backend=backend)


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
    return JsonLines, TensorBoard, named.find(track) if isinstance(track, str) else track


def device_for(name: str) -> torch.device:
    """The device of that name; auto is cuda where there is a GPU, else cpu. Raises `UserError` for one not there."""
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        name = "cuda" if gpus else "cpu"
    kind, _, index = name.partition(":")
    if kind == "cuda" and not gpus:
        raise UserError(f"device is {name}, but torch sees no GPU; use cpu or auto.")
    if kind == "cuda" and int(index or 0) >= gpus:
        there = ", ".join(f"cuda:{i}" for i in range(gpus))
        raise UserError(f"device is {name}, but the GPUs that torch sees are: {there}.")
    if kind == "mps" and not torch.backends.mps.is_available():
        raise UserError("device is mps, but torch sees no Apple GPU; use cpu or auto.")
    return torch.device(name)


def fresh_directory(env_id: str, name: str) -> Path:
    """A directory under `runs/` that is not there yet."""
    stem = f"{registry.file_name(env_id)}-{name}"
    names = (Path("runs") / (stem if n == 1 else f"{stem}-{n}") for n in count(1))
    return next(path for path in names if not path.exists())
