"""Showing an episode: in a window, in a notebook, or into a file."""

import io
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image

from lemniscate.envs import registry
from lemniscate.envs.vec_env import PATIENCE, VecEnv
from lemniscate.errors import UserError, is_installed
from lemniscate.nn.policies import Policy
from lemniscate.report import flight
from lemniscate.run.config import RunConfig

Act = Callable[..., np.ndarray]

NOTEBOOK_FPS = 25
"""more frames a second than a browser is sent; the others are left out"""

FLIGHT_STRIDE = 5
"""a flight is drawn at every so many-th step"""


def film_episode(act: Act, config: RunConfig, file: Path, seed: int) -> str:
    """Record one episode of a run's environment into `file`; returns a sentence."""
    with_pictures = _rendered(config, "rgb_array")
    steps = -1

    def frames() -> Iterator[np.ndarray]:
        nonlocal steps
        for env in _play(with_pictures, act, seed):
            steps += 1
            yield np.asarray(env.render())

    save_frames(frames(), file, _fps(with_pictures))
    return f"{file}: {steps} steps."


def show_episode(act: Act, config: RunConfig, seed: int) -> None:
    """Play one episode of a run's environment at its own speed: in the notebook that asks, or in a window."""
    if in_notebook():
        with_pictures = _rendered(config, "rgb_array")
        send_frames((np.asarray(env.render()) for env in _play(with_pictures, act, seed)), _fps(with_pictures))
    else:
        for _ in _play(_rendered(config, "human"), act, seed):
            pass  # Gymnasium draws at each step


def film_flight(policy: Policy, env: VecEnv, file: Path, seed: int) -> str:
    """Animate one flight into `file`; returns a sentence on how it was drawn."""
    frames, fps, how = _draw_flight(flight.record(policy, env, env.num_envs, seed), env)
    save_frames(frames, file, fps)
    return f"{file}: {how}."


def show_flight(policy: Policy, env: VecEnv, seed: int) -> None:
    """Play one flight in a scene: in the notebook that asks, or in a window."""
    if in_notebook():
        frames, fps, _ = _draw_flight(flight.record(policy, env, env.num_envs, seed), env)
        send_frames(frames, fps)
        return
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError("There is no display for a window; record the flight instead: --video flight.gif")
    from lemniscate.report import scene

    scene.show(flight.record(policy, env, env.num_envs, seed), _model(env))


def require_pictures(config: RunConfig, env: VecEnv) -> None:
    """Raise `UserError` where an environment cannot be recorded; one with a scene always can."""
    if not env.scene:
        _rendered(config, "rgb_array").close()


def save_frames(frames: Iterable[np.ndarray], file: Path, fps: float) -> None:
    """An animated picture (.gif, .webp) from frames, or a film (.mp4, extra `video`); only .webp keeps all."""
    check_film(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".mp4":
        from imageio import v2 as imageio

        film: Any = imageio.get_writer(file, fps=fps)
        with film:
            for frame in frames:
                film.append_data(frame)
    else:
        images = (Image.fromarray(frame) for frame in frames)
        next(images).save(file, save_all=True, append_images=images, duration=1000 / fps, loop=0)


def check_film(file: Path) -> None:
    """Raise `UserError` for a film that could not be written, before anything is flown for it."""
    if file.suffix not in (".gif", ".webp", ".mp4"):
        raise UserError(f"{file} must end in .gif, .webp or .mp4.")
    if file.suffix == ".mp4" and not is_installed("imageio_ffmpeg"):
        raise UserError(f"{file} needs ffmpeg (pip install 'lemniscate[video]'); a .gif or .webp does not.")


def in_notebook() -> bool:
    """Whether this is a cell of a notebook, which can show pictures, and not a terminal."""
    if "IPython" not in sys.modules:
        return False
    from IPython.core.getipython import get_ipython

    return hasattr(get_ipython(), "kernel")


def show_pictures(files: Iterable[Path]) -> None:
    """Show pictures below the cell."""
    from IPython.display import Image as Shown
    from IPython.display import display

    for file in files:
        display(Shown(filename=str(file)))


def send_frames(frames: Iterable[np.ndarray], fps: float) -> None:
    """Show frames [H, W, 3] uint8 one after the other below the cell, at their own speed."""
    from IPython.display import Image as Shown
    from IPython.display import display

    stride = max(1, round(fps / NOTEBOOK_FPS))
    place, started = None, time.monotonic()
    for i, frame in enumerate(frames):
        if i % stride:
            continue
        jpeg = io.BytesIO()
        Image.fromarray(frame).save(jpeg, format="JPEG", quality=85)
        shown = Shown(jpeg.getvalue(), format="jpeg")
        if place is None:
            place = display(shown, display_id=True)
        else:
            place.update(shown)
        time.sleep(max(0.0, started + i / fps - time.monotonic()))


def _play(env: gym.Env, act: Act, seed: int) -> Iterator[gym.Env]:
    """The environment after its reset and after each step of one episode (of its first steps, if endless)."""
    obs, info = env.reset(seed=seed)
    yield env
    for _ in range(PATIENCE if env.spec is None or env.spec.max_episode_steps is None else sys.maxsize):
        obs, _, terminated, truncated, info = env.step(act(obs, action_mask=info.get("action_mask")))
        yield env
        if terminated or truncated:
            break
    env.close()


def _fps(env: gym.Env) -> float:
    return float(env.metadata.get("render_fps", 30))


def _rendered(config: RunConfig, mode: str) -> gym.Env:
    try:
        env = registry.make_rendered(config.env, mode, config.env_kwargs, config.wrappers, config.backend)
        env.reset(seed=0)
        env.render()
        return env
    except Exception as error:  # pygame, GLFW and MuJoCo each have their own
        raise UserError(f"{config.env} cannot be shown here: {error}") from error


def _draw_flight(track: flight.Flight, env: VecEnv) -> tuple[Iterable[np.ndarray], float, str]:
    """(frames, frames a second, how they were drawn)."""
    from lemniscate.report import scene

    fps = 1 / (FLIGHT_STRIDE * track.time_step)
    rendered = scene.render(track, _model(env), FLIGHT_STRIDE)
    if rendered is not None:
        return rendered, fps, "rendered by MuJoCo"
    how = (
        "drawn with matplotlib, since there is no off-screen OpenGL; for a MuJoCo rendering install EGL or OSMesa"
        " (Debian: libegl1 and libgl1-mesa-dri, or libosmesa6)"
    )
    return flight.animate(track, FLIGHT_STRIDE), fps, how


def _model(env: VecEnv) -> Any:
    return env.scene.model if env.scene else None
