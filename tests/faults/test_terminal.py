"""A terminal that is closed, and output that nobody reads: a run saves and ends, or goes on, as it was asked to."""

import fcntl
import os
import pty
import signal
import time

import pytest

from forks import command
from lemniscate.run import checkpoint
from lemniscate.run.metrics import read_metrics
from run.test_run import final_hashes, history, long_run, wait_for


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "r"
    assert command(*long_run(path, "Countdown-v0")).wait() == 0
    return path


def in_a_terminal(path, ignore_hang_up):
    """(process, file descriptor of its terminal): a run in a session whose terminal is a new one."""
    ours, theirs = pty.openpty()
    begin = f"""
import os, signal
terminal = os.open({os.ttyname(theirs)!r}, os.O_RDWR)
for number in (0, 1, 2):
    os.dup2(terminal, number)
signal.signal(signal.SIGHUP, signal.{"SIG_IGN" if ignore_hang_up else "SIG_DFL"})
"""
    process = command(*long_run(path, "Countdown-v0"), before=begin)
    wait_for((path / "checkpoints").exists, process)
    os.close(theirs)
    return process, ours


def reading(path, bytes_free, updates):
    """(process, what its standard error is read from): a pipe, in which there is room for so many bytes."""
    pipe = path.with_name("pipe")
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    writer = os.open(pipe, os.O_WRONLY)
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    os.write(writer, bytes(4096 - bytes_free))
    words = long_run(path, "Countdown-v0", updates)
    process = command(*words, before=f"import os; os.dup2(os.open({str(pipe)!r}, os.O_WRONLY), 2)")
    wait_for(path.exists, process)
    os.close(writer)
    return process, reader


@pytest.mark.parametrize("ignored", [False, pytest.param(True, marks=pytest.mark.faults)])
@pytest.mark.long
def test_when_the_terminal_is_closed_a_run_is_saved_and_with_nohup_it_goes_on(whole, tmp_path, ignored):
    path = tmp_path / "r"
    process, terminal = in_a_terminal(path, ignored)
    wait_for(lambda: len(read_metrics(path)) > 20, process)
    os.close(terminal)
    assert process.wait(timeout=60) == (0 if ignored else 128 + signal.SIGHUP)
    if not ignored:
        assert checkpoint.list_steps(path / "checkpoints")[-1] == read_metrics(path)[-1]["step"] < 150 * 32
        assert command("resume", path).wait() == 0
    assert final_hashes(path) == final_hashes(whole)
    assert history(path) == history(whole)


def is_still(path):
    """Whether a run that has begun writes no line of metrics for a tenth of a second."""
    count = len(read_metrics(path))
    time.sleep(0.1)
    return count and len(read_metrics(path)) == count


@pytest.mark.long
def test_output_that_nobody_reads_any_more_costs_no_step(tmp_path):
    path = tmp_path / "r"
    process, reader = reading(path, 4000, updates=150)
    os.close(reader)
    assert process.wait() == 0
    assert checkpoint.list_steps(path / "checkpoints")[-1] == 150 * 32


@pytest.mark.faults
def test_a_pipe_that_is_full_does_not_keep_a_run_from_stopping(tmp_path):
    path = tmp_path / "r"
    process, reader = reading(path, 300, updates=1000)
    wait_for(lambda: is_still(path), process)
    asked = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=30) == 130
    assert time.monotonic() - asked < 6
    os.close(reader)
