"""Readers beside a writer, directories that go away or cannot be written: a sentence at most."""

import errno
import shutil

import pytest

import lemniscate as lem
from faults.disk import fresh
from faults.runs import TRAIN, often, trials
from forks import command
from lemniscate.errors import UserError
from lemniscate.run import checkpoint
from lemniscate.run.metrics import read_metrics
from run.test_run import final_hashes, long_run, wait_for


@pytest.mark.parametrize("times", [pytest.param(often(2000), marks=pytest.mark.faults), 30])
def test_a_run_can_be_read_at_any_time_while_it_is_trained(tmp_path, capsys, times):
    """Each checkpoint replaces the one before, after each update."""
    path = tmp_path / "r"
    words = long_run(path, "Countdown-v0", updates=100_000)
    process = command(*words, "--keep-checkpoints", "1", "--checkpoint-every", "32")
    try:
        wait_for(lambda: checkpoint.list_steps(path / "checkpoints"), process)
        said, last = [], 0
        for number in range(times):
            try:
                last = max(last, lem.load(path).step)
            except UserError as error:  # the checkpoint was replaced between two looks
                said.append(str(error))
            assert read_metrics(path)
            if number % 100 == 7:
                assert lem.plot(path)
        assert process.poll() is None
    finally:
        process.kill()
    capsys.readouterr()
    print(f"{times} readings beside a writer, {len(said)} of them between two checkpoints, 0 tracebacks")
    assert last > 0
    assert all("no checkpoint that can be read" in sentence for sentence in said)
    assert len(said) <= times / 1000


@pytest.mark.parametrize("times", [pytest.param(often(20), marks=pytest.mark.faults), 1])
@pytest.mark.long
def test_a_directory_that_is_deleted_in_training_ends_in_a_sentence(tmp_path, times):
    for number in range(times):
        path = tmp_path / str(number)
        process = command(*long_run(path, "Countdown-v0", updates=200))
        wait_for(lambda: len(read_metrics(path)) > 3 * number, process)  # noqa: B023
        shutil.rmtree(path, ignore_errors=True)
        said = process.communicate()[1]
        assert "Traceback" not in said
        assert process.returncode in (0, 1), said
        assert process.returncode == 1 or (path / "checkpoints").exists(), said


@pytest.mark.parametrize("verb", ["resume", "plot", "evaluate"])
@pytest.mark.one_in(3)
def test_a_disk_that_can_only_be_read_is_named(trials, tmp_path, verb):
    path = fresh(tmp_path / "disk") / "r"
    code, said = trials.run("", *TRAIN, path)
    assert code == 0, said
    whole = final_hashes(path)
    code, said = trials.run(tmp_path / "disk", verb, path, fail=(1, 10**9, errno.EROFS))
    assert "Traceback" not in said
    assert code == 0 or "Read-only file system" in said, said
    assert final_hashes(path) == whole
    assert not list(path.rglob("*.tmp"))
