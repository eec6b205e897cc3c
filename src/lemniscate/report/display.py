"""The place where pictures are shown: a notebook, a display, or neither."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from lemniscate.errors import UserError
from lemniscate.system.console import in_notebook


def require_display() -> None:
    """Raise `UserError` where there is neither a notebook nor a display for a window."""
    shows = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform == "linux" and not in_notebook() and not any(map(os.environ.get, shows)):
        raise UserError(
            'There is no display for a window; record a film instead: --video film.gif, in Python video="film.gif".'
        )


@contextmanager
def quiet_sdl(in_window: bool) -> Iterator[None]:
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
