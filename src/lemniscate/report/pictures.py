"""Everything a run is shown with: numbers in a sentence, plots, an animation, a page."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lemniscate.envs.vec_env import VecEnv
from lemniscate.nn.policies import Policy
from lemniscate.report import curves, flight, run_page
from lemniscate.report.playback import show_flights
from lemniscate.run.q_bias import QBias
from lemniscate.system.files import make_directory


def sentence(scores: Mapping[str, Any]) -> str:
    """The scores of an evaluation, as `Evaluation.to_json` has them, in one sentence, or two."""
    mean, std = scores["mean_return"], scores["std_return"]
    said = f"{mean:.1f} ± {std:.1f} return over {scores['episodes']} episodes of {scores['env_id']}"
    if measures := run_page.measures(scores):
        words = [f"{run_page.words(name)} {run_page.number(name, value)}" for name, value in measures.items()]
        said += f", {scores['terminated']} of them terminated; {', '.join(words)}"
    return f"{said}.\n{_q_bias(scores)}." if "q_bias" in scores else f"{said}."


def draw_run(run: Path, scores: Mapping[str, Any] | None, flights: Sequence[Path], by: str) -> list[Path]:
    """Draw the curves of a run and write its page; returns the files, the page last.

    Args:
        run: the run directory.
        scores: of its newest policy, those of `results.final_scores`, if there are any.
        flights: what `draw_flights` returned.
        by: "step", "episode" or "minute", the horizontal axis of the learning curve.
    """
    pictures = curves.plot_runs([run], run / "plots", by=by)
    if scores and "q_bias" in scores:
        pictures.append(curves.draw_q_bias(_q_bias(scores), run, run / "plots" / "q.png"))
    pictures += [file for file in flights if file.suffix == ".png"]
    films = [file for file in flights if file not in pictures]
    return [*pictures, *films, run_page.write(run, pictures, scores)]


def draw_flights(policy: Policy, env: VecEnv, run: Path, flights: int, film: bool) -> list[Path]:
    """Path and error of some flights in a scene, into the `plots/` of a run; with `film` one of them into `videos/`."""
    track = flight.record(policy, env, flights, seed=0)
    beside = flight.record(env.baseline, env, flights, seed=0) if env.baseline else None
    folder, video = run / "plots", run / "videos" / "flight.gif"
    if film:
        make_directory(video.parent)
        show_flights(policy, env, 1, seed=0, video=video, tell=lambda text: None)
    drawn = [flight.draw_path(track, folder / "flight.png"), flight.draw_error(track, folder / "error.png", beside)]
    return [*drawn, video] if film else drawn


def _q_bias(scores: Mapping[str, Any]) -> QBias:
    return QBias(scores["q_bias"]["predicted"], scores["q_bias"]["realised"])
