"""A worker that dies or hangs is named within a bounded time, and closing never hangs."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from forks import forks
from lemniscate.envs import registry
from lemniscate.envs.workers import WatchedVectorEnv
from lemniscate.errors import WorkerError


@pytest.mark.parametrize(
    ("name", "patience", "sentence"),
    [
        ("NeverThere", 1.0, r"Environment 0, 1 has not answered for 1 s\."),
        ("Gone", 60.0, r"The process of environment \d died \(exit code 3\)"),
    ],
)
def test_one_that_never_comes_to_life_is_named(monkeypatch, name, patience, sentence):
    monkeypatch.setattr(WatchedVectorEnv, "patience", patience)
    with pytest.raises(WorkerError, match=sentence):
        registry.make(f"broken:{name}", 2, backend="gymnasium-async")
    assert not multiprocessing.active_children()


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Failing", r"Environment \d raised ValueError: the motor is off \(broken.py, line \d+\)\."),
    ],
)
def test_one_that_raises_is_named_with_the_place(capfd, name, sentence):
    env = registry.make(f"broken:{name}", 2, backend="gymnasium-async")
    try:
        env.restart(0)
        with pytest.raises(WorkerError, match=sentence):
            step(env, 3)
    finally:
        env.close()
    assert "Traceback" not in capfd.readouterr().err
    assert not multiprocessing.active_children()


OWNER = """
import torch
from pathlib import Path
from lemniscate.envs import registry
env = registry.make("broken:Spinning", 2, backend="gymnasium-async")
env.restart(0)
Path("told").write_text(" ".join(str(process.pid) for process in env.backend._envs.processes))
Path("told").rename("workers")
env.step(torch.zeros(2, dtype=torch.int64))
"""


@pytest.mark.long
def test_workers_end_with_their_owner_also_in_an_endless_loop(tmp_path):
    owner = forks().start(OWNER, tmp_path)
    while not (tmp_path / "workers").exists():
        assert owner.poll() is None, owner.communicate()
        time.sleep(0.02)
    workers = [int(pid) for pid in (tmp_path / "workers").read_text().split()]
    time.sleep(0.5)  # into the loop
    assert all(map(is_alive, workers))
    assert len(workers) == 2
    owner.kill()
    deadline = time.monotonic() + 2
    while any(map(is_alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(is_alive, workers))


def is_alive(pid):
    """Whether a process is there that is not dead already."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def step(env, times):
    for _ in range(times):
        env.step(torch.zeros(env.num_envs, dtype=torch.int64))


def test_one_that_dies_is_named():
    env = registry.make("CartPole-v1", 3, backend="gymnasium-async")
    try:
        env.restart(0)
        step(env, 1)
        os.kill(env.backend._envs.processes[1].pid, signal.SIGKILL)
        with pytest.raises(WorkerError, match=r"The process of environment 1 died \(exit code -9\)"):
            step(env, 2)
    finally:
        env.close()


def test_one_that_hangs_is_named_and_closing_kills_it(monkeypatch):
    env = registry.make("broken:Stubborn", 3, backend="gymnasium-async")
    try:
        env.restart(0)  # the environments get the seeds 0, 1, 2
        monkeypatch.setattr(WatchedVectorEnv, "patience", 2.0)  # not before: to start takes longer on a busy machine
        with pytest.raises(WorkerError, match=r"Environment 2 has not answered for 2 s\."):
            step(env, 3)
        processes = env.backend._envs.processes
    finally:
        env.close()
    assert not any(process.is_alive() for process in processes)


UNGUARDED = """
import lemniscate as lem
print("once", flush=True)
env = lem.make_vec("CartPole-v1", 2, backend="gymnasium-async")
"""


def test_a_script_without_a_guard_is_told_in_one_sentence(tmp_path):
    """A worker imports the script again; nothing in it is done twice, and no worker speaks."""
    (tmp_path / "script.py").write_text(UNGUARDED)
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1
    assert "A script needs `if __name__ == '__main__':` before it." in done.stderr
