"""Everything a finished run is shown with: numbers in a sentence, plots, an animation."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np

from lemniscate.envs.api import VecEnv
from lemniscate.envs.gymnasium import make_one, spec_of
from lemniscate.errors import UserError
from lemniscate.nn.policies import Policy
from lemniscate.report import curves, flight
from lemniscate.run.evaluate import Evaluation, evaluate
from lemniscate.types import Spec

Act = Callable[..., np.ndarray]


def sentence(scores: Evaluation) -> str:
    """What an evaluation says to a person."""
    said = (
        f"{scores.mean_return:.1f} ± {scores.std_return:.1f} return over {scores.episodes} episodes of {scores.env_id}"
    )
    if scores.rmse_mm is not None and scores.rmse_after_1s_mm is not None:
        said += (
            f", {scores.terminated} crashes; tracking error {scores.rmse_mm:.1f} mm over the whole flight,"
            f" {scores.rmse_after_1s_mm:.2f} mm after the first second"
        )
    return said + "."


def report(policy: Policy, env: VecEnv, path: Path, episodes: int) -> list[Path]:
    """Evaluate from unseen starts, draw everything there is to draw; says what it did, returns the pictures."""
    say(sentence(evaluate(policy, env, episodes, seed=0)))
    pictures = curves.plot_runs([path])
    if env.spec.tracking:
        pictures += draw_flight(policy, env, path / "plots", episodes, seed=0)
    for picture in pictures:
        say(picture)
    if env.spec.tracking:
        say(film_flight(policy, env, path / "videos" / "flight.gif", seed=0))
    return pictures


def say(text: object) -> None:
    """Tell a person."""
    print(text, file=sys.stderr, flush=True)


def draw_flight(policy: Policy, env: VecEnv, folder: Path, flights: int, seed: int) -> list[Path]:
    """Path and error of some flights, into `folder`."""
    track = flight.record(policy, env, flights, seed)
    return [flight.draw_path(track, folder / "flight.png"), flight.draw_error(track, folder / "error.png")]


def film_flight(policy: Policy, env: VecEnv, file: Path, seed: int) -> str:
    """Animate one flight into `file`; returns a sentence on how it was drawn."""
    track = flight.record(policy, env, env.num_envs, seed)
    every = 5
    from lemniscate.envs.crazyflow import simulator
    from lemniscate.report import scene

    rendered = scene.render(track, simulator(env.spec.env_id, env.num_envs, env.device.type).model, every)
    if rendered is not None:
        frames, how = list(rendered), "rendered by MuJoCo"
    else:
        frames = flight.animate(track, every)
        how = (
            "drawn with matplotlib, since there is no off-screen OpenGL; for a MuJoCo rendering install EGL or OSMesa"
            " (Debian: libegl1 and libgl1-mesa-dri, or libosmesa6)"
        )
    flight.save_frames(frames, file, 1 / (every * track.time_step))
    return f"{file}: {how}."


def show_flight(policy: Policy, env: VecEnv, seed: int) -> None:
    """Play one flight in a window."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError("There is no display for a window; record the flight instead: --video flight.gif")
    from lemniscate.envs.crazyflow import simulator
    from lemniscate.report import scene

    track = flight.record(policy, env, env.num_envs, seed)
    scene.show(track, simulator(env.spec.env_id, env.num_envs, env.device.type).model)


def film_episode(act: Act, spec: Spec, file: Path, seed: int) -> str:
    """Record one episode of a Gymnasium environment into `file`."""
    env = _rendered(spec.env_id, "rgb_array")
    obs, info = env.reset(seed=seed)
    frames, over = [np.asarray(env.render())], False
    while not over:
        obs, _, terminated, truncated, info = env.step(act(obs, action_mask=info.get("action_mask")))
        frames.append(np.asarray(env.render()))
        over = terminated or truncated
    fps = float(env.metadata.get("render_fps", 30))
    env.close()
    flight.save_frames(frames, file, fps)
    return f"{file}: {len(frames) - 1} steps."


def show_episode(act: Act, spec: Spec, seed: int) -> None:
    """Play one episode in a window, at its own speed."""
    env = _rendered(spec.env_id, "human")
    obs, info = env.reset(seed=seed)
    over = False
    while not over:
        obs, _, terminated, truncated, info = env.step(act(obs, action_mask=info.get("action_mask")))
        over = terminated or truncated
    env.close()


def _rendered(env_id: str, mode: str) -> gym.Env:
    try:
        env = make_one(spec_of(env_id), render_mode=mode)
        env.reset(seed=0)
        env.render()
        return env
    except Exception as error:  # pygame, GLFW and MuJoCo each have their own
        raise UserError(f"{env_id} cannot be shown here: {error}") from error
