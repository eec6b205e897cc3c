"""Two processes that want one directory: one has it whole, and the other has changed no byte of it."""

import random
import shutil
import time

import pytest

from faults.runs import TRAIN
from forks import command
from lemniscate.run import checkpoint
from lemniscate.run.directory import read_config
from run.test_run import final_hashes, history

SWEEP = [*TRAIN[:2], "--seeds", "1", *TRAIN[2:]]
REFUSED = ("exists already", "is being trained by another process")
each_number = pytest.mark.parametrize("times", [pytest.param(50, marks=pytest.mark.faults), 2])


def outcome(path):
    """All of a run that must be its own."""
    return final_hashes(path), history(path), read_config(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """For each seed, a run that had its directory for itself."""
    folder = tmp_path_factory.mktemp("whole")
    for seed in (1, 2):
        assert command(*TRAIN, folder / str(seed), "--seed", seed).wait() == 0
    return folder


def race(rng, *commands):
    """Start the commands within a twentieth of a second; (exit code, what it said) of each."""
    started = []
    for words in commands:
        started.append(command(*words))
        time.sleep(rng.uniform(0, 0.05))
    said = [process.communicate()[1] for process in started]
    assert not any("Traceback" in text for text in said), said
    return [(process.returncode, text) for process, text in zip(started, said, strict=True)]


@each_number
def test_of_two_that_train_in_a_new_directory_one_is_refused(whole, tmp_path, times):
    rng = random.Random(1)
    for number in range(times):
        path = tmp_path / str(number)
        answers = race(rng, *([*TRAIN, path, "--seed", seed] for seed in (1, 2)))
        assert sorted(code for code, _ in answers) == [0, 2], answers
        seed = 1 + [code for code, _ in answers].index(0)
        assert any(reason in answers[2 - seed][1] for reason in REFUSED), answers
        assert outcome(path) == outcome(whole / str(seed))
    print(f"{times} directories wanted by two, each trained by one")


@each_number
def test_of_two_that_resume_a_run_one_is_refused_or_finds_nothing_to_do(whole, tmp_path, times):
    rng = random.Random(2)
    for number in range(times):
        path = shutil.copytree(whole / "1", tmp_path / str(number))
        for step in checkpoint.list_steps(path / "checkpoints")[1:]:
            shutil.rmtree(path / "checkpoints" / f"step-{step}")
        answers = race(rng, ["resume", path], ["resume", path])
        assert 0 in [code for code, _ in answers], answers
        assert all(code == 0 or REFUSED[1] in said for code, said in answers), answers
        assert outcome(path) == outcome(whole / "1")
    print(f"{times} runs resumed twice at once, 0 differ")


@pytest.mark.parametrize("times", [pytest.param(10, marks=pytest.mark.faults), 1])
def test_of_two_sweeps_in_a_new_directory_one_is_refused(whole, tmp_path, times):
    rng = random.Random(3)
    for number in range(times):
        path = tmp_path / str(number)
        answers = race(rng, [*SWEEP, path], [*SWEEP, path])
        assert sorted(code for code, _ in answers) == [0, 2], answers
        assert final_hashes(path / "ppo-1")["tensors.safetensors"] == final_hashes(whole / "1")["tensors.safetensors"]
    print(f"{times} directories wanted by two sweeps, each trained by one")
