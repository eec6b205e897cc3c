"""Output below the cell of a notebook, kept when it is saved: progress, pictures, frames, a film."""

import io
import time
from base64 import b64encode
from collections.abc import Iterable
from pathlib import Path
from typing import Any

NOTEBOOK_FPS = 25
"""more frames a second than a browser is sent; the others are left out"""


class Place:
    """A place below the cell for one object, which the next one replaces; a saved notebook holds the last."""

    def __init__(self) -> None:
        self._handle: Any = None

    def show(self, shown: Any, **how: Any) -> None:
        """Show an object in the place of the one before; `how` is for IPython's `display`."""
        from IPython.display import display

        if self._handle is None:
            self._handle = display(shown, display_id=True, **how)
        else:
            self._handle.update(shown, **how)


class CellText:
    """Text that is replaced in place, at most five times a second; a saved notebook holds the last.

    It needs no widgets, which a saved notebook cannot show.
    """

    def __init__(self) -> None:
        self._place = Place()
        self._text, self._shown_at = "", -float("inf")

    def show(self, text: str) -> None:
        """Replace the text, now or with a later one."""
        self._text = text
        if time.monotonic() - self._shown_at >= 0.2:
            self.flush()

    def flush(self) -> None:
        """Show the newest text."""
        if self._text:
            self._place.show({"text/plain": self._text}, raw=True)
        self._shown_at = time.monotonic()


def drawn_bar(fraction: float) -> str:
    """A bar of 20 characters, filled from the left."""
    filled = round(20 * min(1.0, fraction))
    return "━" * filled + "╌" * (20 - filled)


def show_pictures(files: Iterable[Path]) -> None:
    """Show pictures below the cell."""
    from IPython.display import Image, display

    for file in files:
        display(Image(filename=str(file)))


def send_frames(frames: Iterable[Any], fps: float) -> None:
    """Show frames, arrays [H, W, 3] of uint8, one after the other below the cell, at their own speed."""
    import PIL.Image
    from IPython.display import Image

    stride = max(1, round(fps / NOTEBOOK_FPS))
    place, started = Place(), time.monotonic()
    for i, frame in enumerate(frames):
        if i % stride:
            continue
        jpeg = io.BytesIO()
        PIL.Image.fromarray(frame).save(jpeg, format="JPEG", quality=85)
        place.show(Image(jpeg.getvalue(), format="jpeg"))
        time.sleep(max(0.0, started + i / fps - time.monotonic()))


def show_film(file: str | Path) -> None:
    """Show an animated picture (.gif, .webp) below the cell; the notebook then holds it without the file."""
    from IPython.display import HTML, display

    path = Path(file)
    data = b64encode(path.read_bytes()).decode()
    display(HTML(f'<img src="data:image/{path.suffix[1:]};base64,{data}">'))  # few viewers know image/webp as an output
