"""Films: frames into an animated picture or a video, at their own speed."""

import math
import stat
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lemniscate.errors import UserError, is_installed, missing_extra
from lemniscate.system.files import remove

SUFFIXES = (".gif", ".webp", ".mp4")
"""what a film can be"""

PICTURE_FPS = 50
"""frames a second that an animated picture has at most: browsers show one with shorter delays far too slowly"""


def newest_film(run: Path) -> Path | None:
    """The newest film of a run, if it has any."""
    files = (file for file in (run / "videos").glob("*") if file.suffix in SUFFIXES)
    films = [file for file in files if stat.S_ISREG(file.lstat().st_mode)]
    return max(films, key=lambda file: file.stat().st_mtime, default=None)


def save_frames(frames: Iterable[np.ndarray], file: Path, fps: float) -> None:
    """Write frames [H, W, 3] uint8 as an animated picture (.gif, .webp) or a video (.mp4, extra `video`)."""
    check_film(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    remove(file)  # writing would follow a link
    try:
        _write(frames, file, fps)
    except BaseException:  # what draws the frames may fail: no half of a film is left
        file.unlink(missing_ok=True)
        raise


def _write(frames: Iterable[np.ndarray], file: Path, fps: float) -> None:
    if file.suffix == ".mp4":
        from imageio import v2 as imageio

        film: Any = imageio.get_writer(file, fps=fps, macro_block_size=2)
        with film:
            for frame in frames:
                film.append_data(frame)
        return
    stride = max(1, math.ceil(fps / PICTURE_FPS))
    images = _timed(islice(frames, 0, None, stride), fps / stride)
    first = next(images)
    if file.suffix == ".gif":
        first.save(file, save_all=True, append_images=images, loop=0)
    else:
        first.save(file, save_all=True, append_images=images, loop=0, duration=1000 * stride / fps)


def check_film(file: Path) -> None:
    """Raise `UserError` for a film that could not be written, before anything is played for it."""
    if file.suffix not in SUFFIXES:
        raise UserError(f"{file} must end in .gif, .webp or .mp4.")
    if file.suffix == ".mp4" and not is_installed("imageio_ffmpeg"):
        raise missing_extra("imageio_ffmpeg", "video")


def _timed(frames: Iterable[np.ndarray], fps: float) -> Iterator[Image.Image]:
    """Images, each with a delay in whole hundredths of a second, as a GIF has them; their sum keeps the time."""
    for i, frame in enumerate(frames):
        image = Image.fromarray(frame)
        image.info["duration"] = 10 * (round(100 * (i + 1) / fps) - round(100 * i / fps))
        yield image
