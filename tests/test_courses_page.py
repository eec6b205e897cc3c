"""The page on the courses: its Python runs, its commands are understood, its sweep starts a run."""

import re
import shlex
from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import lemniscate as lem
import zoo_files
from lemniscate import course
from lemniscate.api import results
from lemniscate.cli import parse
from lemniscate.course import loop, setup

PAGE = (Path(__file__).parents[1] / "docs" / "courses.md").read_text()


def test_the_python_of_the_page_runs(tmp_path, monkeypatch):
    """To its end, once the skeleton is filled in."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(results, "FINAL_EPISODES", 4)
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))
    scope = {"__name__": "courses"}
    shorter = "total_steps=64, learning_starts=32, hidden=(8,), critic_hidden=(8,), progress=False"
    for long, short in (
        ("total_steps=2_000, learning_starts=500", shorter),
        ("total_steps=1_000_000", "total_steps=2048"),
    ):
        assert code.count(long) == 1
        code = code.replace(long, short)
    before, filled_in, after = code.partition("from my_ppo import")
    exec(compile(before, "courses.md", "exec"), scope)
    assert (tmp_path / "models" / "pendulum" / "manifest.json").exists()
    assert (tmp_path / "mine.webp").exists()
    assert scope["path"].read_text().count("NotImplementedError(") == 5
    (tmp_path / "my_ppo.py").write_text(loop.solution("ppo"))
    exec(compile(filled_in + after, "courses.md", "exec"), scope)
    assert scope["agent"].act(np.zeros((16, 105), np.float32)).shape == (16, 8)


def test_the_table_of_errors_counts_the_solutions_of_the_zoo():
    counts = {name: Counter() for name in course.EXERCISES}
    for file in zoo_files.ZOO.glob("*.py"):
        counts[file.name.split(".")[0]].update(solution.kind for solution in zoo_files.load(file))
    misses, named = re.findall(r"^\| \*\*all\*\* \| .* \| (\d+) \| (\d+)% \|$", PAGE, re.MULTILINE)[0]
    each = re.findall(r"^\| `\w+` \| \d+ \| 0 \| \d+ \| (\d+) \| \d+% \|$", PAGE, re.MULTILINE)
    assert int(misses) == sum(map(int, each)) <= 0.02 * sum(of["wrong"] for of in counts.values())
    assert int(named) >= 85
    rows = re.findall(r"^\| `?(\w+|\*\*all\*\*)`? \| (\d+) \| 0 \| (\d+) \|", PAGE, re.MULTILINE)
    assert {name: (int(right), int(wrong)) for name, right, wrong in rows} == {
        name: (of["right"], of["wrong"]) for name, of in {**counts, "**all**": sum(counts.values(), Counter())}.items()
    }


def test_the_environments_of_the_page_give_tensors_beyond_the_end_of_an_episode():
    (code,) = re.findall(
        r"```python\n(from gymnasium.wrappers.vector import RecordEpisodeStatistics.*?)```", PAGE, re.DOTALL
    )
    scope = {"gym": gym, "lem": lem, "course": course, "torch": torch}
    exec(code, scope)
    train_envs, eval_envs = scope["make_envs"](3, 2, torch.device("cpu"), "CartPole-v1")
    obs, _ = train_envs.reset(seed=0)
    ended = 0
    for _ in range(30):
        obs, reward, terminated, truncated, infos = train_envs.step(torch.ones(3, dtype=torch.int64))
        assert all(isinstance(one, torch.Tensor) for one in (obs, reward, terminated, truncated))
        ended += "final_obs" in infos
    assert ended
    assert setup.normalizer(eval_envs).update_running_mean is False


def commands():
    return re.findall(r"(?:^|`)lemniscate ((?:train|watch|evaluate|plot)[^`\n#]+)", PAGE, re.MULTILINE)


@pytest.mark.parametrize("line", commands())
def test_every_command_is_understood(line):
    given = parse([*shlex.split(line), *([] if "--env" in line or "train" not in line else ["--env", "CartPole-v1"])])
    for algorithm in given.algorithm.split(",") if given.command == "train" else ():
        lem.config_for(algorithm, given.env, given.preset, **given.fields)  # which refuses what does not fit together


def test_the_sweep_of_weights_and_biases_is_a_command():
    names = re.findall(r"^  ([a-z-]+): \{min: ([\d.]+)", PAGE, re.MULTILINE)
    assert len(names) == 6
    (line,) = re.findall(r'^command: \["\$\{program\}", (.*), "\$\{args\}"\]', PAGE, re.MULTILINE)
    given = parse([*line.replace('"', "").split(", "), *(f"--{name}={value}" for name, value in names)])
    assert "metric: {name: evaluation/return, goal: maximize}" in PAGE
    assert lem.config_for("ppo", given.env, **given.fields).evaluate_every  # otherwise it is never logged


def test_what_the_page_shows_of_q_is_logged():
    (line,) = (line for line in commands() if line.endswith("--run runs/hopper"))
    assert parse(shlex.split(line)).fields["evaluate_every"]
