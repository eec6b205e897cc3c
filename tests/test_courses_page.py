"""The page on the courses: its Python runs, its commands are understood, its sweep starts a run."""

import re
import shlex
from pathlib import Path

import pytest

from lemniscate.cli import parse

PAGE = (Path(__file__).parents[1] / "docs" / "courses.md").read_text()


def test_the_python_of_the_page_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))
    scope = {"__name__": "courses"}
    shorter = "total_steps=64, learning_starts=32, hidden=(8,), critic_hidden=(8,), progress=False"
    code, found = re.subn(r"total_steps=2_000, learning_starts=500", shorter, code)
    assert found == 1
    exec(compile(code, "courses.md", "exec"), scope)
    assert (tmp_path / "models" / "pendulum" / "manifest.json").exists()
    assert scope["path"].read_text().count("NotImplementedError(") == 5


def commands():
    return re.findall(r"(?:^|`)lemniscate ((?:train|watch|evaluate|plot)[^`\n#]+)", PAGE, re.MULTILINE)


@pytest.mark.parametrize("line", commands())
def test_every_command_is_understood(line):
    parse([*shlex.split(line), *([] if "--env" in line or "train" not in line else ["--env", "CartPole-v1"])])


def test_the_sweep_of_weights_and_biases_is_a_command():
    names = re.findall(r"^  ([a-z-]+): \{min: ([\d.]+)", PAGE, re.MULTILINE)
    assert len(names) == 6
    (line,) = re.findall(r'^command: \["\$\{program\}", (.*), "\$\{args\}"\]', PAGE, re.MULTILINE)
    parse([*line.replace('"', "").split(", "), *(f"--{name}={value}" for name, value in names)])
