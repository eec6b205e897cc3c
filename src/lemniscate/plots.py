"""The verb for the curves of runs, plot, and the final returns that runs are compared by."""

from pathlib import Path
from typing import Any

from lemniscate.console import in_notebook, say
from lemniscate.envs import registry
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError
from lemniscate.policy import TrainedPolicy
from lemniscate.report import compare, curves, playback, run_page
from lemniscate.report import pictures as pictures_of
from lemniscate.report.groups import group
from lemniscate.results import TrainedRun, evaluate, load, path_of
from lemniscate.run import checkpoint
from lemniscate.run.directory import is_finished, read_config
from lemniscate.run.environments import evaluation_env
from lemniscate.run.files import DamagedFileError, read_json, write_json
from lemniscate.run.metrics import read_metrics
from lemniscate.run.q_bias import QBias
from lemniscate.run.sweep_file import is_sweep, read_sweep

FINAL_EPISODES = 100
"""that a run's final policy is judged by where runs are compared"""


def plot(*runs: str | Path | TrainedRun | list[str | Path | TrainedRun], by: str = "step") -> list[Path]:
    """Draw the curves of a run into its `plots/`, or compare several, or a list of them, grouped by all but the seed.

    Beside the pictures stands `report.html`, a page with all of them, the final evaluation, the settings, the commands
    that do it again, and what to try next. In a notebook the pictures are also shown below the cell.

    Where the environment has a scene, flights are drawn too; where there is a Q, its predictions beside the returns.

    A sweep stands for its runs, and has a `plots/` of its own; other comparisons are drawn into `plots/` here, with a
    table on standard error. The newest policy of one run is evaluated, of several the final policy of each that is
    finished: over 100 episodes, kept in `final.json`.

    Args:
        *runs: run directories, or those of sweeps.
        by: the horizontal axis of the learning curve: "step", "episode" or "minute". By episode the curve is the moving
            average of 20 episodes.

    Returns:
        The files, the page last.

    Raises:
        UserError: no runs, or without metrics; another axis.
    """
    curves.require_by(by)
    given = [run for one in runs for run in (one if isinstance(one, list | tuple) else [one])]
    paths = [path_of(run) for run in given]
    if not paths:
        raise UserError("There is nothing to plot: name one run or several, such as plot('runs/lander').")
    found = [run for path in paths for run in _members(path)]
    folder = paths[0] / "plots" if len(paths) == 1 else Path("plots")
    if found == paths[:1]:
        files = _plot_run(paths[0], folder, by)
    else:
        files = compare.report(group(found), _final_returns(found), folder, by)
    if in_notebook():
        playback.show_pictures(file for file in files if file.suffix == ".png")
    return files


def _plot_run(run: Path, folder: Path, by: str) -> list[Path]:
    """The pictures of one run, and its page. What cannot be evaluated here is left out, and a line says so."""
    pictures, scores = curves.plot_runs([run], folder, by=by), None
    if checkpoint.list_steps(run / "checkpoints"):
        try:
            scores = final_scores(run)
            if "q_bias" in scores:
                q_bias = QBias(scores["q_bias"]["predicted"], scores["q_bias"]["realised"])
                pictures.append(curves.draw_q_bias(q_bias, run, folder / "q.png"))
            policy = load(run)
            if env := _scene_env(policy):
                flights = policy.config.evaluate_episodes
                pictures += pictures_of.draw_flight(policy.module, env, folder, flights, seed=0)
        except UserError as error:
            say(f"{run} is drawn without an evaluation: {error}")
    return [*pictures, run_page.write(run, pictures, scores)]


def final_return(run: str | Path | TrainedRun) -> float:
    """Mean return of a run's newest policy over 100 episodes, from `final_scores`."""
    return final_scores(run)["mean_return"]


def final_scores(run: str | Path | TrainedRun) -> dict[str, Any]:
    """Scores of a run's newest policy over 100 episodes; kept in `final.json` until there is a newer policy.

    They are those of `Evaluation.to_json`, with the `step` of the policy and the `seed` of the starts.
    """
    path = path_of(run)
    file = path / "final.json"
    known = _known_scores(file)
    if known.get("step") not in checkpoint.list_steps(path / "checkpoints")[-1:]:
        policy = load(path)
        say(f"Evaluating {path}: {FINAL_EPISODES} episodes.")
        scores = evaluate(policy, episodes=FINAL_EPISODES, seed=0)
        known = {"step": policy.step, "seed": 0, **scores.to_json()}
        write_json(file, known)
    return known


def _known_scores(file: Path) -> dict[str, Any]:
    """The scores that were kept; none if the file is not there, or damaged, so that they are found again."""
    try:
        return read_json(file)
    except DamagedFileError as error:
        if file.exists():
            say(error)
        return {}


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
    """A run itself, or those of a sweep that have something to show."""
    if not is_sweep(path):
        read_config(path)
    runs = [run for run in (read_sweep(path).runs if is_sweep(path) else [path]) if read_metrics(run)]
    if not runs:
        raise UserError(f"{path} has no metrics to plot yet.")
    return runs


def _scene_env(policy: TrainedPolicy) -> VecEnv | None:
    """Environments to draw flights in, where the backend has a scene for them."""
    config = policy.config
    if not hasattr(registry.backend_class(config.backend or registry.backend_for(config.env)), "scene"):
        return None
    env = evaluation_env(config, config.evaluate_episodes)
    return env if env.scene else None
