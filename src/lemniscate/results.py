"""The verbs for what a run has left: load, save, evaluate, watch, plot."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from lemniscate import algos
from lemniscate.console import say
from lemniscate.envs import registry
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError, shown
from lemniscate.policy import TrainedPolicy
from lemniscate.report import pictures as pictures_of
from lemniscate.report import playback
from lemniscate.report.display import require_display
from lemniscate.report.film import check_film
from lemniscate.run import checkpoint
from lemniscate.run.config import Count, Natural, RunConfig, checked
from lemniscate.run.directory import find_checkpoint
from lemniscate.run.environments import evaluation_env, world_of
from lemniscate.run.evaluate import Evaluation
from lemniscate.run.evaluate import evaluate as evaluate_module
from lemniscate.run.q_bias import critic_of


@dataclass(frozen=True)
class TrainedRun:
    """The result of `train` and `resume`: the run directory, the final policy, the seconds of the training loop."""

    path: Path
    policy: TrainedPolicy
    seconds: float


Trained = str | Path | TrainedRun | TrainedPolicy
"""what has a policy: the path of a run or a checkpoint, what `train` returned, or the policy itself"""


def path_of(run: object) -> Path:
    """The directory of a run: of its path, or of what `train` returned. Raises `UserError` for anything else."""
    path = getattr(run, "path", run)
    if isinstance(path, str | PathLike):
        return Path(path)
    raise UserError(f"A run is a directory, such as 'runs/lander', or what train returned, not {shown(run)}.")


def finished_run(path: Path, report: bool, progress: bool) -> TrainedRun:
    """A run that has taken all its steps, as it is; with `report` it is evaluated and drawn again."""
    policy = load(path)
    if progress:
        say(f"{path} is finished, at step {policy.step:,}: there is nothing to resume.")
    if report:
        episodes = policy.config.evaluate_episodes
        env = evaluation_env(policy.config, episodes)
        pictures_of.report(policy.module, env, path, episodes, critic_of(policy.networks, policy.config))
        env.close()
    return TrainedRun(path, policy, 0.0)


def load(run: Trained) -> TrainedPolicy:
    """The policy of a run (its newest whole checkpoint) or of one checkpoint. Nothing in the files is executed.

    What `train` returned has its policy already, and a policy is returned as it is.

    Raises:
        UserError: neither a run nor a checkpoint, or a run without a whole checkpoint; a damaged checkpoint.
    """
    if isinstance(run, TrainedRun | TrainedPolicy):
        return run.policy if isinstance(run, TrainedRun) else run
    found = find_checkpoint(path_of(run))
    algorithm, spec = algos.find(found.record["algorithm"]), checkpoint.spec_from_json(found.record["spec"])
    config = algorithm.Config.from_json(found.record["config"])
    networks = config.networks(spec)
    networks.load_state_dict(found.tensors_of("networks"))
    return TrainedPolicy(networks, spec, config, found.numbers["step"])


def save(policy: Any, path: str | Path) -> Path:
    """Store a policy for `load`: weights, normalizer, Config and Spec, as a checkpoint without pickle.

    Args:
        policy: from `load`, or what `train` returned. It may begin another run (`warm_start=path`), but not resume
            its own: a run's checkpoints also hold optimizers and random generators.
        path: a new directory, or a policy stored before, which is replaced.

    Raises:
        UserError: something else is at `path`, or it cannot be written.
    """
    path, policy = Path(path), getattr(policy, "policy", policy)
    if not isinstance(policy, TrainedPolicy):
        raise UserError(f"What can be stored is a policy, from load or train, not a {type(policy).__name__}.")
    if path.exists() and not (path / "manifest.json").exists():
        raise UserError(f"{path} exists already, and is not a stored policy; choose another path.")
    algorithm = algos.name_of(sys.modules[type(policy.config).__module__])
    record = {"algorithm": algorithm, "config": policy.config.to_json(), "spec": checkpoint.spec_to_json(policy.spec)}
    try:
        fields = {"networks": policy.networks, "step": policy.step}
        checkpoint.write_fields(path, fields, {**record, "planned": False})
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error}.") from error
    return path


def evaluate(
    policy: Trained,
    env: str | Callable[..., Any] | None = None,
    episodes: int = 100,
    seed: int = 0,
    *,
    deterministic: bool = True,
    backend: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    video: str | Path | None = None,
) -> Evaluation:
    """Play whole episodes from starts drawn with `seed`, none of which training ever saw.

    Args:
        policy: from `load` or `train`, or the path of a run or a checkpoint.
        env: an id, `module:Class`, a class, or a function that makes an environment; by default the one of training.
        episodes: how many.
        seed: of the starts.
        deterministic: act by the mode of the distribution.
        backend: simulation backend; that of training unless named, or by the id if `env` is another.
        env_kwargs: arguments of the environment that are to be other than in training.
        video: a .gif, .webp or .mp4 to record all episodes into. They are then played one after the other, in a
            rendered environment, without a measurement of the Q bias.

    Raises:
        UserError: numbers out of range; an environment that cannot be made, or whose spaces differ; with `video`, one
            that renders no pictures, or another kind of file.
    """
    policy, episodes, seed = load(policy), checked("episodes", episodes, Count), checked("seed", seed, Natural)
    env_kwargs = checked("env_kwargs", env_kwargs, dict | None)
    if video is not None:
        check_film(Path(video))
    elsewhere: dict[str, Any] = {"env": env, "env_kwargs": env_kwargs, "backend": backend}
    vec = _fitting_env(policy, episodes, **elsewhere)
    try:
        if video is not None:
            how = {"episodes": episodes, "seed": seed, "deterministic": deterministic, "video": Path(video)}
            return _show(policy, vec, world_of(policy.config, **elsewhere), tell=lambda text: None, **how)
        critic = critic_of(policy.networks, policy.config)
        return evaluate_module(policy.module, vec, episodes, seed, deterministic, critic)
    finally:
        vec.close()


def watch(
    policy: Trained | None = None,
    env: str | Callable[..., Any] | None = None,
    *,
    episodes: int = 1,
    seed: int = 0,
    deterministic: bool = True,
    random: bool = False,
    video: str | Path | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
) -> Evaluation:
    """Show episodes: below the cell in a notebook, in a window elsewhere, or recorded into a film.

    Says return and length of each on standard error, then their means and standard deviations.

    Args:
        policy: from `load` or `train`, or the path of a run or a checkpoint; none for uniformly random actions in
            `env`.
        env: as in `evaluate`.
        episodes: how many.
        seed: of the starts, and of the actions where they are drawn.
        deterministic: act by the mode of the distribution; otherwise actions are drawn from it.
        random: act uniformly at random, in the environment of the policy.
        video: a .gif, .webp or .mp4 to record all episodes into.
        env_kwargs: as in `evaluate`.

    Raises:
        UserError: nothing to show it on; an environment that renders no pictures; another kind of file.
    """
    policy = None if policy is None else load(policy)
    episodes, seed = checked("episodes", episodes, Count), checked("seed", seed, Natural)
    if policy is None and env is None:
        raise UserError("Watch what? Name a run, or an environment to act in at random.")
    if video is None:
        require_display()
    else:
        check_film(Path(video))
    elsewhere: dict[str, Any] = {"env": env, "env_kwargs": env_kwargs}
    config = policy.config if policy else RunConfig(env=registry.name_of(env))
    vec = _fitting_env(policy, episodes, **elsewhere) if policy else evaluation_env(config, episodes, **elsewhere)
    file = None if video is None else Path(video)
    how = {"episodes": episodes, "seed": seed, "deterministic": deterministic, "video": file}
    try:
        scores = _show(None if random else policy, vec, world_of(config, **elsewhere), **how)
    finally:
        vec.close()
    if episodes > 1 or scores.measures:
        say(pictures_of.sentence(scores))
    if file:
        say(f"Recorded in {file}.")
    return scores


def _show(
    policy: TrainedPolicy | None, vec: VecEnv, world: dict[str, Any], *, deterministic: bool, **how: Any
) -> Evaluation:
    """Play flights where `vec` has a scene, else episodes in a rendered environment; at random without a policy."""
    if vec.scene:
        return playback.show_flights(policy.module if policy else None, vec, deterministic=deterministic, **how)
    if policy is None:
        return playback.show_episodes(None, world, **how)
    drawn = TrainedPolicy(policy.networks, policy.spec, policy.config.replace(seed=how["seed"]), policy.step)
    return playback.show_episodes(partial(drawn.act, deterministic=deterministic), world, **how)


def _fitting_env(policy: TrainedPolicy, episodes: int, **elsewhere: Any) -> VecEnv:
    """The environments of an evaluation. Raises `UserError` where the policy cannot act."""
    vec = evaluation_env(policy.config, episodes, **elsewhere)
    if not vec.spec.fits(policy.spec):
        vec.close()
        raise UserError(
            f"A policy for {policy.spec.env_id} cannot act in {vec.spec.env_id}: observation or action spaces differ."
        )
    return vec
