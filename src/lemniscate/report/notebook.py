"""Films below the cell of a notebook, stored with it."""

from base64 import b64encode
from pathlib import Path


def show_film(file: str | Path) -> None:
    """Show an animated picture (.gif, .webp) below the cell. The notebook holds it from then on, without the file."""
    from IPython.display import HTML, display

    path = Path(file)
    data = b64encode(path.read_bytes()).decode()
    display(HTML(f'<img src="data:image/{path.suffix[1:]};base64,{data}">'))  # few viewers know image/webp as an output
