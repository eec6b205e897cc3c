"""Playing episodes for a person: in a window, in a notebook, or into a film."""

import io
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from PIL import Image

from lemniscate.console import in_notebook, say
from lemniscate.envs import registry
from lemniscate.envs.measures import SUMMARIES, measures_of
from lemniscate.envs.vec_env import PATIENCE, VecEnv
from lemniscate.errors import UserError
from lemniscate.nn.policies import Policy
from lemniscate.report import flight
from lemniscate.report.display import quiet_sdl
from lemniscate.report.film import save_frames
from lemniscate.run.config import RunConfig
from lemniscate.run.environments import world_of
from lemniscate.run.evaluate import EVALUATION, EpisodeTable, Evaluation
from lemniscate.run.seeding import derive
from lemniscate.types import Step

Act = Callable[..., np.ndarray]
"""(observation, action_mask=…) of an environment to an action"""
Tell = Callable[[str], object]

ONE = torch.ones(1, dtype=torch.bool)

NOTEBOOK_FPS = 25
"""more frames a second than a browser is sent; the others are left out"""

FLIGHT_STRIDE = 5
"""a flight is drawn at every so many-th step"""


def show_episodes(
    act: Act | None, world: dict[str, Any], episodes: int, seed: int, video: Path | None = None, tell: Tell = say
) -> Evaluation:
    """Play episodes one after the other in a rendered environment of Gymnasium's interface; `world` as of `world_of`.

    They are shown in the notebook that asks, in a window elsewhere, or recorded into `video`. Without `act`, actions
    are uniformly random. The first 16 starts are those that `evaluate` plays from in the gymnasium backend.
    """
    in_window = video is None and not in_notebook()
    table = EpisodeTable(1, torch.device("cpu"))
    with quiet_sdl(in_window):
        env = _rendered(world, "human" if in_window else "rgb_array")
        played = _play(env, act or _random(env, seed), episodes, seed, table, tell)
        try:
            if in_window:
                deque(played, maxlen=0)  # Gymnasium draws at each step
            else:
                _give((np.asarray(env.render()) for _ in played), _fps(env), video)
        finally:
            env.close()
    return table.evaluation(world["env"], SUMMARIES)


def show_flights(
    policy: Policy | None,
    env: VecEnv,
    episodes: int,
    seed: int,
    deterministic: bool = True,
    video: Path | None = None,
    tell: Tell = say,
) -> Evaluation:
    """Play flights one after the other in a scene: the same, for environments that have one.

    Raises:
        UserError: more flights than there are environments.
    """
    if episodes > env.num_envs:
        raise UserError(f"At most {env.num_envs} flights of this run can be shown, not {episodes}.")
    table = EpisodeTable(env.num_envs, env.device)
    track = flight.record(policy, env, episodes, seed, deterministic, table)
    scores = table.evaluation(env.spec.env_id, env.summaries)
    for number, of_episode in enumerate(zip(scores.returns, scores.lengths, strict=True), start=1):
        tell(_sentence(number, *of_episode))
    if video is None and not in_notebook():
        from lemniscate.report import scene

        scene.show((track.one(number) for number in range(episodes)), _model(env))
    else:
        frames, how = _draw(track, env)
        _give(frames, 1 / (FLIGHT_STRIDE * track.time_step), video)
        tell(how)
    return scores


def require_pictures(config: RunConfig, env: VecEnv) -> None:
    """Raise `UserError` where an environment cannot be recorded; one with a scene always can."""
    if not env.scene:
        with quiet_sdl(in_window=False):
            _rendered(world_of(config), "rgb_array").close()


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


def _play(env: gym.Env, act: Act, episodes: int, seed: int, table: EpisodeTable, tell: Tell) -> Iterator[None]:
    """Reset and step through the episodes (the first steps of an endless one), counted in `table`.

    Stops after each reset and each step, for a picture.
    """
    first, names = derive(seed, EVALUATION, 0), measures_of(env.metadata)
    limit = PATIENCE if env.spec is None or env.spec.max_episode_steps is None else sys.maxsize
    for number in range(episodes):
        obs, info = env.reset(seed=first + number)
        yield
        total, length, done = 0.0, 0, False
        while not done:
            obs, reward, terminated, truncated, info = env.step(act(obs, action_mask=info.get("action_mask")))
            total, length = total + float(reward), length + 1
            truncated = truncated or length == limit
            done = terminated or truncated
            table.add(_step(reward, terminated, truncated, {name: info[name] for name in names if name in info}), ONE)
            yield
        tell(_sentence(number + 1, total, length))


def _step(reward: Any, terminated: bool, truncated: bool, measures: dict[str, Any]) -> Step:
    """One step of one environment, without observations."""
    return Step(
        obs=ONE,
        next_obs=ONE,
        reward=torch.tensor([float(reward)]),
        terminated=torch.tensor([bool(terminated)]),
        truncated=torch.tensor([bool(truncated)]),
        valid=ONE,
        measures={name: torch.tensor([float(value)]) for name, value in measures.items()},
    )


def _random(env: gym.Env, seed: int) -> Act:
    """Uniformly random actions, of those that the mask allows."""
    env.action_space.seed(seed)
    return lambda obs, action_mask=None: env.action_space.sample(
        None if action_mask is None else np.asarray(action_mask, dtype=np.int8)
    )


def _sentence(number: int, episode_return: float, length: int) -> str:
    return f"Episode {number}: return {episode_return:.1f}, length {length}"


def _give(frames: Iterable[np.ndarray], fps: float, video: Path | None) -> None:
    """Record the frames, or show them below the cell."""
    if video is None:
        send_frames(frames, fps)
    else:
        save_frames(frames, video, fps)


def _fps(env: gym.Env) -> float:
    return float(env.metadata.get("render_fps", 30))


def _rendered(world: dict[str, Any], mode: str) -> gym.Env:
    try:
        env = registry.make_rendered(mode=mode, **world)
        env.reset(seed=0)
        env.render()
        return env
    except Exception as error:  # pygame, GLFW and MuJoCo each have their own
        raise UserError(f"{world['env']} cannot be shown here: {error}") from error


def _draw(track: flight.Flight, env: VecEnv) -> tuple[Iterable[np.ndarray], str]:
    """Frames of all flights, one after the other, and how they are drawn."""
    from lemniscate.report import scene

    flights = [track.one(number) for number in range(track.position.shape[1])]
    first = scene.render(flights[0], _model(env), FLIGHT_STRIDE)
    if first is not None:
        more = (scene.render(one, _model(env), FLIGHT_STRIDE) for one in flights[1:])
        return chain(first, chain.from_iterable(frames for frames in more if frames is not None)), "Rendered by MuJoCo."
    how = (
        "Drawn with matplotlib, since there is no off-screen OpenGL; for a MuJoCo rendering install EGL or OSMesa"
        " (Debian: libegl1 and libgl1-mesa-dri, or libosmesa6)."
    )
    return chain.from_iterable(flight.animate(one, FLIGHT_STRIDE) for one in flights), how


def _model(env: VecEnv) -> Any:
    return env.scene.model if env.scene else None
