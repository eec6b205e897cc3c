"""Two processes that want one directory: one has it whole, and the other has changed no byte of it."""

import random
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from faults.runs import TRAIN, often
from forks import command
from lemniscate.run import checkpoint
from lemniscate.run.directory import read_config
from run.test_run import final_hashes, history

SWEEP = [*TRAIN[:2], "--seeds", "1", *TRAIN[2:]]
REFUSED = ("exists already", "is being trained by another process")
each_number = pytest.mark.parametrize("times", [pytest.param(often(50), marks=pytest.mark.faults), 1])


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


@pytest.mark.faults
@pytest.mark.parametrize("times", [often(10)])
def test_of_two_sweeps_in_a_new_directory_one_is_refused(whole, tmp_path, times):
    rng = random.Random(3)
    for number in range(times):
        path = tmp_path / str(number)
        answers = race(rng, [*SWEEP, path], [*SWEEP, path])
        assert sorted(code for code, _ in answers) == [0, 2], answers
        assert final_hashes(path / "ppo-1")["tensors.safetensors"] == final_hashes(whole / "1")["tensors.safetensors"]
    print(f"{times} directories wanted by two sweeps, each trained by one")


PROJECT = {
    "requirements.lock": "",
    "pyproject.toml": """
[build-system]
requires = []
build-backend = "slow"
backend-path = ["."]

[project]
name = "lemniscate"
version = "1"
""",
    "slow.py": """
import time
from pathlib import Path
from pathlib import Path
from zipfile import ZipFile

def build_editable(folder, config_settings=None, metadata_directory=None):
    with Path("installed").open("a") as file:
        file.write("begun ")
        file.flush()
        time.sleep(1)
        file.write("ended ")
    name = "lemniscate-1-py3-none-any.whl"
    with ZipFile(Path(folder, name), "w") as wheel:
        wheel.writestr("lemniscate-1.dist-info/METADATA", "Metadata-Version: 2.1\\nName: lemniscate\\nVersion: 1\\n")
        wheel.writestr("lemniscate-1.dist-info/WHEEL", "Wheel-Version: 1.0\\nGenerator: slow\\nTag: py3-none-any\\n")
        wheel.writestr("lemniscate-1.dist-info/RECORD", "")
    return name
""",
}


@pytest.mark.faults
def test_of_two_installations_at_once_one_is_done_and_the_other_waits_for_it(tmp_path):
    shutil.copy(Path(__file__).parents[2] / "Makefile", tmp_path)
    for name, content in PROJECT.items():
        (tmp_path / name).write_text(content)
    rng, times = random.Random(4), 3
    for _ in range(times):
        (tmp_path / "requirements.lock").touch()
        (tmp_path / "installed").unlink(missing_ok=True)
        started = []
        for _ in range(2):
            started.append(
                subprocess.Popen(["make", "setup"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
            )
            time.sleep(rng.uniform(0, 1))
        for process in started:
            said, _ = process.communicate()
            assert process.returncode == 0, said
        assert (tmp_path / "installed").read_text() == "begun ended "
    print(f"make setup {times} times twice at once: {times} installations")
