"""The verbs that look: evaluate, watch, check; and the final scores by which runs are compared."""

import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from lemniscate import algos, doctor, presets
from lemniscate.algos import RECOMMENDED
from lemniscate.api import agents
from lemniscate.api.policy import Trained, TrainedPolicy, TrainedRun, algorithm_of, load, own_code, path_of, save
from lemniscate.doctor import Diagnosis
from lemniscate.doctor.rules import seeds_differ
from lemniscate.envs import check as env_check
from lemniscate.envs import registry
from lemniscate.envs.check import Finding
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError, export_line, shown
from lemniscate.hub import repository as hub
from lemniscate.report import flight, pages, playback
from lemniscate.report.seeds import group
from lemniscate.run import check as run_check
from lemniscate.run import checkpoint
from lemniscate.run.checkpoint import list_steps
from lemniscate.run.config import Episodes, Natural, RunConfig, checked
from lemniscate.run.directory import CONFIG, FINAL, read_config, require_no_part_of_a_run
from lemniscate.run.environments import env_arguments, evaluation_env
from lemniscate.run.evaluate import Evaluation, critic_of
from lemniscate.run.evaluate import evaluate as evaluate_policy
from lemniscate.run.places import is_sweep, read_sweep
from lemniscate.run.seeding import torch_defaults
from lemniscate.run.signals import environment_signals
from lemniscate.spec import Spec
from lemniscate.system.console import say
from lemniscate.system.files import DamagedFileError, at_home, file_in_the_way, make_directory, read_json, write_json
from lemniscate.types import Rollout

FINAL_EPISODES = 100
"""that a run's final policy is judged by where runs are compared"""


@torch_defaults()
def evaluate(
    policy: Any,
    env: str | Callable[..., Any] | None = None,
    episodes: int = 100,
    seed: int = 0,
    *,
    deterministic: bool = True,
    backend: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    baseline: bool = False,
    video: str | Path | None = None,
    report: str | Path | None = None,
    agent: Callable[..., Any] | str | None = None,
    normalized_actions: bool | None = None,
    checkpoint: str | int | None = None,
    trust: bool = False,
) -> Evaluation:
    """Play whole episodes from starts drawn with `seed`, none of which training ever saw.

    Args:
        policy: from `load` or `train`, or the path of a run or a checkpoint. Or one of your own, or its name as
            `module:name`: a function of one observation or of a batch to actions for the environment's `step`, a torch
            module, an object with a method such as `act` or `predict`, or the path of a .pt file of weights.
        env: an id, `module:Class`, a class, or a function that makes an environment; by default the one of training. A
            policy of your own needs one.
        episodes: how many.
        seed: of the starts.
        deterministic: act by the mode of the distribution.
        backend: simulation backend; that of training unless named, or by the id if `env` is another.
        env_kwargs: arguments of the environment that are to be other than in training.
        baseline: play the same episodes by the classical controller that the environment has for comparison.
        video: a .gif, .webp or .mp4 to record all episodes into. They are then played one after the other in one
            rendered environment, without a measurement of the Q bias. The first 16 starts are the same; from the 17th
            on, and in other backends than gymnasium, returns may differ from those without a video. Of flights in a
            scene, which are those without a video, the first of each parallel environment is recorded.
        report: a directory for a page of the evaluation, `plots/report.html`, with its pictures and a video.
        agent: for a .pt file, the class of the module that it has the weights of, a function that makes it, or its
            name; not needed for the layouts of the courses.
        normalized_actions: of a policy of your own, whether its actions are in [-1, 1] between the bounds, and not in
            the environment's units; those of a file are by default what is worth more, which is said.
        checkpoint: as in `load`; and so `trust`.

    Raises:
        UserError: numbers out of range; an environment that cannot be made, or whose spaces differ; one without a
            baseline, if it is asked for; an episode that does not end in an environment without a time limit; with
            `video`, an environment that renders no pictures, or another kind of file; with `report`, a file or another
            run.
    """
    chosen = agents.find(policy, checkpoint=checkpoint, trust=trust)
    episodes, seed, file = checked("episodes", episodes, Episodes), checked("seed", seed, Natural), _video_file(video)
    deterministic = checked("deterministic", deterministic, bool)
    kwargs, folder = checked("env_kwargs", env_kwargs, dict | None), _folder_of(report, chosen)
    how: dict[str, Any] = {"episodes": episodes, "seed": seed, "deterministic": deterministic}
    own = {"agent": agent, "normalized": checked("normalized_actions", normalized_actions, bool | None)}
    with _environments(chosen, env, own, how, env_kwargs=kwargs, backend=backend) as (player, vec, arguments):
        if baseline:
            if vec.baseline is None:
                raise UserError(f"{vec.spec.env_id} has no baseline to compare with.")
            if file or folder or not deterministic:
                raise UserError("Of a baseline there are the scores alone: leave out video, report and stochastic.")
            return evaluate_policy(vec.baseline, vec, episodes, seed)
        if file:
            scores = _show(player, vec, arguments, **how, video=file, tell=str)
        elif isinstance(player, TrainedPolicy):
            critic = critic_of(player.networks, player.config)
            scores = evaluate_policy(player.module, vec, episodes, seed, deterministic, critic)
        else:
            scores = evaluate_policy(player, vec, episodes, seed)
        if folder:
            how["episodes"] = min(episodes, vec.num_envs, 20)
            since = time.time() - 2  # a disk's times may be of seconds
            pictures = _draw(player, vec, arguments, how, folder)
            trained = isinstance(chosen, TrainedPolicy)
            name = str(policy) if isinstance(policy, str | PathLike) else str(chosen.path if trained else shown(policy))
            for made in (*pictures, pages.write_evaluation(folder, name, pictures, scores, seed, since)):
                say(made)
        return scores


def _folder_of(report: str | Path | None, chosen: Any) -> Path | None:
    """The directory of a report. Raises `UserError` for a file, and for a run that `chosen`, a policy, is not of."""
    if report is None:
        return None
    folder, path = path_of(report), chosen.path if isinstance(chosen, TrainedPolicy) else None
    if file_there := file_in_the_way(folder):
        raise UserError(f"report is a directory, such as 'runs/upright', and {file_there} is a file.")
    own = [] if path is None else [path.resolve(), *path.resolve().parents]
    if (folder / CONFIG).exists() and folder.resolve() not in own:
        raise UserError(
            f"{folder} is another run, whose page this would replace: name another directory for the report."
        )
    return folder


@torch_defaults()
def watch(
    policy: Any = None,
    env: str | Callable[..., Any] | None = None,
    *,
    episodes: int = 1,
    seed: int = 0,
    deterministic: bool = True,
    random: bool = False,
    video: str | Path | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    agent: Callable[..., Any] | str | None = None,
    normalized_actions: bool | None = None,
    checkpoint: str | int | None = None,
    trust: bool = False,
) -> Evaluation:
    """Show episodes: below the cell in a notebook, in a window elsewhere, or recorded into a video.

    Says return and length of each on standard error, then their means and standard deviations.

    Args:
        policy: as in `evaluate`; none for uniformly random actions in `env`.
        env: as in `evaluate`.
        episodes: how many.
        seed: of the starts, and of the actions where they are drawn.
        deterministic: act by the mode of the distribution; otherwise actions are drawn from it.
        random: act uniformly at random, in the environment of the policy.
        video: a .gif, .webp or .mp4 to record all episodes into.
        env_kwargs: as in `evaluate`, and so `agent` and `normalized_actions`.
        checkpoint: as in `load`; and so `trust`.

    Raises:
        UserError: nothing to show it on; numbers out of range; an environment that cannot be made, renders no pictures,
            or whose spaces differ; an episode that does not end; more flights than parallel environments; another kind
            of file.
    """
    chosen = None if policy is None else agents.find(policy, checkpoint=checkpoint, trust=trust)
    episodes, seed, file = checked("episodes", episodes, Episodes), checked("seed", seed, Natural), _video_file(video)
    if chosen is None and env is None:
        raise UserError("Watch what? Name a run, or an environment to act in at random.")
    if chosen is None and not (checkpoint is agent is normalized_actions is None):
        raise UserError("checkpoint, agent and normalized_actions are of a policy, and there is none.")
    kwargs = checked("env_kwargs", env_kwargs, dict | None)
    deterministic = checked("deterministic", deterministic, bool)
    own = {"agent": agent, "normalized": checked("normalized_actions", normalized_actions, bool | None)}
    how: dict[str, Any] = {"episodes": episodes, "seed": seed, "deterministic": deterministic}
    with _environments(chosen, env, own, how, env_kwargs=kwargs) as (player, vec, arguments):
        if file is None:
            playback.require_display()
        if vec.scene and episodes > vec.num_envs:
            raise UserError(f"At most {vec.num_envs} flights of this run can be shown, not {episodes}.")
        scores = _show(None if random else player, vec, arguments, video=file, **how)
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
            of a sweep, what `train` returned, or a policy loaded from there.
        backend: of an environment, a simulation backend; by default the first that serves it.
        env_kwargs: arguments of the environment.
        wrappers: around each single environment, the first innermost.

    Returns:
        Everything found, each a sentence with a grade; what keeps an environment from being made is the last.

    Raises:
        UserError: no such environment, backend or wrapper; a directory that is no run, or a part of one; what is for an
            environment, with a run.
    """
    is_path = isinstance(what, Path | TrainedRun | TrainedPolicy)
    name = str(path_of(what)) if is_path else registry.name_of(what)
    return list(each_finding(name, backend, env_kwargs, registry.names_of(wrappers)))


def each_finding(
    what: str, backend: str | None, env_kwargs: Mapping[str, Any] | None, wrappers: Sequence[str]
) -> Iterator[Finding]:
    """The findings of `check`, one by one."""
    path = path_of(what)
    require_no_part_of_a_run(path)
    if run_check.is_stored(path):
        if backend or env_kwargs or wrappers:
            raise UserError(
                f"{path} is a run, and has its own environment: leave out backend, env_kwargs (--env-args), wrappers."
            )
        return run_check.each_finding(path)
    if path.is_dir():
        raise UserError(f"{path} is a directory, and no run: it has no {CONFIG}.")
    return env_check.each_finding(what, backend, env_kwargs, wrappers, _doctor_sentences)


def _doctor_sentences(rollouts: Sequence[Rollout], spec: Spec) -> list[str]:
    """The doctor's sentences on rollouts [T, N, …] of random play, each looked at in two halves."""
    halves = [
        rows[half] for rows in rollouts for half in (slice(len(rows.done) // 2), slice(len(rows.done) // 2, None))
    ]
    return doctor.random_play_faults([environment_signals(rows, spec) for rows in halves if rows.valid.sum() > 1])


def runs_in(what: str) -> list[Path]:
    """The runs that a path stands for: itself, or those of a sweep; none for an environment."""
    path = at_home(what)
    if not run_check.is_stored(path):
        return []
    return [run for run in read_sweep(path).runs if (run / CONFIG).exists()] if is_sweep(path) else [path]


def spread_of(what: str) -> str | None:
    """A sentence for each group of a sweep whose final returns, of the seeds that have one, differ much; else None."""
    runs = runs_in(what)
    scores = {run: known["mean_return"] for run in runs if "mean_return" in (known := _known_scores(run / FINAL))}
    said = [(one.label, seeds_differ(one.finals(scores))) for one in group(runs)]
    return "\n".join(f"{label}: {sentence}" for label, sentence in said if sentence) or None


def verdict(what: str, found: list[Finding]) -> str:
    """The conclusion from the findings, in a sentence or two."""
    path = at_home(what)
    return run_check.verdict(path, found) if run_check.is_stored(path) else env_check.verdict(what, found)


def diagnose(run: Trained) -> list[Diagnosis]:
    """The findings about a run, in words: what was seen, what it means, and what to change.

    Its settings, its lines of metrics and its final scores are looked at, and whether its environment keeps to a seed.
    Nothing is trained, and nothing is changed.

    Args:
        run: its directory, what `train` returned, or a policy of it.

    Returns:
        The findings, causes before consequences, which are left out beside a cause; none where no rule applies.

    Raises:
        UserError: no run, or one of another version.
    """
    path = path_of(run)
    algorithm, fields = read_config(path)
    kind = algos.find(algorithm).Config
    config = kind.from_json(fields)
    own = [preset.config for preset in presets.of(algorithm) if preset.config.env == config.env]
    known = _known_scores(path / FINAL)
    return doctor.diagnose(doctor.evidence_of(path, config, [*own, kind()], known, *_begins(config)))


def _begins(config: RunConfig) -> tuple[bool | None, bool | None]:
    """Whether a run's environment begins alike from one seed, and otherwise from another one.

    None where that is not found out in a moment.
    """
    arguments = env_arguments(config)
    try:
        cls = registry.backend_class(arguments["backend"] or registry.backend_for(config.env, config.all_wrappers))
        if cls.compiled or cls.exists_once(config.env, config.num_envs):
            return None, None
        with closing(registry.make(num_envs=2, **arguments)) as env:
            one, again, other = (env.restart(seed).clone() for seed in (1, 1, 2))
            return torch.equal(one, again), not torch.equal(one, other)
    except Exception:  # whatever an environment raises that is no longer as it was in training
        return None, None


def scores_of(policy: TrainedPolicy) -> dict[str, Any]:
    """Scores of a policy over 100 episodes: `Evaluation.to_json`, with its `step` and the `seed` of the starts."""
    say(f"Evaluating {policy.path or 'the policy'}: {FINAL_EPISODES} episodes.")
    return {"step": policy.step, "seed": 0, **evaluate(policy, episodes=FINAL_EPISODES, seed=0).to_json()}


def final_return(run: str | Path | TrainedRun) -> float:
    """Mean return of a run's newest policy over 100 episodes, from `final_scores`."""
    return final_scores(run)["mean_return"]


def final_scores(run: str | Path | TrainedRun) -> dict[str, Any]:
    """The `scores_of` a run's newest policy; kept in `final.json` until there is a newer policy."""
    path = path_of(run)
    known = _known_scores(path / FINAL)
    if known.get("step") not in list_steps(path / "checkpoints")[-1:]:
        known = scores_of(load(run))
        try:
            write_json(path / FINAL, known)
        except OSError as error:  # somebody else's run, or a full disk: the scores are known all the same
            say(f"{path / FINAL} cannot be written, so the scores are not kept: {error.strerror or error}.")
    return known


def _known_scores(file: Path) -> dict[str, Any]:
    """The scores that were kept; none where the file is not there, or is damaged: they can be found again."""
    try:
        return read_json(file) if os.path.lexists(file) else {}
    except DamagedFileError as error:
        say(error)
        return {}


def record_or_say(policy: TrainedPolicy, file: Path) -> None:
    """Record an episode, where the environment can be rendered; a line says why where it cannot."""
    try:
        evaluate(policy, episodes=1, video=file)
    except Exception as error:  # whatever a renderer raises: a policy without a video is a policy
        say(f"No video: {error}")


def _video_file(video: str | Path | None) -> Path | None:
    """The file of a video. Raises `UserError` for one that could not be written."""
    if not isinstance(video, str | PathLike | None):
        raise UserError(f"video must be a path, such as 'video.gif', not {shown(video)}.")
    file = None if video is None else at_home(video)
    if file:
        playback.check_video(file)
    return file


@contextmanager
def _environments(
    chosen: Any, env: str | Callable[..., Any] | None, own: Mapping[str, Any], how: dict[str, Any], **elsewhere: Any
) -> Iterator[tuple[Any, VecEnv, dict[str, Any]]]:
    """The player, the environments of an evaluation, and the arguments of a single one.

    Raises `UserError` for other spaces than those of a policy, and for one of the user's own without `env`.
    """
    if isinstance(chosen, TrainedPolicy):
        config = chosen.config
        if any(value is not None for value in own.values()):
            raise UserError("agent and normalized_actions are for policies of your own; this one was trained here.")
    elif env is None:
        raise UserError("A policy of your own acts in an environment that is named with it, such as env='CartPole-v1'.")
    else:
        name = registry.name_of(env)
        compiled = registry.backend_class(elsewhere.get("backend") or registry.backend_for(name)).compiled
        usual = presets.choose(RECOMMENDED, name, None)[1].num_envs  # of which the starts are those of most runs
        config = RunConfig(env=name, num_envs=registry.count_of(env) or (usual if compiled else 1))
    with ExitStack() as stack:
        vec = stack.enter_context(closing(evaluation_env(config, how["episodes"], env=env, **elsewhere)))
        player = chosen
        if isinstance(chosen, TrainedPolicy):
            if not vec.spec.fits(chosen.spec):
                (seen, acts), (there, acts_there) = map(env_check.spaces_of, (chosen.spec, vec.spec))
                raise UserError(
                    f"A policy for {chosen.spec.env_id} cannot act in {vec.spec.env_id}: it observes {seen} and acts by"
                    f" {acts}; there it would observe {there} and act by {acts_there}."
                )
        elif chosen is not None:
            playing = agents.playing(chosen, vec, how["seed"], deterministic=how["deterministic"], **own)
            player = stack.enter_context(playing)
            if player.remembers and vec.num_envs > 1:
                say("This policy remembers what it was called with, so it plays in one environment at a time.")
                vec.close()
                one = evaluation_env(config.replace(num_envs=1), 1, env=env, **elsewhere)
                vec = stack.enter_context(closing(one))
        yield player, vec, env_arguments(config, env=env, **elsewhere)


def _show(player: Any, vec: VecEnv, arguments: dict[str, Any], *, deterministic: bool, **how: Any) -> Evaluation:
    """Play flights where `vec` has a scene, else episodes in a rendered environment; at random without a player."""
    trained = isinstance(player, TrainedPolicy)
    if vec.scene:
        return flight.show_flights(player.module if trained else player, vec, deterministic=deterministic, **how)
    vec.close()  # of some environments there can be one at a time
    if trained:
        drawn = TrainedPolicy(
            player.networks, player.spec, player.config.replace(seed=how["seed"] % 2**32), player.step
        )
        masked = partial(drawn.act, deterministic=deterministic)
        act = masked if drawn.is_masked else lambda obs, action_mask: masked(obs)
        return playback.show_episodes(act, arguments, begin=drawn.reset, **how)
    return playback.show_episodes(player and player.act, arguments, **how)


def _draw(player: Any, vec: VecEnv, arguments: dict[str, Any], how: dict[str, Any], folder: Path) -> list[Path]:
    """Record an episode into a folder, where it can be shown, and flights in pictures, which are returned."""
    make_directory(folder / "plots")
    if vec.scene:
        act = player.module if isinstance(player, TrainedPolicy) else player
        return flight.draw_flights(act, vec, folder, how["episodes"], record_video=True, seed=how["seed"])[:-1]
    try:
        video = folder / "videos" / "episode.gif"
        _show(player, vec, arguments, **{**how, "episodes": 1}, video=video, tell=str)
    except Exception as error:  # whatever a renderer raises
        say(f"No video: {error}")
    return []


def push(run: Trained, name: str, *, private: bool = False, license: str | None = None, trust: bool = False) -> str:
    """Upload the policy of a run to the Hugging Face Hub, as the model repository `name`, in one commit.

    The files are those of `save`: raw tensors and JSON, each with its sha256. Beside them are a model card with the
    scores, the command that trains it again and the lines that load it; the final scores of the run, its figures
    (`plots/`), its newest video, or one that is made now if the environment can be rendered; and what
    `lemniscate export` wrote of that step (`export/`), if it did. `load("hf://user/name")` loads the policy.

    Args:
        run: its directory or a checkpoint's, what `train` returned, or a policy.
        name: "user/name". A new repository is created, and a policy that is there is replaced.
        private: make a new repository private.
        license: as the Hub abbreviates it, such as "mit"; without, the card names none.
        trust: as in `load`.

    Returns:
        The address of the repository's page.

    Raises:
        UserError: `huggingface_hub` is not installed; no name of a repository; no token; no policy to upload; a Hub
            that refuses or cannot be reached; a repository that holds something else, or is public in spite of
            `private`.
    """
    hub.require_uploads(checked("name", name, str))
    private = checked("private", private, bool)
    if license is not None and not (isinstance(license, str) and re.fullmatch(r"[a-z0-9.-]+", license)):
        raise UserError(f"license is written as on the Hub, such as 'mit' or 'apache-2.0', not {shown(license)}.")
    policy = load(run, trust=trust)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "policy"
        save(policy, folder)
        code = own_code(checkpoint.read(folder))
        path = policy.path if policy.path and (policy.path / CONFIG).is_file() else None
        for place, file in _files_to_upload(path, policy.step).items() if path else ():
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, folder / place)
        if not (path and pages.newest_video(path)):
            record_or_say(policy, folder / "videos" / "episode.gif")
        scores: dict[str, Any] | None = None
        try:
            is_newest = path and list_steps(path / "checkpoints")[-1:] == [policy.step]
            scores = final_scores(path) if path and is_newest else scores_of(policy)
            write_json(folder / FINAL, scores)
        except UserError as error:
            say(f"No scores: {error}")
        own = {"step": policy.step, "scores": scores, "license": license, "code": code}
        pages.write_card(folder, name, algorithm_of(policy), policy.config, **own)
        return hub.upload(folder, name, private)


def _files_to_upload(run: Path, step: int) -> dict[str, Path]:
    """The files of a run that are uploaded beside its policy of a step, by their paths in the repository; no links.

    They are the figures, the export where there is a whole one of that step, and the newest video: a video by the name
    that the Hub plays, else in `videos/`.
    """
    files, export = [*(run / "plots").glob("*.png")], run / "export"
    if (export / "policy.c").is_file():
        with suppress(DamagedFileError):
            if read_json(export / checkpoint.MANIFEST).get("step") == step:
                files += export.rglob("*")
        if export / "policy.c" not in files:
            say(f"{export} is not of the policy of step {step:,}: it is left out; {export_line(run)}")
    own = [file for file in files if file.is_file() and file.resolve() == run.resolve() / file.relative_to(run)]
    shown = {file.relative_to(run).as_posix(): file for file in own}
    if video := pages.newest_video(run):
        shown["replay.mp4" if video.suffix == ".mp4" else f"videos/{video.name}"] = video
    return shown
