"""Make the notebooks from their Python files, run them, and keep their outputs: make tutorials.

.venv/bin/python docs/tutorial/execute.py [NAME…]
"""

import os
import sys
import tempfile
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent
METADATA = {
    "kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"},
    "language_info": {"name": "python"},
}
"""nothing of the machine that ran it"""


def execute(file):
    """The notebook of a Python file with its outputs; what it writes on disk is thrown away."""
    notebook = jupytext.read(file)
    notebook.metadata = METADATA
    for number, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{number}", {}
    with tempfile.TemporaryDirectory() as folder:
        options = {"timeout": 1800, "record_timing": False, "coalesce_streams": True}
        NotebookClient(notebook, resources={"metadata": {"path": folder}}, **options).execute()
    notebook.metadata = METADATA
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
    for name in sys.argv[1:] or sorted(file.stem for file in HERE.glob("[0-9]_*.py")):
        print(name, flush=True)
        nbformat.write(execute(HERE / f"{name}.py"), HERE / f"{name}.ipynb")
