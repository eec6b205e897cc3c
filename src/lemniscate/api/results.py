"""The verbs for what a run has left: evaluate, watch; the final scores that runs are compared by; a run's pictures."""

import os
from collections.abc import Callable, Mapping
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from lemniscate.api.policy import TrainedPolicy
from lemniscate.api.stored import Trained, TrainedRun, load, path_of
from lemniscate.envs import registry
from lemniscate.envs.backend import Baseline
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError, shown
from lemniscate.report import flight, pages, playback
from lemniscate.run import checkpoint
from lemniscate.run.config import Episodes, Natural, RunConfig, checked
from lemniscate.run.environments import env_arguments, evaluation_env
from lemniscate.run.evaluate import Evaluation, critic_of
from lemniscate.run.evaluate import evaluate as evaluate_policy
from lemniscate.system.console import say
from lemniscate.system.files import DamagedFileError, make_directory, read_json, write_json
from lemniscate.system.named import takes

Agent = Callable[[Any], Any]
"""a function of one observation, as Gymnasium's environment returns it, to an action for its `step`"""

FINAL_EPISODES = 100
"""that a run's final policy is judged by where runs are compared"""


def evaluate(
    policy: Trained | Agent,
    env: str | Callable[..., Any] | None = None,
    episodes: int = 100,
    seed: int = 0,
    *,
    deterministic: bool = True,
    backend: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    baseline: bool = False,
    video: str | Path | None = None,
    trust: bool = False,
) -> Evaluation:
    """Play whole episodes from starts drawn with `seed`, none of which training ever saw.

    Args:
        policy: from `load` or `train`, or the path of a run or a checkpoint; or a function of one observation, as the
            environment returns it, to an action for its `step`.
        env: an id, `module:Class`, a class, or a function that makes an environment; by default the one of training. A
            function as a policy needs one, of Gymnasium's interface.
        episodes: how many.
        seed: of the starts.
        deterministic: act by the mode of the distribution.
        backend: simulation backend; that of training unless named, or by the id if `env` is another.
        env_kwargs: arguments of the environment that are to be other than in training.
        baseline: play the same episodes by the classical controller that the environment has for comparison.
        video: a .gif, .webp or .mp4 to record all episodes into. They are then played one after the other in one
            rendered environment, without a measurement of the Q bias. The first 16 starts are the same; from the 17th
            on, and in other backends than gymnasium, returns may differ from those without a film. Of flights in a
            scene, which are those without a film, the first of each parallel environment is recorded.
        trust: import the code that the run names as `module:name` also if the run is not of this user and machine.

    Raises:
        UserError: numbers out of range; an environment that cannot be made, or whose spaces differ; one without a
            baseline, if it is asked for; an episode that does not end in an environment without a time limit; with
            `video`, an environment that renders no pictures, or another kind of file.
    """
    agent = policy if callable(policy) else load(policy, trust=trust)
    episodes, seed, file = checked("episodes", episodes, Episodes), checked("seed", seed, Natural), _film(video)
    elsewhere: dict[str, Any] = {"env": env, "env_kwargs": _kwargs(env_kwargs), "backend": backend}
    how: dict[str, Any] = {"episodes": episodes, "seed": seed, "tell": lambda text: None}
    arguments = env_arguments(_config_of(agent, env), **elsewhere)
    vec = _env_for(agent, episodes, **elsewhere)
    try:
        if baseline:
            return evaluate_policy(_baseline_of(vec), vec, episodes, seed)
        if file:
            return _show(agent, vec, arguments, deterministic=deterministic, video=file, **how)
        if not isinstance(agent, TrainedPolicy):
            return playback.play_single(playback.act_by(agent), arguments, **how)
        critic = critic_of(agent.networks, agent.config)
        return evaluate_policy(agent.module, vec, episodes, seed, deterministic, critic)
    finally:
        vec.close()


def watch(
    policy: Trained | Agent | None = None,
    env: str | Callable[..., Any] | None = None,
    *,
    episodes: int = 1,
    seed: int = 0,
    deterministic: bool = True,
    random: bool = False,
    video: str | Path | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    trust: bool = False,
) -> Evaluation:
    """Show episodes: below the cell in a notebook, in a window elsewhere, or recorded into a film.

    Says return and length of each on standard error, then their means and standard deviations.

    Args:
        policy: as in `evaluate`; none for uniformly random actions in `env`.
        env: as in `evaluate`.
        episodes: how many.
        seed: of the starts, and of the actions where they are drawn.
        deterministic: act by the mode of the distribution; otherwise actions are drawn from it.
        random: act uniformly at random, in the environment of the policy.
        video: a .gif, .webp or .mp4 to record all episodes into.
        env_kwargs: as in `evaluate`.
        trust: import the code that the run names as `module:name` also if the run is not of this user and machine.

    Raises:
        UserError: nothing to show it on; numbers out of range; an environment that cannot be made, renders no pictures,
            or whose spaces differ; an episode that does not end; more flights than parallel environments; another kind
            of file.
    """
    agent = policy if policy is None or callable(policy) else load(policy, trust=trust)
    episodes, seed, file = checked("episodes", episodes, Episodes), checked("seed", seed, Natural), _film(video)
    if agent is None and env is None:
        raise UserError("Watch what? Name a run, or an environment to act in at random.")
    elsewhere: dict[str, Any] = {"env": env, "env_kwargs": _kwargs(env_kwargs)}
    arguments = env_arguments(_config_of(agent, env), **elsewhere)
    if file is None:
        playback.require_display()
    vec = _env_for(agent, episodes, **elsewhere)
    try:
        if vec.scene and episodes > vec.num_envs:
            raise UserError(f"At most {vec.num_envs} flights of this run can be shown, not {episodes}.")
        shown_by = None if random else agent
        how = {"episodes": episodes, "seed": seed, "deterministic": deterministic, "video": file}
        scores = _show(shown_by, vec, arguments, **how)
    finally:
        vec.close()
    if episodes > 1 or scores.measures:
        say(pages.sentence(scores.to_json()))
    if file:
        say(f"Recorded in {file}.")
    return scores


def final_return(run: str | Path | TrainedRun, *, trust: bool = False) -> float:
    """Mean return of a run's newest policy over 100 episodes, from `final_scores`."""
    return final_scores(run, trust=trust)["mean_return"]


def final_scores(run: str | Path | TrainedRun, *, trust: bool = False) -> dict[str, Any]:
    """Scores of a run's newest policy over 100 episodes; kept in `final.json` until there is a newer policy.

    They are those of `Evaluation.to_json`, with the `step` of the policy and the `seed` of the starts.
    """
    path = path_of(run)
    file = path / "final.json"
    known = _known_scores(file)
    if known.get("step") not in checkpoint.list_steps(path / "checkpoints")[-1:]:
        policy = load(run, trust=trust)
        say(f"Evaluating {path}: {FINAL_EPISODES} episodes.")
        scores = evaluate(policy, episodes=FINAL_EPISODES, seed=0)
        known = {"step": policy.step, "seed": 0, **scores.to_json()}
        write_json(file, known)
    return known


def _known_scores(file: Path) -> dict[str, Any]:
    """The scores that were kept; none where the file is not there, or is damaged: they can be found again."""
    if not os.path.lexists(file):
        return {}
    try:
        return read_json(file)
    except DamagedFileError as error:
        say(error)
        return {}


def report_on(run: TrainedRun) -> list[Path]:
    """Evaluate a run's final policy, draw it, and name the files; returns the pictures."""
    files = draw_run(run, film=True)
    for file in files:
        say(file)
    return [file for file in files if file.suffix == ".png"]


def draw_run(run: str | Path | TrainedRun, by: str = "step", *, film: bool = False, trust: bool = False) -> list[Path]:
    """Draw a run and its final scores into its `plots/`, and write its page; returns the files, the page last.

    What cannot be evaluated here is left out, and a line says so. With `film` a flight is recorded too, where there is
    a scene.
    """
    path, scores, flights = path_of(run), None, list[Path]()
    make_directory(path / "plots")
    if checkpoint.list_steps(path / "checkpoints"):
        try:
            scores = final_scores(run, trust=trust)
            say(pages.sentence(scores))
            flights = _draw_flights(load(run, trust=trust), path, film)
        except UserError as error:
            say(f"{path} is drawn without an evaluation: {error}")
    return pages.draw_run(path, scores, flights, by)


def _draw_flights(policy: TrainedPolicy, path: Path, film: bool) -> list[Path]:
    """The pictures of a policy's flights, into the `plots/` of a run; none where there is no scene."""
    episodes = policy.config.evaluate_episodes
    env = evaluation_env(policy.config, episodes)
    try:
        return flight.draw_flights(policy.module, env, path, episodes, film) if env.scene else []
    finally:
        env.close()


def _film(video: str | Path | None) -> Path | None:
    """The file of a film. Raises `UserError` for one that could not be written."""
    if not isinstance(video, str | PathLike | None):
        raise UserError(f"video must be a path, such as 'film.gif', not {shown(video)}.")
    if video is not None:
        playback.check_film(Path(video))
    return None if video is None else Path(video)


def _kwargs(env_kwargs: Mapping[str, Any] | None) -> dict[str, Any] | None:
    return checked("env_kwargs", env_kwargs, dict | None)


def _config_of(agent: TrainedPolicy | Agent | None, env: str | Callable[..., Any] | None) -> RunConfig:
    """The Config of a policy; without one, that of `env` alone. Raises `UserError` for a function without `env`."""
    if isinstance(agent, TrainedPolicy):
        return agent.config
    if agent is not None and not takes(agent, 1):
        raise UserError(f"A policy that is a function takes one observation; {shown(agent)} does not.")
    if env is None:
        raise UserError("A function acts in an environment that is named with it, such as env='CartPole-v1'.")
    return RunConfig(env=registry.name_of(env))


def _env_for(agent: TrainedPolicy | Agent | None, episodes: int, **elsewhere: Any) -> VecEnv:
    """The environments of an evaluation. Raises `UserError` where the policy cannot act."""
    vec = evaluation_env(_config_of(agent, elsewhere["env"]), episodes, **elsewhere)
    if isinstance(agent, TrainedPolicy) and not vec.spec.fits(agent.spec):
        vec.close()
        raise UserError(
            f"A policy for {agent.spec.env_id} cannot act in {vec.spec.env_id}: observation or action spaces differ."
        )
    return vec


def _baseline_of(vec: VecEnv) -> Baseline:
    """The baseline of an environment. Raises `UserError` where there is none."""
    if vec.baseline is None:
        raise UserError(f"{vec.spec.env_id} has no baseline to compare with.")
    return vec.baseline


def _show(
    agent: TrainedPolicy | Agent | None, vec: VecEnv, arguments: dict[str, Any], *, deterministic: bool, **how: Any
) -> Evaluation:
    """Play flights where `vec` has a scene, else episodes in a rendered environment; at random without an agent."""
    if isinstance(agent, TrainedPolicy):
        if vec.scene:
            return flight.show_flights(agent.module, vec, deterministic=deterministic, **how)
        drawn = TrainedPolicy(agent.networks, agent.spec, agent.config.replace(seed=how["seed"]), agent.step)
        act = partial(drawn.act, deterministic=deterministic)
        return playback.show_episodes(act if drawn.is_masked else playback.act_by(act), arguments, **how)
    if vec.scene and agent is None:
        return flight.show_flights(None, vec, **how)
    return playback.show_episodes(playback.act_by(agent) if agent else None, arguments, **how)
