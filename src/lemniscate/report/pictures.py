"""Everything a finished run is shown with: numbers in a sentence, plots, an animation."""

import math
from pathlib import Path

from lemniscate.console import say
from lemniscate.envs.vec_env import VecEnv
from lemniscate.nn.actor_critic import ActorQ
from lemniscate.nn.policies import Policy
from lemniscate.report import curves, flight, run_page
from lemniscate.report.playback import show_flights
from lemniscate.run.evaluate import Evaluation, evaluate


def sentence(scores: Evaluation) -> str:
    """The scores of an evaluation in one sentence, or two."""
    said = (
        f"{scores.mean_return:.1f} ± {scores.std_return:.1f} return over {scores.episodes} episodes of {scores.env_id}"
    )
    if scores.measures:
        finite = {name: value for name, value in scores.measures.items() if math.isfinite(value)}
        words = [f"{run_page.words(name)} {run_page.number(name, value)}" for name, value in finite.items()]
        said += f", {scores.terminated} of them terminated; {', '.join(words)}"
    return f"{said}.\n{scores.q_bias}." if scores.q_bias else f"{said}."


def report(
    policy: Policy, env: VecEnv, path: Path, episodes: int, critic: tuple[ActorQ, float] | None = None
) -> list[Path]:
    """Evaluate from unseen starts, draw everything there is to draw, and write the run's page; returns the pictures."""
    scores = evaluate(policy, env, episodes, seed=0, critic=critic)
    say(sentence(scores))
    pictures = curves.plot_runs([path], path / "plots")
    if scores.q_bias:
        pictures.append(curves.draw_q_bias(scores.q_bias, path, path / "plots" / "q.png"))
    if env.scene:
        pictures += draw_flight(policy, env, path / "plots", episodes, seed=0)
    for picture in pictures:
        say(picture)
    if env.scene:
        film = path / "videos" / "flight.gif"
        show_flights(policy, env, 1, seed=0, video=film, tell=lambda text: None)
        say(film)
    say(run_page.write(path, pictures, {"seed": 0, **scores.to_json()}))
    return pictures


def draw_flight(policy: Policy, env: VecEnv, folder: Path, flights: int, seed: int) -> list[Path]:
    """Path and error of some flights, into `folder`."""
    track = flight.record(policy, env, flights, seed)
    return [flight.draw_path(track, folder / "flight.png"), flight.draw_error(track, folder / "error.png")]
