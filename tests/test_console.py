"""Progress as a person sees it: in a terminal, in a pipe, and below the cell of a notebook."""

import os
import pty
import re
import subprocess
import sys
import textwrap

import nbformat
import pytest
from nbclient import NotebookClient

THREE_UPDATES = """
from lemniscate.system.console import ProgressBar
bar = ProgressBar(1_000, 0)
for step in (90, 500, 1_000):
    bar.update(step, 12.34)
bar.close()
"""


def test_a_pipe_gets_a_line_at_each_tenth_of_a_run():
    done = subprocess.run([sys.executable, "-c", THREE_UPDATES], capture_output=True, text=True, check=True)
    first, last = done.stderr.splitlines()
    assert re.fullmatch(r"500 of 1,000 steps  [\d,]+ steps/s  return 12.3  \d+ s left", first)
    assert re.fullmatch(r"1,000 of 1,000 steps  [\d,]+ steps/s  return 12.3  \d+ s", last)
    assert not done.stdout


def test_a_terminal_gets_one_bar():
    ours, theirs = pty.openpty()
    env = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
    with subprocess.Popen([sys.executable, "-c", THREE_UPDATES], stderr=theirs, env=env) as process:
        os.close(theirs)
        seen = b""
        while chunk := _read(ours):
            seen += chunk
        os.close(ours)
    assert process.returncode == 0
    text = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", seen.decode())
    assert "1,000 of 1,000 steps ━" in text
    assert "100%" in text
    assert text.count("\n") <= 2


def _read(descriptor):
    try:
        return os.read(descriptor, 65536)
    except OSError:  # the other end is closed
        return b""


@pytest.fixture(scope="module")
def notebook():
    """The outputs of a real notebook in a real kernel: a run's progress, a sweep's, a check."""
    sweep = """
        import time
        from lemniscate.sweeps.sweep_progress import SweepProgress
        progress = SweepProgress({"one": 10, "two": 10}, {"one": 0, "two": 0})
        progress.update("one", 5, 1.0, 3.0)
        progress.update("two", 5, None, 3.0)
        time.sleep(0.3)
        progress.end("one", "done")
        progress.close()
    """
    check = """
        from lemniscate import course, maths
        course.check(maths.gae)
    """
    cells = [nbformat.v4.new_code_cell(textwrap.dedent(cell)) for cell in (THREE_UPDATES, sweep, check)]
    made = nbformat.v4.new_notebook(cells=cells)
    NotebookClient(made, timeout=600).execute()
    return [cell.outputs for cell in made.cells]


def test_a_notebook_keeps_the_last_line_of_a_run(notebook):
    (line,) = notebook[0]
    assert line.output_type == "display_data"
    text = line.data["text/plain"]
    assert re.fullmatch(r"━{20} 1,000 of 1,000 steps  [\d,]+ steps/s  return 12.3  \d+ s", text)


def test_a_notebook_keeps_the_last_lines_of_a_sweep_and_what_was_said(notebook):
    lines, said = notebook[1]
    bar, two = lines.data["text/plain"].splitlines()
    assert bar == "━" * 10 + "╌" * 10 + " 1 of 2 runs ended, 10 of 20 steps"
    assert two == "  two: 5 steps  3/s  return –  0:00:02 left"
    assert (said.name, said.text) == ("stdout", "one: done\n")


def test_a_notebook_shows_a_finding_once_and_not_as_a_failure(notebook):
    (said,) = notebook[2]
    assert (said.name, said.text) == ("stdout", "✓ gae: right in all 5 cases.\n")
