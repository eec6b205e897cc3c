"""Playing episodes for a person: in a window, in a notebook, or into a film."""

import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from lemniscate.envs import registry
from lemniscate.envs.factory import make_one, maker_of, sentences
from lemniscate.envs.measures import SUMMARIES, measures_of
from lemniscate.envs.rendered import make_rendered
from lemniscate.envs.vec_env import VecEnv, require_end
from lemniscate.errors import UserError, shown
from lemniscate.nn.policies import Policy
from lemniscate.report import flight
from lemniscate.report.display import quiet_sdl
from lemniscate.report.film import save_frames
from lemniscate.run.config import RunConfig
from lemniscate.run.environments import env_arguments
from lemniscate.run.evaluate import EVALUATION, EpisodeTable, Evaluation
from lemniscate.run.seeding import derive
from lemniscate.system.console import in_notebook, say
from lemniscate.system.named import find_callable
from lemniscate.system.notebook import send_frames
from lemniscate.types import Step

Act = Callable[..., np.ndarray]
"""(observation, action_mask=…) of an environment to an action"""
Tell = Callable[[str], object]

ONE = torch.ones(1, dtype=torch.bool)

FLIGHT_STRIDE = 5
"""a flight is drawn at every so many-th step"""


def show_episodes(
    act: Act | None, arguments: dict[str, Any], episodes: int, seed: int, video: Path | None = None, tell: Tell = say
) -> Evaluation:
    """Play episodes one after the other in a rendered environment of Gymnasium's interface.

    It is made with the `arguments` that `env_arguments` returns. The episodes are shown in the notebook that asks, in a
    window elsewhere, or recorded into `video`. Without `act`, actions are uniformly random. The first 16 starts are
    those that `evaluate` plays from in the gymnasium backend.

    Raises:
        UserError: an environment that cannot be made or renders no pictures; an episode without an end.
    """
    in_window = video is None and not in_notebook()
    table = EpisodeTable(1, torch.device("cpu"))
    with quiet_sdl(in_window):
        env = _rendered(arguments, "human" if in_window else "rgb_array")
        played = _play(env, act or _random(env, seed), arguments["env"], episodes, seed, table, tell)
        try:
            if in_window:
                deque(played, maxlen=0)  # Gymnasium draws at each step
            else:
                _give((_picture(env, arguments["env"]) for _ in played), _fps(env), video)
        finally:
            env.close()
    return table.evaluation(arguments["env"], SUMMARIES)


def play_single(act: Act, arguments: dict[str, Any], episodes: int, seed: int, tell: Tell = say) -> Evaluation:
    """The same episodes, not shown: one after the other in one environment of Gymnasium's interface.

    Raises:
        UserError: an environment that cannot be made, or only several at once; an episode without an end.
    """
    name, kwargs, wrappers = (arguments[part] for part in ("env", "kwargs", "wrappers"))
    table = EpisodeTable(1, torch.device("cpu"))
    with sentences(name, kwargs, wrappers):
        if not registry.can_wrap("gymnasium", name):
            raise UserError(f"{name} makes several environments at once, and a function acts in a single one.")
        env = make_one(maker_of(name), tuple(map(find_callable, wrappers)), **kwargs)
    try:
        deque(_play(env, act, name, episodes, seed, table, tell), maxlen=0)
    finally:
        env.close()
    return table.evaluation(name, SUMMARIES)


def act_by(function: Callable[[Any], Any]) -> Act:
    """A function of the observation alone, as an `Act`."""
    return lambda obs, action_mask=None: function(obs)


def show_flights(
    policy: Policy | None,
    env: VecEnv,
    episodes: int,
    seed: int,
    deterministic: bool = True,
    video: Path | None = None,
    tell: Tell = say,
) -> Evaluation:
    """Play flights in a scene: the same, for environments that have one.

    They are those of `evaluate`, and played together. Of more flights than there are environments, the first of each
    is shown.
    """
    table = EpisodeTable(env.num_envs, env.device)
    track = flight.record(policy, env, episodes, seed, deterministic, table)
    scores = table.evaluation(env.spec.env_id, env.summaries)
    if episodes > env.num_envs:
        say(f"{env.num_envs} of the {episodes} flights are shown, the first of each environment.")
    for number, of_episode in enumerate(zip(scores.returns, scores.lengths, strict=True), start=1):
        tell(_sentence(number, *of_episode))
    if video is None and not in_notebook():
        from lemniscate.report import scene

        scene.show((track.one(number) for number in range(track.position.shape[1])), _model(env))
    else:
        frames, how = _draw(track, env)
        _give(frames, 1 / (FLIGHT_STRIDE * track.time_step), video)
        tell(how)
    return scores


def require_pictures(config: RunConfig, env: VecEnv) -> None:
    """Raise `UserError` where an environment cannot be recorded; one with a scene always can."""
    if not env.scene:
        with quiet_sdl(in_window=False):
            _rendered(env_arguments(config), "rgb_array").close()


def _play(
    env: gym.Env, act: Act, name: str, episodes: int, seed: int, table: EpisodeTable, tell: Tell
) -> Iterator[None]:
    """Reset and step through the episodes, counted in `table`.

    Stops after each reset and each step, for a picture. Raises `UserError` for an action of another kind, and for an
    episode that does not end where there is no time limit.
    """
    first, names = derive(seed, EVALUATION, 0), measures_of(env.metadata)
    limit = env.spec.max_episode_steps if env.spec else None
    for number in range(episodes):
        obs, info = env.reset(seed=first + number)
        yield
        total, length, done = 0.0, 0, False
        while not done:
            require_end(name, length, limit)
            action = act(obs, action_mask=info.get("action_mask"))
            _require_in(env.action_space, action, name)
            obs, reward, terminated, truncated, info = env.step(action)
            total, length = total + float(reward), length + 1
            done = terminated or truncated
            table.add(_step(reward, terminated, truncated, {name: info[name] for name in names if name in info}), ONE)
            yield
        tell(_sentence(number + 1, total, length))


def _require_in(space: gym.Space, action: Any, name: str) -> None:
    """Raise `UserError` for an action that is not of the space; of a Box the shape counts, the environment may clip."""
    fits = np.shape(action) == space.shape if isinstance(space, gym.spaces.Box) else space.contains(action)
    if not fits:
        raise UserError(f"{name} takes actions of {space}, not {shown(action)}.")


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


def _rendered(arguments: dict[str, Any], mode: str) -> gym.Env:
    """An environment that has rendered its first picture. Raises `UserError` where it cannot."""
    name = arguments["env"]
    try:
        env = make_rendered(mode=mode, **arguments)
        env.reset(seed=0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium's on pictures, which are looked at below
            env.render()
    except Exception as error:  # pygame, GLFW and MuJoCo each have their own
        raise UserError(f"{name} cannot be shown here: {error}") from error
    try:
        if mode == "rgb_array":
            _picture(env, name)
    except UserError:
        env.close()
        raise
    return env


def _picture(env: gym.Env, name: str) -> np.ndarray:
    """The rendered frame of an environment, [H, W, 3] uint8. Raises `UserError` if it is not a picture."""
    picture: Any = env.render()
    is_array = isinstance(picture, np.ndarray)
    if is_array and picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3:
        return picture
    what = f"an array {picture.shape} of {picture.dtype}" if is_array else shown(picture)
    raise UserError(f"{name} renders no pictures: render() returns {what}; a picture is (height, width, 3) of uint8.")


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
