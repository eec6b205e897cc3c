"""Workers that break in every way, wherever they are: named within patience and 2 s; Ctrl-C ends training within 3 s."""

import itertools
import json
import multiprocessing
import os
import re
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch

from broken import PLACES, WAYS
from forks import command
from lemniscate.envs import registry
from lemniscate.envs.workers import WatchedVectorEnv
from lemniscate.errors import UserError, WorkerError

PATIENCE = 8.0
SHORT = ("segfault", "exception that no pipe takes", "exception without words")


def left(before):
    """The processes that were started since, less the two that multiprocessing keeps."""
    found = []
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # it may end meanwhile
            words = " ".join(child.cmdline())
            if child not in before and "forkserver" not in words and "resource_tracker" not in words:
                found.append(child)
    return found


def use(monkeypatch, **kwargs):
    """Make two environments, and take a step; (when, what is said of the one that breaks)."""
    env = None
    if kwargs["place"] != "step":  # there it is the start that breaks
        monkeypatch.setattr(WatchedVectorEnv, "patience", PATIENCE)
    try:
        env = registry.make("broken:Broken", 2, kwargs=kwargs, backend="gymnasium-async")
        env.restart(0)
        monkeypatch.setattr(
            WatchedVectorEnv, "patience", PATIENCE
        )  # not before: to start takes longer on a busy machine
        env.step(torch.zeros(2, dtype=torch.int64))
    except (WorkerError, UserError) as error:  # sys.exit in reset or step is the environment's mistake
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
    before = set(psutil.Process().children(recursive=True))
    when, said = use(monkeypatch, way=way, place=place, told=str(tmp_path / "broken"))
    took = when - (tmp_path / "broken").stat().st_mtime
    assert re.search(WAYS[way][1], said), said
    assert re.search(r"nvironment |Broken\.", said), said
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
@pytest.mark.long
def test_ctrl_c_ends_training_while_a_worker_blocks(tmp_path, way, place):
    kwargs = json.dumps({"way": way, "place": place, "told": str(tmp_path / "broken")})
    given = ["--env-args", kwargs, "--backend", "gymnasium-async", "--num-envs", "2", "--run", tmp_path / "r"]
    process = command("train", "a2c", "--env", "broken:Broken", *given)
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
