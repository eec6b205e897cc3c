"""`lemniscate grade`: hand-ins of all kinds, each tried in a process of its own; what is written; what is not done twice."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from types import ModuleType, SimpleNamespace

import psutil
import pytest
from rich.cells import cell_len

import hand_ins
from lemniscate import course
from lemniscate.cli import main
from lemniscate.course import grading, handin
from lemniscate.system.files import filled

SLOW = ("endless", "endless and deaf", "sleeps", "fills the memory")
QUICK = [name for name in hand_ins.NASTY if name not in SLOW]
COMMAND = [sys.executable, "-m", "lemniscate", "grade"]
EIGHT = list(hand_ins.RIGHT)


def contents(folder):
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


def marks(grades):
    return {
        record["hand_in"]: {
            name: finding["right"] if finding["found"] else None for name, finding in record["exercises"].items()
        }
        for record in grades["hand_ins"]
    }


def sentence(graded, hand_in, exercise):
    (record,) = (record for record in graded.grades["hand_ins"] if record["hand_in"] == hand_in)
    return record["exercises"][exercise]["sentence"]


def notes(graded, hand_in):
    (record,) = (record for record in graded.grades["hand_ins"] if record["hand_in"] == hand_in)
    return " ".join(record["notes"])


def strays():
    """Processes that a hand-in has started, and left."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        found += [process.pid] if f"time.sleep({hand_ins.STRAY})" in " ".join(process.info["cmdline"] or ()) else []
    return found


@pytest.fixture(scope="module")
def graded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ex06 – Übung")
    expected = hand_ins.write(folder, len(QUICK) + 6, QUICK)
    before = contents(folder)
    grades = course.grade(folder, EIGHT)
    to = folder.with_name(f"{folder.name}-grades")
    return SimpleNamespace(folder=folder, to=to, expected=expected, before=before, grades=grades)


def test_every_hand_in_is_judged_as_it_should_be(graded):
    assert marks(graded.grades) == graded.expected
    assert graded.grades["exercises"] == [name for name in course.EXERCISES if name in EIGHT]


def test_nothing_is_changed_beside_the_hand_ins_and_nothing_goes_on(graded):
    assert contents(graded.folder) == graded.before
    assert strays() == []


SENTENCES = [
    ("leaves in a function.py", "gae", "SystemExit"),
    ("leaves at once in a function.py", "gae", "it ended the process (exit code 0)"),
    ("segfault.py", "gae", "it crashed (SIGSEGV)"),
    ("asks.py", "td_target", "EOFError"),
    ("patches.py", "gae", "Likely: a value follows a death"),
    ("missing package in use.py", "td_target", "the package nosuch is not installed here"),
    (
        "misspelt.py",
        "calculate_pg_loss",
        "there is no function or class calculate_pg_loss; did you mean calculate_pgloss?",
    ),
    ("syntax error.py", "gae", "there is no function or class gae."),
]


@pytest.mark.parametrize(("hand_in", "exercise", "words"), SENTENCES)
def test_what_is_wrong_is_said_in_a_sentence(graded, hand_in, exercise, words):
    assert words in sentence(graded, hand_in, exercise)


NOTES = [
    ("leaves at once.py", "While it was read, it ended the process (exit code 0)."),
    ("leaves at import.py", "leaves at import.py, line 6: SystemExit: 0."),
    ("endless import.py", "line 5: left out, since it did not end within 3 s."),
    ("syntax error.py", "syntax error.py, line 17: SyntaxError"),
    ("missing package.py", "line 6: the package nosuch is not installed here."),
    ("trains.ipynb", "code cell 5 of trains.ipynb, line 1: SyntaxError"),
    ("nothing", "There is no .py and no .ipynb file."),
    ("library.py", "value_loss is lemniscate's own"),
    ("no notebook.ipynb", "cannot be read"),
]


@pytest.mark.parametrize(("hand_in", "words"), NOTES)
def test_what_cannot_be_read_is_noted_with_its_line(graded, hand_in, words):
    assert words in notes(graded, hand_in)


def test_what_is_printed_is_kept_in_part_and_reaches_nobody(graded, capfd):
    (record,) = (record for record in graded.grades["hand_ins"] if record["hand_in"] == "prints megabytes.py")
    assert record["printed"].startswith("lemniscate ")
    assert len(record["printed"]) == 2_000
    assert "lemniscate lemniscate" not in "".join(capfd.readouterr())


def test_the_files_are_there_for_teachers_gradescope_and_students(graded):
    assert json.loads((graded.to / "findings.json").read_text()) == graded.grades
    for name, expected in graded.expected.items():
        results = json.loads((graded.to / name / "results.json").read_text())
        assert {test["name"]: (test["score"], test["max_score"], test["status"]) for test in results["tests"]} == {
            exercise: (1.0, 1.0, "passed") if right else (0.0, 1.0, "failed") for exercise, right in expected.items()
        }
        assert all(test["output"] for test in results["tests"])
        page = (graded.to / name / "page.html").read_text()
        assert all(exercise in page for exercise in expected)
        assert f"{sum(map(bool, expected.values()))} of 8 exercises are right." in page


@pytest.fixture
def otter(monkeypatch):
    """Otter-Grader calls a test with the notebook's names as `env`."""
    module = ModuleType("otter.test_files")
    module.test_case = lambda: lambda function: function
    monkeypatch.setitem(sys.modules, "otter", ModuleType("otter"))
    monkeypatch.setitem(sys.modules, "otter.test_files", module)


@pytest.mark.usefixtures("otter")
def test_the_test_file_for_otter_checks_in_the_notebook(graded):
    for exercise in EIGHT:
        scope, right, wrong = {}, {}, {}
        exec((graded.to / "otter" / f"{exercise}.py").read_text(), scope)
        assert (scope["OK_FORMAT"], scope["name"], scope["points"]) == (False, exercise, 1)
        test = scope[f"test_{exercise}"]
        exec(hand_ins.IMPORTS + hand_ins.RIGHT[exercise], right)
        test(right)
        exec(hand_ins.IMPORTS + hand_ins.wrong(exercise), wrong)
        with pytest.raises(AssertionError, match=r"\w+"):
            test(wrong)
        with pytest.raises(AssertionError, match="there is no function or class"):
            test({})


def stored(to):
    return {path.parent.name: path.stat().st_mtime_ns for path in to.glob("*/record.json")}


def test_what_has_not_changed_is_not_judged_again(graded, capsys):
    before = stored(graded.to)
    assert course.grade(graded.folder, EIGHT) == graded.grades
    assert stored(graded.to) == before
    capsys.readouterr()
    (graded.folder / "twice.py").write_text(hand_ins.IMPORTS + hand_ins.wrong("gae"))
    (graded.to / "shadows" / "record.json").write_text("{")
    try:
        assert main(["grade", str(graded.folder), "--exercises", ",".join(EIGHT), "--csv"]) == 0
    finally:
        (graded.folder / "twice.py").write_bytes(graded.before[graded.folder / "twice.py"])
    after, (out, err) = stored(graded.to), capsys.readouterr()
    assert {name for name in after if after[name] != before[name]} == {"twice.py", "shadows"}
    header, *rows = out.splitlines()
    assert header == f"hand_in,right,of,{','.join(graded.grades['exercises'])},notes"
    assert "twice.py,0,8,0,,,,,,,," in rows
    assert len(rows) == len(graded.expected)
    assert "Each ran without a network." in err or "The network was refused by Python" in err


def test_without_names_those_that_are_found_are_judged(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.py").write_text(hand_ins.IMPORTS + hand_ins.RIGHT["polyak"])
    (tmp_path / "in" / "b.py").write_text(f"{hand_ins.IMPORTS}{hand_ins.PG}\nclass Agent:\n    def act(self): ...\n")
    assert main(["grade", str(tmp_path / "in"), "--json", "--to", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert marks(json.loads(out)) == {"a.py": {"polyak": True}, "b.py": {"calculate_pg_loss": True}}
    rows = [line.split() for line in err.splitlines()]
    assert ["a.py", "–", "✓", "1/2"] in rows
    assert ["1", "✓", "0", "✗", "1", "–", "└", "calculate_pg_loss"] in rows


SCRIPT = """
import json, sys
from pathlib import Path
from lemniscate.course import handin
reader = handin.Reader(Path(sys.argv[1]))
reader.read()
print(json.dumps([sorted(handin.solutions(reader, sys.argv[2:])), reader.notes]))
"""


def found_in(work, demanded=(), **files):
    """The exercises that are found in a hand-in, and the notes on it."""
    for name, text in files.items():
        path = work / "hand-in" / name.replace("__", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    done = subprocess.run([sys.executable, "-c", SCRIPT, work, *demanded], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.long
def test_an_agent_and_a_train_of_another_course_are_not_meant(tmp_path):
    """The skeleton's agent has other methods than the drone's; every module of torch has a `train`."""
    from lemniscate.course import loop

    other = "class Agent:\n    def learn(self): ...\n    def save_model(self, path): ...\n\ndef train(args): ...\n"
    skeleton, mine = tmp_path / "skeleton", tmp_path / "mine"
    assert found_in(skeleton, ppo__py=loop.solution("ppo"))[0] == ["clipped_surrogate", "gae", "train", "value_loss"]
    assert found_in(mine, ddpg__py=other)[0] == []
    assert found_in(mine, ["Agent", "train"])[0] == ["Agent", "train"]


def test_a_name_in_two_files_is_that_of_the_last(tmp_path):
    notebook = hand_ins.notebook("from utils import td_target\n", "def gae(): ...")
    found, said = found_in(tmp_path, utils__py="def gae(): ...\ndef td_target(): ...\n", work__ipynb=notebook)
    assert found == ["gae", "td_target"]
    assert said == ["gae is defined in utils.py and work.ipynb; the one in work.ipynb counts."]


def test_without_a_namespace_python_refuses_the_network(tmp_path):
    (tmp_path / "hand-in").mkdir()
    code = (
        "import socket, sys; from pathlib import Path; from types import SimpleNamespace as S\n"
        "from lemniscate.course import handin\n"
        "handin.ctypes.CDLL = lambda name: S(prctl=print, unshare=lambda flags: -1)\n"
        "assert handin._fenced(Path(sys.argv[1])) is False\n"
        "import multiprocessing\n"
        "with multiprocessing.Manager() as manager: assert list(manager.list([1])) == [1]\n"  # by a socket of Unix
        "for connect in (socket.create_connection, socket.socket().connect):\n"
        "    try: connect(('127.0.0.1', 9))\n"
        "    except OSError as error: assert 'no network' in str(error)\n"
        "    else: sys.exit(3)\n"
    )
    assert subprocess.run([sys.executable, "-c", code, tmp_path]).returncode == 0


@pytest.mark.long
def test_a_script_needs_no_guard(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.py").write_text(hand_ins.IMPORTS + hand_ins.RIGHT["polyak"])
    (tmp_path / "script.py").write_text("from lemniscate import course\nprint('once')\ncourse.grade('in')\n")
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout == "once\n"
    assert ["a.py", "✓", "1/1"] in [line.split() for line in done.stderr.splitlines()]


def wait_for(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGKILL])
@pytest.mark.long
def test_stopped_or_killed_it_goes_on(tmp_path, signum):
    folder, to = tmp_path / "in", tmp_path / "in-grades"
    folder.mkdir()
    for number in range(3):
        (folder / f"{number}.py").write_text(hand_ins.IMPORTS + hand_ins.RIGHT["polyak"])
    endless = "import subprocess, sys, time\ndef gae(*a, **k):\n    open('/{}/mark', 'w')\n    time.sleep(987654)\n"
    (folder / "z.py").write_text(endless.format(tmp_path))
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's job in the background ignores it
    how = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True, "preexec_fn": heard}
    process = subprocess.Popen([*COMMAND, folder], **how)
    wait_for(lambda: len(stored(to)) == 3 and (tmp_path / "mark").exists())
    family = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signum)
    _, err = process.communicate(timeout=60)
    if signum == signal.SIGINT:
        assert process.returncode == 130
        assert f"Go on with: lemniscate grade {folder}" in err
    wait_for(lambda: not any(each.is_running() and each.status() != "zombie" for each in family), 30)
    before = stored(to)
    (folder / "z.py").write_text(hand_ins.IMPORTS + hand_ins.RIGHT["gae"])
    assert subprocess.run([*COMMAND, folder], capture_output=True).returncode == 0
    after = stored(to)
    assert {name: after[name] for name in before} == before
    assert "z.py" in after


def test_mistakes_are_one_sentence(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.py").touch()
    (tmp_path / "taken").touch()
    said = []
    for words in (
        ["nowhere"],
        ["empty"],
        ["in", "--exercises", "gaee"],
        ["in", "--to", str(tmp_path / "in" / "grades")],
        ["in", "--to", str(tmp_path / "taken")],
        ["in", "--exercises", ","],
        ["in", "--csv", "--json"],
    ):
        assert main(["grade", str(tmp_path / words[0]), *words[1:]]) == 2
        said.append(capsys.readouterr().err.strip())
    assert all(text and "\n" not in text.replace("1 of 1 hand-ins  0:00:00 left\n", "") for text in said)
    for text, words in zip(
        said,
        (
            *("is no folder", "has no hand-in", "did you mean gae", "choose another --to", "taken"),
            *("exercises names none", "--json and --csv print to one place"),
        ),
        strict=True,
    ):
        assert words in text


def test_what_is_no_hand_in_is_named_and_an_empty_one_noted_without_a_traceback(tmp_path, capfd):
    (tmp_path / "in" / "empty").mkdir(parents=True)
    for name in ("anna.pdf", "b.PY", "c.txt"):
        (tmp_path / "in" / name).touch()
    (tmp_path / "in" / "cells.ipynb").write_text('{"cells": [{"cell_type": "code", "source": 3}]}')
    found = course.grade(tmp_path / "in", to=tmp_path / "out")
    assert [record["notes"] for record in found["hand_ins"]] == [
        ["cells.ipynb cannot be read: it is no notebook with cells: save it once with a newer Jupyter."],
        ["There is no .py and no .ipynb file."],
    ]
    said = capfd.readouterr().err
    assert "Left out: anna.pdf, b.PY, c.txt; a hand-in is" in said
    assert "Traceback" not in said


@pytest.mark.parametrize("columns", [80, 120])
def test_the_table_fits_the_terminal(columns):
    names = [*course.EXERCISES][:8]
    finding = {"right": True, "found": True}
    records = [
        {
            "hand_in": name,
            "exercises": dict.fromkeys(names[: number % 9], finding),
            "notes": ["Long. " * 30],
            "without_network": True,
        }
        for number, name in enumerate(["李小龙" * 9, *(f"{name} {i:03}" for i in range(25) for name in hand_ins.NAMES)])
    ]
    grades = {"exercises": names, "hand_ins": records}
    text = filled(grading.TEMPLATES / "grades.txt.j2", grading.FILTERS, **grades, columns=columns)
    lines = text.splitlines()
    assert max(map(cell_len, lines)) <= columns
    assert [line.split("┌ ")[-1] for line in lines[:8]] == names
    rows = lines[8:-9]
    assert len(rows) == len(records)
    first = {cell_len(row[: min(row.find(mark) for mark in "✓–" if mark in row)]) for row in rows}
    assert len(first) == 1
    assert lines[-2].split() == ["178", "✓", "0", "✗", "23", "–", "└", names[0]]


@pytest.mark.long
def test_two_hundred_hand_ins(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    expected, begun = hand_ins.write(folder, 200), time.monotonic()
    grades = course.grade(folder, EIGHT)
    assert marks(grades) == expected
    assert time.monotonic() - begun < 600 * max(1, 2 / len(os.sched_getaffinity(0)))
    assert strays() == []


@pytest.mark.skipif(sys.platform != "linux", reason="a server that forks is Linux's")
def test_one_that_kills_the_server_of_all_costs_nobody_else_a_mark(tmp_path, capsys):
    (tmp_path / "in").mkdir()
    slow = "import time\nfor _ in range(1):\n    late = time.sleep(2)\n\ndef uses():\n    return late\n"
    (tmp_path / "in" / "a_honest.py").write_text(hand_ins.IMPORTS + slow + hand_ins.RIGHT["polyak"])
    (tmp_path / "in" / "b_kill.py").write_text("import os, time\nx = time.sleep(1)\ny = os.kill(os.getppid(), 9)\n")
    (tmp_path / "in" / "carol.zip").touch()
    found = marks(course.grade(tmp_path / "in", "polyak", to=tmp_path / "out"))
    assert found == {"a_honest.py": {"polyak": True}, "b_kill.py": {"polyak": None}}
    assert "Left out: carol.zip; a hand-in is a .py or .ipynb file" in capsys.readouterr().err


def test_beside_a_single_file_lies_what_it_may_read(tmp_path):
    for name in ("a.py", "b.ipynb", "data.json", "table.csv.gz", "report.pdf", "Scan.JPG"):
        (tmp_path / name).touch()
    assert {file.name for file in grading.files_of(tmp_path / "a.py")} == {"a.py", "data.json", "table.csv.gz"}
    assert len(grading.files_of(tmp_path)) == 6


def test_a_module_of_a_package_begins_above_it_and_others_where_the_files_do(tmp_path):
    inner = tmp_path / "week 6" / "mine"
    inner.mkdir(parents=True)
    assert [handin._home(inner / name, tmp_path) for name in ("main.py", "work.ipynb")] == [inner, inner]
    (inner / "__init__.py").touch()
    assert handin._home(inner / "main.py", tmp_path) == tmp_path / "week 6"


def test_what_functions_need_is_read_and_a_function_counts_before_a_method(tmp_path):
    text = "cfg = {}\ncfg.update(one=1)\n\ndef gae():\n    return cfg['one']\n\nclass T:\n    def gae(self): ...\n"
    for number, cell in enumerate(
        ("!pip install torch \\\n    gymnasium\nx = 1\n", "%matplotlib inline\ny = (7\n     % 3)\n")
    ):
        text_of = hand_ins.notebook(cell, "def td_target(): ...")
        assert found_in(tmp_path / str(number), work__ipynb=text_of) == [["td_target"], []]
    assert found_in(tmp_path / "py", work__py=text) == [["gae"], []]
    code = SCRIPT.replace("print(", "assert handin.solutions(reader, [])['gae'][0]() == 1; print(")
    subprocess.run([sys.executable, "-c", code, tmp_path / "py"], check=True)


RETURNS = """import torch

{before}

def discounted_returns(rewards, gamma):
    returns, after = torch.zeros_like(rewards), 0.0
    for t in reversed(range(len(rewards))):
        after = rewards[t] * {one} + gamma * after
        returns[t] = after
    return returns

{behind}
"""
FILLED = {
    "loop.py": ("SCALE = {}\nfor name in 'ab':\n    SCALE[name] = 1.0", "SCALE['a']", ""),
    "with.py": ("SCALE = {}\nwith torch.no_grad():\n    SCALE['a'] = 1.0", "SCALE['a']", ""),
    "append.py": ("SCALE = []\nwhile not SCALE:\n    SCALE.append(1.0)", "SCALE[0]", ""),
    "insert.py": ("SCALE = []\nSCALE.insert(0, 1.0)", "SCALE[0]", ""),
    "setattr.py": ("class Scale: ...\nsetattr(Scale, 'a', 1.0)", "Scale.a", ""),
    "later.py": ("SCALE = {}\ndef set_up():\n    SCALE.update(a=1.0)", "SCALE['a']", "set_up()"),
    "set anew.py": ("SCALE = {'a': 1.0}\nfor each in (1.0, 5.0):\n    SCALE['a'] = each", "SCALE['a']", ""),
    "long.py": (
        "SCALE = {}\nSCALE['a'] = 1.0\nseen, more = [], []",
        "(SCALE['a'] + 0 * len(seen) + 0 * len(more))",
        "while True:\n    seen.append(1)\nwhile True:\n    more.append(1)",
    ),
    "global.py": ("def set_up():\n    global SCALE\n    SCALE = 1.0", "SCALE", "set_up()"),
    "arguments.py": (
        "import argparse\nparser = argparse.ArgumentParser()\n"
        "parser.add_argument('--scale', type=float, default=2.0)\nparser.set_defaults(scale=1.0)\n"
        "args = parser.parse_args()",
        "args.scale",
        "",
    ),
    "main.py": ("", "SCALE", "if __name__ == '__main__':\n    SCALE = 1.0\n    print(SCALE)"),
    "not the main one.py": ("from os import X_OK as SCALE", "SCALE", "if __name__ == '__main__':\n    SCALE = 5.0"),
    "not a builtin.py": ("", "sum([1.0])", "if __name__ == '__main__':\n    sum = 5.0"),
    "arguments of the main one.py": (
        "",
        "args.scale",
        "if __name__ == '__main__':\n    import argparse\n    parser = argparse.ArgumentParser()\n"
        "    parser.add_argument('--scale', type=float, default=1.0)\n    args = parser.parse_args()",
    ),
}
METHOD = """
class Agent:
    def after(self, reward, gamma, returns): return reward + gamma * returns
"""
BASE = "class Base:\n    def discounted_returns(self, rewards, gamma):\n        raise NotImplementedError"
IN_CLASSES = {
    "a base.ipynb": (
        BASE,
        RETURNS.format(before="", one="1.0", behind="").replace("(rewards, ", "(self, rewards, "),
        "class Mine(Base):\n    pass\nMine.discounted_returns = discounted_returns\ndel discounted_returns",
        "class Other(Base):\n    def act(self): ...",
    ),
    "two cells.ipynb": (
        METHOD + "    def discounted_returns(self, rewards, gamma):\n        returns, after = 0 * rewards, 0.0\n"
        "        for t in reversed(range(len(rewards))):\n"
        "            returns[t] = after = self.after(rewards[t], gamma, after)\n        return returns",
        "class Agent(Agent):\n    def act(self): ...",
    ),
    "put there.ipynb": (
        METHOD,
        RETURNS.format(before="", one="1.0", behind="Agent.discounted_returns = discounted_returns")
        .replace("(rewards, ", "(self, rewards, ")
        .replace("rewards[t] * 1.0 + gamma * after", "self.after(rewards[t], gamma, after)"),
    ),
}


@pytest.fixture(scope="module")
def in_other_forms(tmp_path_factory):
    folder = tmp_path_factory.mktemp("forms") / "in"
    (folder / "package" / "mine").mkdir(parents=True)
    for name, (before, one, behind) in FILLED.items():
        (folder / name).write_text(RETURNS.format(before=before, one=one, behind=behind))
    plain = RETURNS.format(before="", one="1.0", behind="")
    (folder / "writes.ipynb").write_text(
        hand_ins.notebook(f"%%writefile mine.py\n{plain}", "from mine import discounted_returns")
    )
    (folder / "writes and runs.ipynb").write_text(hand_ins.notebook(f"%%writefile mine.py\n{plain}", "!python mine.py"))
    wrong = plain.replace("gamma * after", "after")
    drafts = f"%%writefile 'lib/a draft.py'\n{wrong}", "%%writefile notes.md\n# so", plain
    (folder / "draft.ipynb").write_text(hand_ins.notebook(*drafts))
    (folder / "profiles.ipynb").write_text(hand_ins.notebook(f"%%prun\n{plain}", "%%bash echo 'it\nls", "%%writefile"))
    (folder / "package" / "mine" / "__init__.py").touch()
    (folder / "package" / "mine" / "helper.py").write_text(plain.replace("discounted_returns", "their_returns"))
    uses = "from .helper import their_returns\n\ndef discounted_returns(rewards, gamma):\n    return their_returns(rewards, gamma)\n"
    (folder / "package" / "mine" / "main.py").write_text(uses)
    for name, cells in IN_CLASSES.items():
        (folder / name).write_text(hand_ins.notebook(*cells))
    beside, reads = (
        folder / "beside" / "week 6",
        RETURNS.format(before="", one="SCALE * json.load(open('scale.json'))", behind=""),
    )
    beside.mkdir(parents=True)
    (beside / "scale.json").write_text("1.0")
    (beside / "helpers.py").write_text("TWO = 2.0")
    inside = "def set_up():\n    %run ./helpers.py\n    return 1", "%run nothing.py"
    cells = (
        *inside,
        "import json\nSCALE = json.load(open('scale.json'))",
        "%run ./helpers.py",
        "SCALE *= TWO / 2",
        reads,
    )
    (beside / "work.ipynb").write_text(hand_ins.notebook(*cells))
    (folder / "half a letter.py").write_text("def discounted_returns(rewards, gamma):\n    raise ValueError('\\ud83d')")
    if sys.platform == "linux":
        (folder / os.fsdecode(b"M\xfcller.py")).write_text(plain)
    (folder / "empty.ipynb").touch()
    (folder / "old.ipynb").write_text(json.dumps({"nbformat": 3, "worksheets": []}))
    (folder / "nul.py").write_bytes(b"x = 1\0")
    (folder / "large.ipynb").write_text(hand_ins.notebook(plain)[:-2] + ', "x": "' + "0" * grading.MOST_COPIED + '"}')
    grades = course.grade(folder, "discounted_returns", to=folder.parent / "out")
    return SimpleNamespace(grades=grades, to=folder.parent / "out")


@pytest.mark.parametrize(
    "name",
    [
        *FILLED,
        *IN_CLASSES,
        "draft.ipynb",
        "writes.ipynb",
        "writes and runs.ipynb",
        "profiles.ipynb",
        "package",
        "beside",
    ],
)
def test_right_solutions_in_other_forms_are_right(in_other_forms, name):
    assert marks(in_other_forms.grades)[name] == {"discounted_returns": True}, sentence(
        in_other_forms, name, "discounted_returns"
    )


@pytest.mark.usefixtures("otter")
@pytest.mark.parametrize("name", IN_CLASSES)
def test_the_test_file_for_otter_finds_a_method_in_whatever_cell_it_stands(name):
    scope, env = {}, {"__name__": "__main__"}
    exec(filled(grading.TEMPLATES / "otter.py.j2", {}, name="discounted_returns"), scope)
    for cell in IN_CLASSES[name]:
        exec(cell, env)
    scope["test_discounted_returns"](env)


@pytest.mark.skipif(sys.platform != "linux", reason="names of bytes are Linux's")
def test_a_name_and_a_message_that_are_no_utf_8_cost_nobody_a_mark(in_other_forms):
    assert marks(in_other_forms.grades)[os.fsdecode(b"M\xfcller.py")] == {"discounted_returns": True}
    assert "it raised ValueError: \ud83d" in sentence(in_other_forms, "half a letter.py", "discounted_returns")
    (written,) = in_other_forms.to.glob("findings.json")
    assert json.loads(written.read_text())["hand_ins"]


@pytest.mark.parametrize(
    ("hand_in", "words"),
    [
        ("profiles.ipynb", "code cell 2 of profiles.ipynb: left out, since %%bash makes it another language."),
        ("empty.ipynb", "empty.ipynb cannot be read: it is no notebook with cells: it is empty."),
        ("old.ipynb", "old.ipynb cannot be read: it is no notebook with cells: save it once with a newer Jupyter."),
        ("nul.py", "nul.py: SyntaxError: source code string cannot contain null bytes."),
        ("large.ipynb", "large.ipynb has 64 MB; at most 64 are read: clear the outputs of a notebook."),
        ("package", ""),
        ("draft.ipynb", ""),
        ("beside", ""),
        ("arguments of the main one.py", ""),
        ("long.py", "left out, since it did not end within 3 s."),
    ],
)
def test_what_is_left_out_is_said(in_other_forms, hand_in, words):
    said = notes(in_other_forms, hand_in)
    assert words in said if words else said == ""
    assert said.count("did not end") <= 1  # all loops share the time of one


RIGHT = RETURNS.format(before="{before}", one="{one}", behind="")
UNUSUAL = {
    "a length that raises.py": (
        "class Buffer:\n    def __len__(self):\n        raise NotImplementedError('to be written')\n"
        "buffer = Buffer()\nbuffer.scale = 1.0",
        "buffer.scale",
    ),
    "a property of a class that raises.py": (
        "class Agent:\n    @classmethod\n    @property\n    def device(cls):\n        return cls.settings['device']\n",
        "1.0",
    ),
    "a long sum.py": (f"TOTAL = {' + '.join(['1'] * 1_500)}", "1.0"),
    "an exception without words.py": (
        "class Mine(Exception):\n    def __str__(self):\n        return self.nothing\nx = 1\n"
        "def fail():\n    raise Mine\ny = fail()",
        "1.0",
    ),
}


def test_whatever_stands_beside_a_right_solution_costs_it_no_mark(tmp_path):
    for name, (before, one) in UNUSUAL.items():
        (tmp_path / "in").mkdir(exist_ok=True)
        (tmp_path / "in" / name).write_text(RIGHT.format(before=before, one=one))
    inside = tmp_path / "in" / "ben" / "env"
    inside.mkdir(parents=True)
    (inside / "quad.py").write_text("SCALE = 1.0")
    (inside.parent / "main.py").write_text(RIGHT.format(before="from env.quad import SCALE", one="SCALE"))
    (inside.parent / "mine" / "lib").mkdir(parents=True)
    (inside.parent / "mine" / "pyvenv.cfg").touch()
    (inside.parent / "mine" / "lib" / "installed.py").write_text("raise SystemExit")
    found = course.grade(tmp_path / "in", "discounted_returns", to=tmp_path / "out")
    assert marks(found) == {name: {"discounted_returns": True} for name in (*UNUSUAL, "ben")}
    (ben,) = (record for record in found["hand_ins"] if record["hand_in"] == "ben")
    assert ben["notes"] == []
