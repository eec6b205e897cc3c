"""What is shown below the cell of a notebook, so that a saved notebook holds it: a line of progress, a film."""

import time
from base64 import b64encode
from pathlib import Path
from typing import Any


class CellText:
    """Text that is replaced in place, at most five times a second; a saved notebook holds the last.

    It needs no widgets, which a saved notebook cannot show.
    """

    def __init__(self) -> None:
        self._place: Any = None
        self._text, self._shown_at = "", -float("inf")

    def show(self, text: str) -> None:
        """Replace the text, now or with a later one."""
        self._text = text
        if time.monotonic() - self._shown_at >= 0.2:
            self.flush()

    def flush(self) -> None:
        """Show the newest text."""
        from IPython.display import display

        plain = {"text/plain": self._text}
        if self._place:
            self._place.update(plain, raw=True)
        elif self._text:
            self._place = display(plain, raw=True, display_id=True)
        self._shown_at = time.monotonic()


def drawn_bar(fraction: float, width: int = 20) -> str:
    """A bar of `width` characters, filled from the left."""
    filled = round(width * min(1.0, fraction))
    return "━" * filled + "╌" * (width - filled)


def show_film(file: str | Path) -> None:
    """Show an animated picture (.gif, .webp) below the cell; the notebook then holds it without the file."""
    from IPython.display import HTML, display

    path = Path(file)
    data = b64encode(path.read_bytes()).decode()
    display(HTML(f'<img src="data:image/{path.suffix[1:]};base64,{data}">'))  # few viewers know image/webp as an output
