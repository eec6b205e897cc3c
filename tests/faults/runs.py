"""A small run, the processes that train it on a disk that is watched, and how often things are broken."""

import os

import pytest

from conftest import tiny_fields
from faults.disk import Trials
from run.test_run import words_for

CHOSEN = ("num_envs", "num_steps", "epochs", "minibatch_size", "hidden", "total_steps", "checkpoint_every", "compile")
FIELDS = {**tiny_fields(), "total_steps": 24 * 32, "checkpoint_every": 6 * 32, "compile": "off", "hidden": (8,)}
WORDS = [word for name, value in FIELDS.items() if name in CHOSEN for word in words_for(name, value)]
TRAIN = ["train", "ppo", "--env", "toy:Countdown-v0", *WORDS, "--run"]
"""24 updates, a checkpoint at each sixth, 3 kept"""


SHARE = float(os.environ.get("FAULTS_SHARE", 0.4))
"""of the tries in docs/guarantees.md, those that `make test-faults` makes, in half an hour on two cores; 1 makes all"""


def often(times):
    """How many of so many tries are made."""
    return max(1, round(SHARE * times))


@pytest.fixture(scope="session")
def trials():
    started = Trials()
    yield started
    started.close()


@pytest.fixture(scope="session")
def recorded(trials, tmp_path_factory):
    """(the directory of the run that nothing happened to, the log of its events)."""
    root, log = tmp_path_factory.mktemp("recorded"), tmp_path_factory.mktemp("log") / "events"
    code, said = trials.run(root, *TRAIN, root / "r", log=log)
    assert code == 0, said
    return root / "r", log
