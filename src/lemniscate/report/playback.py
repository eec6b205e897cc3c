"""Episodes played for a person: in a window, in a notebook, or into a video."""

import io
import math
import os
import sys
import time
import warnings
from base64 import b64encode
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from PIL import Image

from lemniscate.envs.conversion import measured, measures_of
from lemniscate.envs.registry import make_rendered
from lemniscate.envs.spaces import SUMMARIES
from lemniscate.envs.vec_env import VecEnv, require_end
from lemniscate.errors import NonFiniteError, UserError, is_installed, missing_extra, shown
from lemniscate.run.config import RunConfig
from lemniscate.run.environments import env_arguments
from lemniscate.run.evaluate import EVALUATION, EpisodeTable, Evaluation
from lemniscate.run.seeding import derive
from lemniscate.system.console import Place, in_notebook, say
from lemniscate.system.files import file_in_the_way, remove
from lemniscate.types import Step

Act = Callable[..., np.ndarray]
"""(observation, action_mask=…) of an environment to an action"""
Tell = Callable[[str], object]

ONE, LARGEST = torch.ones(1, dtype=torch.bool), torch.finfo(torch.float32).max

VIDEOS = {".gif": "image/gif", ".webp": "image/webp", ".mp4": "video/mp4"}
"""the endings of a video's file, and what it is to a browser"""

PICTURE_FPS = 50
"""frames a second that an animated picture has at most: browsers show one with shorter delays far too slowly"""
NOTEBOOK_FPS = 25
"""more frames a second than a browser is sent; the others are left out"""


def show_episodes(
    act: Act | None,
    arguments: dict[str, Any],
    episodes: int,
    seed: int,
    video: Path | None = None,
    tell: Tell = say,
    begin: Callable[[], None] = lambda: None,
) -> Evaluation:
    """Play episodes one after the other in a rendered environment of Gymnasium's interface.

    It is made with the `arguments` that `env_arguments` returns. The episodes are shown in the notebook that asks, in a
    window elsewhere, or recorded into `video`. Without `act`, actions are uniformly random. `begin` is called before
    each episode. The first 16 starts are those that `evaluate` plays from in the gymnasium backend.

    Raises:
        UserError: an environment that cannot be made or renders no pictures; an episode without an end.
    """
    in_window = video is None and not in_notebook()
    table, name = EpisodeTable(1, torch.device("cpu")), arguments["env"]
    with _quiet_sdl(in_window), closing(_rendered(arguments, "human" if in_window else "rgb_array")) as env:
        played = _play(env, act or _random(env, seed), name, episodes, seed, table, tell, begin)
        if in_window:
            deque(played, maxlen=0)  # Gymnasium draws at each step
        else:
            give((_picture(env, name) for _ in played), _pace(env), video)
    return table.evaluation(name, SUMMARIES)


def require_pictures(config: RunConfig, env: VecEnv) -> None:
    """Raise `UserError` where an environment cannot be recorded; one with a scene always can."""
    if not env.scene:
        if env.backend.once:
            env.close()
        with _quiet_sdl(in_window=False):
            _rendered(env_arguments(config), "rgb_array").close()


def require_display() -> None:
    """Raise `UserError` where there is neither a notebook nor a display for a window."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform == "linux" and not in_notebook() and not any(map(os.environ.get, displays)):
        raise UserError(
            'There is no display for a window; record a video instead: --video video.gif, in Python video="video.gif".'
        )


def sentence(number: int, episode_return: float, length: int) -> str:
    """The line that is said after an episode."""
    return f"Episode {number}: return {episode_return:.1f}, length {length}"


def _play(
    env: gym.Env,
    act: Act,
    name: str,
    episodes: int,
    seed: int,
    table: EpisodeTable,
    tell: Tell,
    begin: Callable[[], None],
) -> Iterator[None]:
    """Reset and step through the episodes, counted in `table`.

    Stops after each reset and each step, for a picture. Raises `UserError` for an action of another kind, and for an
    episode that does not end where there is no time limit.
    """
    first, declared = derive(seed, EVALUATION, 0), measures_of(env.metadata or {})
    limit = env.spec.max_episode_steps if env.spec else None
    for number in range(episodes):
        obs, info = env.reset(seed=first + number)
        begin()
        yield
        total, length, done = 0.0, 0, False
        while not done:
            require_end(name, length, limit)
            obs, reward, terminated, truncated, info = env.step(act(obs, action_mask=info.get("action_mask")))
            if not abs(float(reward)) <= LARGEST:
                raise NonFiniteError(f"The reward of {name} is {reward} in step {length + 1} of an episode.")
            total, length = total + float(reward), length + 1
            done = terminated or truncated
            step = Step(
                obs=ONE,  # the table counts no observations
                next_obs=ONE,
                reward=torch.tensor([float(reward)]),
                terminated=torch.tensor([bool(terminated)]),
                truncated=torch.tensor([bool(truncated)]),
                valid=ONE,
                measures=measured(info, declared, 1, ONE.device),
            )
            table.add(step, ONE)
            yield
        tell(sentence(number + 1, total, length))


def _pace(env: gym.Env) -> float:
    """The frames a second that an environment says it has; 30 where it says nothing that a video can have."""
    try:
        fps = float((env.metadata or {}).get("render_fps") or 30)
    except (TypeError, ValueError):
        return 30.0
    return fps if 0.1 <= fps <= 1000 else 30.0


def _random(env: gym.Env, seed: int) -> Act:
    """Uniformly random actions, of those that the mask allows."""
    space = env.action_space
    space.seed(seed)

    def sample(obs: Any, action_mask: np.ndarray | None = None) -> Any:
        mask: Any = None if action_mask is None else action_mask.astype(np.int8)
        if mask is not None and isinstance(space, gym.spaces.MultiDiscrete):
            mask = tuple(np.split(mask, np.cumsum(space.nvec)[:-1]))
        return space.sample(mask)

    return sample


def _choose_opengl() -> None:
    """Have MuJoCo draw by EGL, or else by OSMesa, where there is no display and MUJOCO_GL does not say by what."""
    chosen = sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"} & os.environ.keys()
    for name in () if chosen or "mujoco" not in sys.modules else ("egl", "osmesa"):
        with suppress(Exception):  # what is not installed raises errors of several kinds
            context = import_module(f"mujoco.{name}").GLContext
            vars(import_module("mujoco.rendering.classic.gl_context"))["GLContext"] = context
            os.environ["MUJOCO_GL"] = name
            return


def _rendered(arguments: dict[str, Any], mode: str) -> gym.Env:
    """An environment that has rendered its first picture. Raises `UserError` where it cannot."""
    name = arguments["env"]
    with ExitStack() as failing:
        try:
            _choose_opengl()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Gymnasium's on pictures, which are looked at below
                env = make_rendered(mode=mode, **arguments)
                failing.callback(env.close)
                env.reset(seed=0)
                env.render()
        except Exception as error:  # pygame, GLFW and MuJoCo each have their own
            hint = " (without a display MuJoCo needs MUJOCO_GL=egl or osmesa)" if "OpenGL" in str(error) else ""
            none = "it has no render() that returns a picture with render_mode='rgb_array'."
            said = none if isinstance(error, NotImplementedError) else " ".join(str(error).split())
            raise UserError(f"{name} cannot be shown here: {said}{hint}") from error
        if mode == "rgb_array":
            _picture(env, name)
        failing.pop_all()
    return env


def _picture(env: gym.Env, name: str) -> np.ndarray:
    """The rendered frame of an environment, [H, W, 3] uint8. Raises `UserError` if it is not a picture."""
    picture: Any = env.render()
    is_array = isinstance(picture, np.ndarray)
    if is_array and picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3 and picture.size:
        return picture
    what = f"an array {picture.shape} of {picture.dtype}" if is_array else shown(picture)
    raise UserError(f"{name} renders no pictures: render() returns {what}; a picture is (height, width, 3) of uint8.")


@contextmanager
def _quiet_sdl(in_window: bool) -> Iterator[None]:
    """Keeps pygame's SDL from writing on standard error; without a window also from looking for a display."""
    settings = {"PYGAME_HIDE_SUPPORT_PROMPT": "1", "SDL_AUDIODRIVER": "dummy"}
    settings |= {} if in_window else {"SDL_VIDEODRIVER": "dummy"}
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def give(frames: Iterable[np.ndarray], fps: float, video: Path | None) -> None:
    """Record frames [H, W, 3] uint8 into a video, or show them below the cell."""
    if video is None:
        send_frames(frames, fps)
    else:
        save_frames(frames, video, fps)


def check_video(file: Path) -> None:
    """Raise `UserError` for a video that could not be written, before anything is played for it."""
    if file.suffix not in VIDEOS:
        raise UserError(f"{file} must end in .gif, .webp or .mp4.")
    if file.is_dir():
        raise UserError(f"{file} is a folder; name a file in it.")
    if blocked := file_in_the_way(file.parent):
        raise UserError(f"{file} cannot be written: {blocked} is a file.")
    if file.suffix == ".mp4" and not is_installed("imageio_ffmpeg"):
        raise missing_extra("imageio_ffmpeg", "video")


def save_frames(frames: Iterable[np.ndarray], file: Path, fps: float) -> None:
    """Write frames [H, W, 3] uint8 as an animated picture (.gif, .webp) or a video (.mp4, extra `video`)."""
    check_video(file)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{file} cannot be written: {error.strerror}.") from error
    aside = file.with_name(f"{file.stem}.tmp{file.suffix}")
    remove(aside)  # writing would follow a link
    try:
        _write(_of_one_size(frames, file), aside, fps)
        aside.replace(file)
    except BaseException:  # what draws the frames may fail: an older video stays, and no half of one is left
        aside.unlink(missing_ok=True)
        raise


def _of_one_size(frames: Iterable[np.ndarray], file: Path) -> Iterator[np.ndarray]:
    """The frames. Raises `UserError` for one of another size than the first."""
    size = None
    for frame in frames:
        size = size or frame.shape
        if frame.shape != size:
            one, other = (f"{shape[1]} × {shape[0]}" for shape in (size, frame.shape))
            raise UserError(f"{file} cannot be recorded: after pictures of {one} render() returns one of {other}.")
        yield frame


def _write(frames: Iterable[np.ndarray], file: Path, fps: float) -> None:
    if file.suffix == ".mp4":
        from imageio import v2 as imageio

        video: Any = imageio.get_writer(file, fps=fps, macro_block_size=2)
        with video:
            for frame in frames:
                video.append_data(frame)
        return
    stride = max(1, math.ceil(fps / PICTURE_FPS))
    images = _timed(islice(frames, 0, None, stride), fps / stride)
    # A GIF takes the delay of each image, whole hundredths of a second; a WebP has one delay for all.
    delay: dict[str, Any] = {} if file.suffix == ".gif" else {"duration": 1000 * stride / fps}
    next(images).save(file, save_all=True, append_images=images, loop=0, **delay)


def _timed(frames: Iterable[np.ndarray], fps: float) -> Iterator[Image.Image]:
    """Images, each with a delay in whole hundredths of a second, as a GIF has them; their sum keeps the time."""
    for i, frame in enumerate(frames):
        image = Image.fromarray(frame)
        image.info["duration"] = 10 * (round(100 * (i + 1) / fps) - round(100 * i / fps))
        yield image


def send_frames(frames: Iterable[Any], fps: float) -> None:
    """Show frames, arrays [H, W, 3] of uint8, one after the other below the cell, at their own speed."""
    from IPython import display

    stride = max(1, round(fps / NOTEBOOK_FPS))
    place, started = Place(), time.monotonic()
    for i, frame in enumerate(frames):
        if i % stride:
            continue
        jpeg = io.BytesIO()
        Image.fromarray(frame).save(jpeg, format="JPEG", quality=85)
        place.show(display.Image(jpeg.getvalue(), format="jpeg"))
        time.sleep(max(0.0, started + i / fps - time.monotonic()))


def show_video(file: str | Path) -> None:
    """Show an animated picture (.gif, .webp) below the cell; the notebook then holds it without the file."""
    from IPython.display import HTML, display

    display(HTML(f'<img src="{embedded(Path(file))}">'))  # few viewers know image/webp as an output


def embedded(file: Path) -> str:
    """A picture or a video as an address that holds all of it, for a page that stands alone."""
    return f"data:{VIDEOS.get(file.suffix, 'image/png')};base64,{b64encode(file.read_bytes()).decode()}"
