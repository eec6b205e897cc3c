"""The verbs that look: evaluate, watch, check; and the final scores by which runs are compared."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from lemniscate.api.policy import Trained, TrainedPolicy, TrainedRun, load, path_of
from lemniscate.envs import check as env_check
from lemniscate.envs import registry
from lemniscate.envs.check import Finding
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError, shown
from lemniscate.report import flight, pages, playback
from lemniscate.run import check as run_check
from lemniscate.run.checkpoint import list_steps
from lemniscate.run.config import Episodes, Natural, RunConfig, checked
from lemniscate.run.directory import FINAL
from lemniscate.run.environments import env_arguments, evaluation_env
from lemniscate.run.evaluate import Evaluation, critic_of
from lemniscate.run.evaluate import evaluate as evaluate_policy
from lemniscate.run.seeding import torch_defaults
from lemniscate.system.console import say
from lemniscate.system.files import DamagedFileError, at_home, read_json, write_json
from lemniscate.system.named import takes

Agent = Callable[[Any], Any]
"""a function of one observation, as Gymnasium's environment returns it, to an action for its `step`"""

FINAL_EPISODES = 100
"""that a run's final policy is judged by where runs are compared"""


@torch_defaults()
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
    checkpoint: str | int | None = None,
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
        checkpoint: as in `load`; and so `trust`.

    Raises:
        UserError: numbers out of range; an environment that cannot be made, or whose spaces differ; one without a
            baseline, if it is asked for; an episode that does not end in an environment without a time limit; with
            `video`, an environment that renders no pictures, or another kind of file.
    """
    agent = policy if callable(policy) else load(policy, checkpoint=checkpoint, trust=trust)
    episodes, seed, file = checked("episodes", episodes, Episodes), checked("seed", seed, Natural), _film(video)
    kwargs = checked("env_kwargs", env_kwargs, dict | None)
    how: dict[str, Any] = {"episodes": episodes, "seed": seed, "tell": lambda text: None}
    with _environments(agent, episodes, env, env_kwargs=kwargs, backend=backend) as (vec, arguments):
        if baseline and vec.baseline is None:
            raise UserError(f"{vec.spec.env_id} has no baseline to compare with.")
        if baseline and vec.baseline:
            return evaluate_policy(vec.baseline, vec, episodes, seed)
        if file:
            return _show(agent, vec, arguments, deterministic=deterministic, video=file, **how)
        if not isinstance(agent, TrainedPolicy):
            vec.close()
            return playback.play_single(playback.act_by(agent), arguments, **how)
        critic = critic_of(agent.networks, agent.config)
        return evaluate_policy(agent.module, vec, episodes, seed, deterministic, critic)


@torch_defaults()
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
    checkpoint: str | int | None = None,
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
        checkpoint: as in `load`; and so `trust`.

    Raises:
        UserError: nothing to show it on; numbers out of range; an environment that cannot be made, renders no pictures,
            or whose spaces differ; an episode that does not end; more flights than parallel environments; another kind
            of file.
    """
    agent = policy if policy is None or callable(policy) else load(policy, checkpoint=checkpoint, trust=trust)
    episodes, seed, file = checked("episodes", episodes, Episodes), checked("seed", seed, Natural), _film(video)
    if agent is None and env is None:
        raise UserError("Watch what? Name a run, or an environment to act in at random.")
    kwargs = checked("env_kwargs", env_kwargs, dict | None)
    with _environments(agent, episodes, env, env_kwargs=kwargs) as (vec, arguments):
        if file is None:
            playback.require_display()
        if vec.scene and episodes > vec.num_envs:
            raise UserError(f"At most {vec.num_envs} flights of this run can be shown, not {episodes}.")
        how = {"episodes": episodes, "seed": seed, "deterministic": deterministic, "video": file}
        scores = _show(None if random else agent, vec, arguments, **how)
    if episodes > 1 or any(not name.startswith("info/") for name in scores.measures):
        say(pages.sentence(scores.to_json()))
    if file:
        say(f"Recorded in {file}.")
    return scores


@torch_defaults()
def check(
    what: "str | Path | TrainedRun | Callable[..., Any]",
    backend: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[str | Callable[..., Any]] = (),
) -> list[Finding]:
    """Check that an environment is suitable for training, or that the files of a run are whole.

    An environment is looked at with Gymnasium's own checker and by random play; of a run or a sweep every file is read,
    and nothing is changed.

    Args:
        what: an environment: an id, `module:Class`, a class, or a function that makes one. Or the directory of a run or
            of a sweep, or what `train` returned.
        backend: of an environment, a simulation backend; by default the first that serves it.
        env_kwargs: arguments of the environment.
        wrappers: around each single environment, the first innermost.

    Returns:
        Everything found, each a sentence with a grade; what keeps an environment from being made is the last.

    Raises:
        UserError: no such environment, backend or wrapper.
    """
    what = what.path if isinstance(what, TrainedRun) else what
    name = str(what) if isinstance(what, Path) else registry.name_of(what)
    return list(each_finding(name, backend, env_kwargs, registry.names_of(wrappers)))


def each_finding(
    what: str, backend: str | None, env_kwargs: Mapping[str, Any] | None, wrappers: Sequence[str]
) -> Iterator[Finding]:
    """The findings of `check`, one by one."""
    path = at_home(what)
    if run_check.is_stored(path):
        return run_check.each_finding(path)
    return env_check.each_finding(what, backend, env_kwargs, wrappers)


def verdict(what: str, found: list[Finding]) -> str:
    """The conclusion from the findings, in a sentence or two."""
    path = at_home(what)
    return run_check.verdict(path, found) if run_check.is_stored(path) else env_check.verdict(what, found)


def scores_of(policy: TrainedPolicy) -> dict[str, Any]:
    """Scores of a policy over 100 episodes: `Evaluation.to_json`, with its `step` and the `seed` of the starts."""
    scores = evaluate(policy, episodes=FINAL_EPISODES, seed=0)
    return {"step": policy.step, "seed": 0, **scores.to_json()}


def final_return(run: str | Path | TrainedRun) -> float:
    """Mean return of a run's newest policy over 100 episodes, from `final_scores`."""
    return final_scores(run)["mean_return"]


def final_scores(run: str | Path | TrainedRun) -> dict[str, Any]:
    """The `scores_of` a run's newest policy; kept in `final.json` until there is a newer policy."""
    path = path_of(run)
    file = path / FINAL
    known = _known_scores(file)
    if known.get("step") not in list_steps(path / "checkpoints")[-1:]:
        say(f"Evaluating {path}: {FINAL_EPISODES} episodes.")
        known = scores_of(load(run))
        write_json(file, known)
    return known


def _known_scores(file: Path) -> dict[str, Any]:
    """The scores that were kept; none where the file is not there, or is damaged: they can be found again."""
    try:
        return read_json(file) if os.path.lexists(file) else {}
    except DamagedFileError as error:
        say(error)
        return {}


def film_or_say(policy: TrainedPolicy, file: Path) -> None:
    """Record an episode, where the environment can be rendered; a line says why where it cannot."""
    try:
        evaluate(policy, episodes=1, video=file)
    except Exception as error:  # whatever a renderer raises: a policy without a film is a policy
        say(f"No film: {error}")


def _film(video: str | Path | None) -> Path | None:
    """The file of a film. Raises `UserError` for one that could not be written."""
    if not isinstance(video, str | PathLike | None):
        raise UserError(f"video must be a path, such as 'film.gif', not {shown(video)}.")
    if video is None:
        return None
    playback.check_film(at_home(video))
    return at_home(video)


@contextmanager
def _environments(
    agent: TrainedPolicy | Agent | None, episodes: int, env: str | Callable[..., Any] | None, **elsewhere: Any
) -> Iterator[tuple[VecEnv, dict[str, Any]]]:
    """The environments of an evaluation, and the arguments of a single one.

    Raises `UserError` for other spaces than those of a policy, and for a function without `env`.
    """
    if isinstance(agent, TrainedPolicy):
        config = agent.config
    elif agent is not None and not takes(agent, 1):
        raise UserError(f"A policy that is a function takes one observation; {shown(agent)} does not.")
    elif env is None:
        raise UserError("A function acts in an environment that is named with it, such as env='CartPole-v1'.")
    else:
        config = RunConfig(env=registry.name_of(env), num_envs=1)
    arguments = env_arguments(config, env=env, **elsewhere)
    with closing(evaluation_env(config, episodes, env=env, **elsewhere)) as vec:
        if isinstance(agent, TrainedPolicy) and not vec.spec.fits(agent.spec):
            ours, theirs = agent.spec.env_id, vec.spec.env_id
            raise UserError(f"A policy for {ours} cannot act in {theirs}: observation or action spaces differ.")
        yield vec, arguments


def _show(
    agent: TrainedPolicy | Agent | None, vec: VecEnv, arguments: dict[str, Any], *, deterministic: bool, **how: Any
) -> Evaluation:
    """Play flights where `vec` has a scene, else episodes in a rendered environment; at random without an agent."""
    trained = isinstance(agent, TrainedPolicy)
    if vec.scene and (trained or agent is None):
        return flight.show_flights(agent.module if trained else None, vec, deterministic=deterministic, **how)
    vec.close()  # of some environments there can be one at a time
    if trained:
        drawn = TrainedPolicy(agent.networks, agent.spec, agent.config.replace(seed=how["seed"]), agent.step)
        act = partial(drawn.act, deterministic=deterministic)
        return playback.show_episodes(act if drawn.is_masked else playback.act_by(act), arguments, **how)
    return playback.show_episodes(agent and playback.act_by(agent), arguments, **how)
