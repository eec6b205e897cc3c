"""The files and lines that a reader steps through: an update and a command, traced.

Counted are the files under src/lemniscate in which a function is called, other than by an import, and all their lines.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import lemniscate

SOURCE = Path(lemniscate.__file__).parent

TRACE = '''
import sys
from pathlib import Path

SOURCE, files = sys.argv[1], set()


def is_imported(frame):
    """Whether the frame is a part of an import: nobody steps through a module's definitions."""
    while frame:
        if frame.f_code.co_name == "<module>" and frame.f_code.co_filename.startswith(SOURCE):
            return True
        frame = frame.f_back
    return False


def trace(frame, event, arg):
    file = frame.f_code.co_filename
    if file.startswith(SOURCE) and file not in files and not is_imported(frame):
        files.add(file)


def print_files():
    for file in sorted(files):
        print(len(Path(file).read_text().splitlines()), file.removeprefix(SOURCE))
'''

UPDATE = """
import importlib
import torch
from lemniscate.data.replay import interact
from lemniscate.data.rollout import collect
from lemniscate.envs import registry

algo = importlib.import_module(f"lemniscate.algos.{sys.argv[2]}")
off_policy = {"learning_starts": 8, "total_steps": 1000, "batch_size": 16} if sys.argv[2] == "sac" else {}
config = algo.Config(env="Pendulum-v1", num_envs=4, **off_policy)
env = registry.make("Pendulum-v1", 4, backend="gymnasium", stagger=True)
env.restart(0)
state = algo.init(config, env.spec, torch.device("cpu"))


def play():
    interact(env, state.networks.policy, state.replay, state.action_noise, state.rng.action)


def update():
    if off_policy:
        play()
        algo.update(config, state)
    else:
        algo.update(config, state, collect(env, state.networks.policy, config.num_steps, state.rng.action))


for _ in range(20 if off_policy else 0):
    play()
update()
env.take_episodes()
sys.settrace(trace)
update()
sys.settrace(None)
print_files()
"""

COMMAND = """
sys.settrace(trace)
from lemniscate.cli import main
main(sys.argv[2:])
sys.settrace(None)
print_files()
"""


def traced(program, *arguments, folder):
    """The number of files, of their lines, and the table of both, printed by `program` in a process of its own."""
    command = [sys.executable, "-c", TRACE + program, f"{SOURCE}{os.sep}", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    rows = [line.split(maxsplit=1) for line in done.stdout.splitlines() if line.endswith(".py")]
    return len(rows), sum(int(lines) for lines, _ in rows), done.stdout


@pytest.mark.parametrize(("algorithm", "most_files", "most_lines"), [("ppo", 16, 1900), ("sac", 17, 2000)])
def test_an_update_walks_through_few_files(tmp_path, algorithm, most_files, most_lines):
    files, lines, table = traced(UPDATE, algorithm, folder=tmp_path)
    assert files <= most_files, table
    assert lines <= most_lines, table
    assert {f"algos/{algorithm}.py", "optim/adam.py", "envs/vec_env.py"} <= set(table.split())


def test_a_training_command_walks_through_few_files(tmp_path):
    command = "train ppo --env Pendulum-v1 --backend gymnasium --total-steps 2048"
    files, lines, table = traced(COMMAND, *command.split(), folder=tmp_path)
    assert files <= 46, table  # the aim is 28 files and 4,000 lines
    assert lines <= 5_700, table
    assert {"algos/ppo.py", "cli/__init__.py", "run/run.py"} <= set(table.split())
