"""The verb for the curves of runs, plot; and the pictures and the page of one run."""

from contextlib import closing
from pathlib import Path

from lemniscate.api.policy import TrainedPolicy, TrainedRun, load, path_of
from lemniscate.api.results import diagnose, final_return, final_scores, record_or_say
from lemniscate.errors import UserError, unknown_name
from lemniscate.report import compare, curves, flight, pages
from lemniscate.report.seeds import group
from lemniscate.run import checkpoint
from lemniscate.run.directory import is_finished, read_config
from lemniscate.run.environments import evaluation_env
from lemniscate.run.metrics import damage, read_metrics
from lemniscate.run.places import is_sweep, read_sweep
from lemniscate.system.console import in_notebook, say
from lemniscate.system.files import make_directory

Plotted = str | Path | TrainedRun | TrainedPolicy
"""what names a run: its directory, what `train` returned, or a policy that came from there"""


def plot(*runs: Plotted | list[Plotted], by: str = "step") -> list[Path]:
    """Draw the curves of a run into its `plots/`, or compare several, or a list of them, grouped by all but the seed.

    Beside the pictures stands `report.html`, a page with all of them, the final evaluation, the settings, the commands
    that do it again, and what the doctor has found. In a notebook the pictures are also shown below the cell.

    Where the environment has a scene, flights are drawn too; where there is a Q, its predictions beside the returns.

    A sweep stands for its runs, and has a `plots/` of its own; other comparisons are drawn into `plots/` here, with a
    table on standard error. The newest policy of one run is evaluated, of several the final policy of each that is
    finished: over 100 episodes, kept in `final.json`.

    Args:
        *runs: run directories, or those of sweeps; what `train` returned; policies from `train` or `load`.
        by: the horizontal axis of the learning curve: "step", "episode" or "minute". By episode the curve is the moving
            average of 20 episodes.

    Returns:
        The files, the page last.

    Raises:
        UserError: no runs, or without metrics; another axis.
    """
    if not isinstance(by, str) or by not in curves.BY:
        raise unknown_name("axis", by, curves.BY)
    paths = [path_of(run) for one in runs for run in (one if isinstance(one, list | tuple) else [one])]
    if not paths:
        raise UserError("There is nothing to plot: name one run or several, such as plot('runs/lander').")
    found = [run for path in paths for run in _members(path)]
    folder = paths[0] / "plots" if len(paths) == 1 else Path("plots")
    if len(paths) == 1:
        make_directory(folder)
    if found == paths[:1]:
        files = draw_run(paths[0], by)
    else:
        files = compare.report(group(found), _final_returns(found), folder, by)
    if in_notebook():
        from IPython.display import Image, display

        for file in _pictures(files):
            display(Image(filename=str(file)))
    return files


def report_on(run: TrainedRun) -> list[Path]:
    """Evaluate a run's final policy, draw it, and name the files; returns the pictures."""
    files = draw_run(run, record_video=True)
    for file in files:
        say(file)
    return _pictures(files)


def draw_run(run: str | Path | TrainedRun, by: str = "step", *, record_video: bool = False) -> list[Path]:
    """Draw a run and its final scores into its `plots/`, and write its page; returns the files, the page last.

    What cannot be evaluated here is left out, and a line says so. With `record_video` an episode is recorded too.
    """
    path, scores, flights = path_of(run), None, list[Path]()
    folder = path / "plots"
    make_directory(folder)
    if checkpoint.list_steps(path / "checkpoints"):
        try:
            scores = final_scores(run)
            say(pages.sentence(scores))
            policy = load(run)
            episodes = policy.config.evaluate_episodes
            with closing(evaluation_env(policy.config, episodes)) as env:
                scene = env.scene
                flights = flight.draw_flights(policy.module, env, path, episodes, record_video) if scene else []
            if record_video and not scene:
                record_or_say(policy, path / "videos" / f"step-{policy.step}.gif")
        except UserError as error:
            say(f"{path} is drawn without an evaluation: {error}")
    files = curves.plot_runs([path], folder, by=by)
    if scores and "q_bias" in scores:
        files.append(curves.draw_q_bias(pages.q_bias(scores), path, folder / "q.png"))
    files += flights
    try:
        found = diagnose(path)
    except UserError as error:
        say(f"{path} is drawn without a diagnosis: {error}")
        found = []
    return [*files, pages.write_run(path, _pictures(files), scores, found)]


def _pictures(files: list[Path]) -> list[Path]:
    """The files without videos and pages."""
    return [file for file in files if file.suffix == ".png"]


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
    every = list(read_sweep(path).runs) if is_sweep(path) else [path]
    runs = [run for run in every if read_metrics(run)]
    if not runs:
        raise UserError(f"{path} has no metrics to plot yet.")
    if absent := [run.name for run in every if run not in runs]:
        say(f"{path} has no metrics yet of {', '.join(absent)}: they are left out.")
    for sentence in filter(None, (damage(run, logged=0) for run in runs)):
        say(sentence)
    return runs
