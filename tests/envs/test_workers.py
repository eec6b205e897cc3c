"""A worker that dies or hangs is named within a bounded time, and closing never hangs."""

import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

from lemniscate.envs import registry
from lemniscate.envs.workers import WatchedVectorEnv
from lemniscate.errors import WorkerError


class Stubborn(gym.Env):
    """Sleeps for ever at the third step of the copy whose number is asked for, deaf to every signal but SIGKILL."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.hangs, self.t = seed == 2, 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        self.t += 1
        if self.hangs and self.t == 3:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            time.sleep(1000)
        return np.zeros(1, dtype=np.float32), 0.0, False, False, {}


class NeverThere(Stubborn):
    """Its constructor returns in this process only."""

    def __init__(self):
        if multiprocessing.parent_process() is not None:
            time.sleep(1000)


class Gone(Stubborn):
    """Its constructor takes any other process with it."""

    def __init__(self):
        if multiprocessing.parent_process() is not None:
            os._exit(3)


@pytest.mark.parametrize(
    ("name", "patience", "sentence"),
    [
        ("NeverThere", 4.0, r"Environment 0, 1 has not answered for 4 s\."),
        ("Gone", 60.0, r"The process of environment \d died \(exit code 3\)"),
    ],
)
def test_one_that_never_comes_to_life_is_named(monkeypatch, name, patience, sentence):
    monkeypatch.setattr(WatchedVectorEnv, "patience", patience)
    with pytest.raises(WorkerError, match=sentence):
        registry.make(f"envs.test_workers:{name}", 2, backend="gymnasium-async")
    assert not multiprocessing.active_children()


class Failing(Stubborn):
    """Raises at the second step: an exception that holds a lock, which no pipe takes."""

    def step(self, action):
        self.t += 1
        if self.t == 2:
            error = ValueError("the motor is off")
            error.lock = threading.Lock()
            raise error
        return np.zeros(1, dtype=np.float32), 0.0, False, False, {}


class Locked(Stubborn):
    """Puts a lock into its info, which no pipe takes."""

    def step(self, action):
        return np.zeros(1, dtype=np.float32), 0.0, False, False, {"lock": threading.Lock()}


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Failing", r"Environment \d raised ValueError: the motor is off \(test_workers.py, line \d+\)\."),
        ("Locked", r"Environment \d raised .*pickle"),
    ],
)
def test_one_that_raises_is_named_with_the_place(capfd, name, sentence):
    env = registry.make(f"envs.test_workers:{name}", 2, backend="gymnasium-async")
    try:
        env.restart(0)
        with pytest.raises(WorkerError, match=sentence):
            step(env, 3)
    finally:
        env.close()
    assert "Traceback" not in capfd.readouterr().err
    assert not multiprocessing.active_children()


OWNER = """
import sys, torch
from lemniscate.envs import registry
if __name__ == "__main__":
    env = registry.make("envs.test_workers:Spinning", 2, backend="gymnasium-async")
    env.restart(0)
    print(*(process.pid for process in env.backend._envs.processes), flush=True)
    env.step(torch.zeros(2, dtype=torch.int64))
"""


class Spinning(Stubborn):
    """An endless loop in a single call of C, which holds the interpreter."""

    def step(self, action):
        sum(itertools.repeat(0))


def test_workers_end_with_their_owner_also_in_an_endless_loop(tmp_path):
    script = tmp_path / "owner.py"
    script.write_text(OWNER)
    tests = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tests), *filter(None, sys.path)])}
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=environment) as owner:
        workers = [int(pid) for pid in owner.stdout.readline().split()]
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
    env = registry.make("envs.test_workers:Stubborn", 3, backend="gymnasium-async")
    try:
        env.restart(0)  # the environments get the seeds 0, 1, 2
        monkeypatch.setattr(WatchedVectorEnv, "patience", 2.0)  # not before: to start takes longer on a busy machine
        with pytest.raises(WorkerError, match=r"Environment 2 has not answered for 2 s\."):
            step(env, 3)
        processes = env.backend._envs.processes
    finally:
        env.close()
    assert not any(process.is_alive() for process in processes)
