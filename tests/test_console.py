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

from lemniscate.system import console

THREE_UPDATES = """
from lemniscate.system.console import ProgressBar
bar = ProgressBar(1_000, 0)
for step in (90, 500, 1_000):
    bar.update(step, 12.34)
bar.close()
"""


TWO_RUNS = """
from lemniscate.system.console import Line, ProgressBar, pace
bar = ProgressBar(2_000, 500)
for step, done in ((100, 600), (150, 650), (1_000, 1_500)):
    run = Line("a", step, 1_000, pace(50.0, 7.0, 1_000 - step, "being evaluated"))
    bar.show(Line("0 of 2 runs ended", done, 2_000, f"{done:,} of 2,000 steps"), [run])
bar.say("a: done")
bar.show(Line("1 of 2 runs ended", 1_500, 2_000, "1,500 of 2,000 steps"))
bar.close()
"""


def test_a_pipe_gets_a_line_at_each_tenth_of_a_run():
    done = subprocess.run([sys.executable, "-c", THREE_UPDATES], capture_output=True, text=True, check=True)
    first, last = done.stderr.splitlines()
    assert re.fullmatch(r"500 of 1,000 steps  [\d,]+ steps/s  return 12.3  \d:\d\d:\d\d left", first)
    assert re.fullmatch(r"1,000 of 1,000 steps  [\d,]+ steps/s  return 12.3  \d:\d\d:\d\d in all", last)
    assert not done.stdout


def test_the_time_left_is_by_the_last_interval_and_unknown_while_nothing_is_learned(monkeypatch, capsys):
    """Steps before learning begins are fast, and say nothing of those after."""
    now = iter([0, 1, 2, 12, 32, 42])
    monkeypatch.setattr(console.time, "monotonic", lambda: next(now))
    bar = console.ProgressBar(500, 0)
    for step, learned in ((100, False), (200, True), (300, True), (400, True)):
        bar.update(step, None, learned)
    assert [line.split("  ")[-1] for line in capsys.readouterr().err.splitlines()] == [
        "0:00:01 so far",
        "0:00:02 so far",  # a part of this interval was not learned from
        "0:00:20 left",  # 10 s for 100 steps
        "0:00:20 left",  # 20 s for 100 steps
    ]
    bar.update(612, None)
    assert capsys.readouterr().err.startswith("612 steps, the end of the update that reached 500  ")


def test_a_pipe_gets_the_runs_of_a_set_at_each_tenth_of_all_steps(capsys):
    exec(TWO_RUNS, {})
    assert capsys.readouterr().err.splitlines() == [
        "0 of 2 runs ended  600 of 2,000 steps",
        "  a: 50 steps/s  return 7.0  0:00:18 left",
        "0 of 2 runs ended  1,500 of 2,000 steps",
        "  a: 50 steps/s  return 7.0  being evaluated",
        "a: done",
    ]


def test_what_is_not_to_be_seen_says_nothing(capsys):
    exec(TWO_RUNS.replace("500)", "500, visible=False)", 1), {})
    assert not capsys.readouterr().err


def in_a_terminal(program):
    """The text that a program writes to a terminal, without the control sequences."""
    ours, theirs = pty.openpty()
    env = {**os.environ, "TERM": "xterm", "COLUMNS": "120", "LINES": "30"}
    with subprocess.Popen([sys.executable, "-c", program], stderr=theirs, env=env) as process:
        os.close(theirs)
        seen = b""
        while chunk := _read(ours):
            seen += chunk
        os.close(ours)
    assert process.returncode == 0
    return re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", seen.decode())


def test_a_terminal_gets_one_bar():
    text = in_a_terminal(THREE_UPDATES)
    assert "1,000 of 1,000 steps ━" in text
    assert "100%" in text
    assert text.count("\n") <= 2


def test_a_terminal_gets_a_bar_for_each_run_under_way_and_what_is_said_above_them():
    text = in_a_terminal(TWO_RUNS.replace("bar.say", "bar._bars.refresh()\nbar.say"))
    assert re.search(r"a +━{20} 100%  50 steps/s  return 7.0  being evaluated", text)
    after = text[text.index("a: done") :]
    assert re.search(r"1 of 2 runs ended [━╸╺]{20} +75%  1,500 of 2,000 steps", after)
    assert "being evaluated" not in after.splitlines()[-1]


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
        from lemniscate.system.console import Line, ProgressBar, pace
        bar = ProgressBar(20, 0)
        runs = [Line("one", 5, 10, "starting"), Line("two", 5, 10, pace(3.0, None, 5, "being evaluated"))]
        bar.show(Line("0 of 2 runs ended", 10, 20, "10 of 20 steps"), runs)
        time.sleep(0.3)
        bar.say("one: done")
        bar.show(Line("1 of 2 runs ended", 10, 20, "10 of 20 steps"), runs[1:])
        bar.close()
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
    assert re.fullmatch(r"━{20} 1,000 of 1,000 steps  [\d,]+ steps/s  return 12.3  \d:\d\d:\d\d in all", text)


def test_a_notebook_keeps_the_last_lines_of_a_sweep_and_what_was_said(notebook):
    lines, said = notebook[1]
    bar, two = lines.data["text/plain"].splitlines()
    assert bar == "━" * 10 + "╌" * 10 + " 1 of 2 runs ended  10 of 20 steps"
    assert two == "  two: 3 steps/s  return –  0:00:02 left"
    assert (said.name, said.text) == ("stdout", "one: done\n")


def test_a_notebook_shows_a_finding_once_and_not_as_a_failure(notebook):
    (said,) = notebook[2]
    assert (said.name, said.text) == ("stdout", "✓ gae: right in all 5 cases.\n")
