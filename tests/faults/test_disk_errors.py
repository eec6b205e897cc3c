"""Errors of the disk at any call: training goes on, says so, and exits with success only if its result is stored."""

import errno

import pytest

from faults.disk import fresh, read_log
from faults.runs import TRAIN, recorded, trials
from run.test_run import final_hashes, history

ERRORS = (errno.ENOSPC, errno.EIO, errno.EROFS, errno.EDQUOT)


def check_trial(trials, folder, whole, fail):
    """Train while the disk fails; then, on a disk that is well again, go on to the bits of the whole run."""
    code, said = trials.run(fresh(folder), *TRAIN, folder / "r", fail=fail)
    assert "Traceback" not in said, said
    assert code in (0, 1, 2), said
    if code == 0:
        assert not list(folder.rglob("*.tmp")), said
    else:
        assert said.strip(), fail
        again = ["resume"] if (folder / "r" / "config.json").exists() else TRAIN
        code, said = trials.run(folder, *again, folder / "r")
        assert code == 0, said
    assert final_hashes(folder / "r") == final_hashes(whole), said
    return said


def cases(count, first, every):
    """(first, last, errno): one event fails, or all from one on."""
    for number in range(first, count + 1, every):
        yield number, number, ERRORS[number % 4]
        yield number, 10**9, ERRORS[(number + 1) % 4]


def quarters(short):
    """(first, step) of a fourth of the calls each, for several processes; `short` of a few, for the short form."""
    whole = [pytest.param(first, 4, marks=pytest.mark.faults) for first in (1, 2, 3, 4)]
    return pytest.mark.parametrize(("first", "every"), [*whole, short])


@quarters(short=(31, 83))
def test_an_error_of_the_disk_costs_a_checkpoint_at_most(recorded, trials, tmp_path, first, every):
    whole, log = recorded
    count = len(read_log(log))
    tried = [check_trial(trials, tmp_path / "disk", whole, fail) for fail in cases(count, first, every)]
    print(f"{len(tried)} disks that failed, 0 tracebacks, 0 results lost")


@quarters(short=(47, 83))
def test_killed_before_any_call_it_goes_on_to_the_same_bits(recorded, trials, tmp_path, first, every):
    whole, log = recorded
    folder, killed = tmp_path / "disk", 0
    for number in range(first, len(read_log(log)) + 1, every):
        code, said = trials.run(fresh(folder), *TRAIN, folder / "r", kill=number)
        assert code == -9, said
        again = ["resume"] if (folder / "r" / "config.json").exists() else TRAIN
        code, said = trials.run(folder, *again, folder / "r")
        assert code == 0, said
        assert final_hashes(folder / "r") == final_hashes(whole)
        assert history(folder / "r") == history(whole)
        killed += 1
    print(f"killed before each of {killed} calls, 0 differ")
