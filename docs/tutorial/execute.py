"""Run the course's notebooks, solved, and keep them with their outputs: make tutorials.

.venv/bin/python docs/tutorial/execute.py [NAME…]
"""

import os
import sys
import tempfile
from copy import deepcopy
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from lemniscate.course import loop

HERE = Path(__file__).parent


def execute(file):
    """The notebook of a program with its outputs; what it writes on disk is thrown away."""
    notebook = nbformat.reads(loop.notebook(loop.SOLUTION.sub(loop.SOLVED, file.read_text())), as_version=4)
    metadata = deepcopy(notebook.metadata)  # the client adds what machine ran it
    with tempfile.TemporaryDirectory() as folder:
        options = {"timeout": 1800, "record_timing": False, "coalesce_streams": True}
        NotebookClient(notebook, resources={"metadata": {"path": folder}}, **options).execute()
    notebook.metadata = metadata
    return without_words_for_pictures(notebook)


def without_words_for_pictures(notebook):
    """The notebook without the names of objects, such as <Figure size 900x300 with 2 Axes>, beside their pictures."""
    for output in (output for cell in notebook.cells for output in cell.get("outputs", ())):
        if len(output.get("data", ())) > 1 and output.data["text/plain"].startswith("<"):
            del output.data["text/plain"]
    return notebook


if __name__ == "__main__":
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # Gymnasium's renderer looks for a window first
    for name in sys.argv[1:] or sorted(file.name.partition(".")[0] for file in loop.NOTEBOOKS.glob("*.py.txt")):
        print(name, flush=True)
        nbformat.write(execute(loop.NOTEBOOKS / f"{name}.py.txt"), HERE / f"{name}.ipynb")
