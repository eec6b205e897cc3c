"""Environments that break in a worker. Each worker imports this, so it imports nothing that takes seconds."""

import itertools
import multiprocessing
import os
import signal
import threading
import time
from pathlib import Path

import gymnasium as gym
import numpy as np


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


class Spinning(Stubborn):
    """An endless loop in a single call of C, which holds the interpreter."""

    def step(self, action):
        sum(itertools.repeat(0))


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
    "system exit": (lambda: raise_(SystemExit(1)), r"SystemExit|called sys\.exit\(1\)"),
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
