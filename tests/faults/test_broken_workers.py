"""Workers that break in every way, wherever they are: named within patience and 2 s; Ctrl-C ends training within 3 s."""

import itertools
import json
import multiprocessing
import os
import re
import signal
import threading
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch

from forks import command
from lemniscate.envs import registry
from lemniscate.envs.workers import WatchedVectorEnv, WorkerError

PATIENCE = 8.0
SHORT = ("segfault", "exception that no pipe takes", "exception without words")


class Wordless(Exception):
    """An exception that cannot say what it is, nor be rebuilt."""

    def __init__(self, first, second):
        super().__init__()

    def __str__(self):
        raise RuntimeError("no words")


def raise_locked():
    error = ValueError("the motor is off")
    error.lock = threading.Lock()
    raise error


def raise_(error):
    raise error


def spin():
    while True:
        pass


WAYS = {
    # how a worker breaks: what it does, what is said of it
    "killed": (lambda: os.kill(os.getpid(), signal.SIGKILL), "died"),
    "segfault": (lambda: os.kill(os.getpid(), signal.SIGSEGV), "died"),
    "exit": (lambda: os._exit(3), "died"),
    "stopped": (lambda: os.kill(os.getpid(), signal.SIGSTOP), "has not answered"),
    "sleep": (lambda: time.sleep(1000), "has not answered"),
    "loop": (spin, "has not answered"),
    "loop in C": (lambda: sum(itertools.repeat(0)), "has not answered"),
    "exception": (lambda: raise_(ValueError("the motor is off")), "ValueError: the motor is off"),
    "exception that no pipe takes": (raise_locked, "ValueError: the motor is off"),
    "exception without words": (lambda: raise_(Wordless(1, 2)), "Wordless"),
    "exception of 10 MB": (lambda: raise_(ValueError("x" * 10**7)), "ValueError: xxx"),
    "keyboard interrupt": (lambda: raise_(KeyboardInterrupt()), "KeyboardInterrupt|died"),
    "system exit": (lambda: raise_(SystemExit(1)), "SystemExit|died"),
    "recursion": (lambda: (lambda f: f(f))(lambda f: f(f)), "RecursionError"),
    "memory error": (lambda: raise_(MemoryError()), "MemoryError"),
}
PLACES = ("constructor", "reset", "step")


class Broken(gym.Env):
    """Breaks in a worker, at its first call of one kind; `told` is a file that it makes then."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
    action_space = gym.spaces.Discrete(2)

    def __init__(self, way, place, told):
        self.way, self.place, self.told = way, place, told
        self._break("constructor")

    def _break(self, place):
        if place == self.place and multiprocessing.parent_process() is not None:
            Path(self.told).touch()
            WAYS[self.way][0]()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._break("reset")
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        self._break("step")
        return np.zeros(1, dtype=np.float32), 0.0, False, False, {}


def left(before):
    """The processes that were started since, less the two that multiprocessing keeps."""
    kept = ("forkserver", "resource_tracker")
    started = [child for child in psutil.Process().children(recursive=True) if child not in before]
    return [child for child in started if not any(name in " ".join(child.cmdline()) for name in kept)]


def use(**kwargs):
    """Make two environments, and take a step; (when, what is said of the one that breaks)."""
    env = None
    try:
        env = registry.make(f"{__name__}:Broken", 2, kwargs=kwargs, backend="gymnasium-async")
        env.restart(0)
        env.step(torch.zeros(2, dtype=torch.int64))
    except WorkerError as error:
        return time.time(), str(error)
    finally:
        if env:
            env.close()
    raise AssertionError("nothing was raised")


@pytest.mark.parametrize(
    ("way", "place"),
    [
        pytest.param(way, place, marks=() if place == "step" and way in SHORT else pytest.mark.faults)
        for way in WAYS
        for place in PLACES
    ],
)
def test_a_worker_that_breaks_is_named_in_time(monkeypatch, tmp_path, capfd, way, place):
    monkeypatch.setattr(WatchedVectorEnv, "patience", PATIENCE)
    before = set(psutil.Process().children(recursive=True))
    when, said = use(way=way, place=place, told=str(tmp_path / "broken"))
    took = when - (tmp_path / "broken").stat().st_mtime
    assert re.search(WAYS[way][1], said), said
    assert "nvironment " in said
    assert len(said) < 700, said
    assert "\n" not in said
    assert took < PATIENCE + 2
    assert not left(before)
    assert "Traceback" not in capfd.readouterr().err
    print(f"{way} in {place}: {said} After {took:.1f} s")


@pytest.mark.parametrize(
    ("way", "place"),
    [
        pytest.param(way, place, marks=() if (way, place) == ("loop in C", "step") else pytest.mark.faults)
        for way in ("stopped", "sleep", "loop", "loop in C")
        for place in PLACES
    ],
)
def test_ctrl_c_ends_training_while_a_worker_blocks(tmp_path, way, place):
    kwargs = json.dumps({"way": way, "place": place, "told": str(tmp_path / "broken")})
    given = ["--env-args", kwargs, "--backend", "gymnasium-async", "--num-envs", "2", "--run", tmp_path / "r"]
    process = command("train", "a2c", "--env", f"{__name__}:Broken", *given)
    while not (tmp_path / "broken").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    asked = time.monotonic()
    said = "".join(process.communicate(timeout=60))
    assert time.monotonic() - asked < 3, said
    assert process.returncode in (1, 130), said
    assert "Traceback" not in said
