"""What a machine has left: the least of its own memory, its container's, and the limit of the process."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import lemniscate as lem
from forks import forks
from lemniscate.errors import UserError
from lemniscate.system import files, machine, watchdog

CPU = torch.device("cpu")


@pytest.mark.skipif(not Path("/proc/self/cgroup").exists(), reason="control groups are Linux's")
@pytest.mark.parametrize(
    ("folder", "limit", "used"),
    [(".", "memory.max", "memory.current"), ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes")],
)
def test_the_limit_of_a_container_counts(tmp_path, monkeypatch, folder, limit, used):
    lines = Path("/proc/self/cgroup").read_text().splitlines()
    if not any(line.startswith("0:") if folder == "." else "memory" in line.split(":")[1] for line in lines):
        pytest.skip("this system has the other version")
    monkeypatch.setattr(machine, "CGROUPS", tmp_path)
    (tmp_path / folder).mkdir(exist_ok=True)
    for name, text in ((limit, "900000000"), (used, "500000000"), ("memory.stat", "anon 1\ninactive_file 100000000")):
        (tmp_path / folder / name).write_text(f"{text}\n")
    assert machine.free_memory(CPU) == 500_000_000
    (tmp_path / folder / limit).write_text("max\n")
    assert machine.free_memory(CPU) > 500_000_000


LIMITED = """
import psutil, resource, torch
from lemniscate.system import machine
most = psutil.Process().memory_info().vms + 2 * 10**9
for limit in (most, most - 2 * 10**9):
    resource.setrlimit(resource.RLIMIT_AS, (limit, most))
    print(machine.free_memory(torch.device("cpu")))
"""


def test_the_limit_of_the_process_counts():
    said, errors = forks().start(LIMITED).communicate()
    assert not errors
    free, none = map(int, said.split())
    assert 10**9 < free <= 2 * 10**9
    assert none == 0


ELSEWHERE = """
import os, signal, sys, warnings
warnings.filterwarnings("error", category=EncodingWarning, module=r"lemniscate\\.")
for module in ("resource", "fcntl", "psutil", "termios", "tty", "pty", "pwd", "grp", "syslog"):
    sys.modules[module] = None  # as where there is none
for name in ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGKILL", "SIGIO", "SIGCHLD", "SIGQUIT", "SIGPIPE"):
    delattr(signal, name)
for name in ("pthread_kill", "alarm", "setitimer"):
    delattr(signal, name)
for name in ("fork", "getuid", "geteuid", "setsid", "killpg", "mkfifo", "O_ASYNC", "O_NONBLOCK", "O_NOFOLLOW"):
    delattr(os, name)
del os.sched_getaffinity
import lemniscate as lem
from lemniscate.cli import main

small = {"total_steps": 128, "num_envs": 2, "num_steps": 32, "minibatch_size": 32, "checkpoint_every": 64}
stop = lambda step, metrics, policy: True
run = lem.train("ppo", env="CartPole-v1", backend="gymnasium", run="r", callbacks=stop, progress=False, **small)
assert run.policy.step == 64
assert lem.resume("r", progress=False).policy.step == 128
commands = ("evaluate r --episodes 2 --video video.gif", "plot r", "export r", "check r", "train ppo --lr 1")
codes = [main(command.split()) for command in commands]
print(codes)
sys.exit(codes != [0, 0, 0, 0, 2])
"""


@pytest.mark.long
def test_without_the_modules_and_signals_of_unix_everything_works_but_processes(tmp_path):
    """As on Windows, with text files of another encoding unless one is named: train, resume, look, export, check."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-X", "warn_default_encoding", "-c", ELSEWHERE]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "r" / "export" / "policy.h").exists()


@pytest.mark.parametrize("given", [{"processes": 2}, {"cluster": "ray"}])
def test_what_needs_linux_says_so(given, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(UserError, match=r"needs Linux.*one process"):
        lem.train("ppo", env="CartPole-v1", run=tmp_path / "run", **given)
    assert not (tmp_path / "run").exists()


OWNED = """
import os, sys, time
sys.platform = "darwin"
os.environ["LEMNISCATE_OWNED"] = "/dev/stdin"
from lemniscate.system.watchdog import end_with_owner
assert end_with_owner()
print("watched", flush=True)
time.sleep(60)
"""


def test_a_run_ends_with_its_sweep_where_no_signal_comes_from_a_pipe():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", OWNED], env=environment, text=True, **pipes) as process:
        assert process.stdout.readline() == "watched\n"
        assert process.poll() is None
        process.stdin.close()
        assert process.wait(timeout=20) == 1


def test_where_windows_syncs_no_directory_files_are_written_all_the_same(tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr(files, "os", SimpleNamespace(**{**vars(os), "name": "nt"}))
    monkeypatch.setattr(files.os, "open", lambda path, *flags: opened.append(path) or os.open(path, *flags))
    files.make_directory(tmp_path / "r")
    files.write_json(tmp_path / "r" / "x.json", {"a": 1})
    files.sync(tmp_path / "r" / "x.json")
    assert opened == [tmp_path / "r" / "x.json"]  # to sync it, and no directory
    assert files.read_json(tmp_path / "r" / "x.json") == {"a": 1}


def test_what_takes_too_much_is_said_with_the_field_that_takes_most():
    one = {"num_envs": 10**18}
    with pytest.raises(UserError, match=r"^A take 1,000,000,000,000 MB; [\d,]+ MB are free: choose num_envs at"):
        machine.require_free("A take", one, {"num_envs": 10**9}, None)
    with pytest.raises(UserError, match=r"MB, of which 1,000,000,000,000 MB are for hidden \(7,\); .*a smaller hidden"):
        machine.require_free("A takes", {"num_envs": 1, "hidden": 10**18}, {"num_envs": 1, "hidden": (7,)}, CPU)
    with pytest.raises(UserError, match=r"^B need 3,000,000,000 open files, .* choose num_envs at most \d"):
        machine.require_files("B", 10**9, 3)
    machine.require_free("A takes", {"num_envs": 1}, {"num_envs": 1}, CPU)
    machine.require_files("B", 1, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="it is glibc that gives memory back")
def test_the_memory_of_freed_tensors_is_kept_for_the_next_ones():
    """Eight of 4 MB, twenty times: 160,000 pages where they are given back."""
    program = """
import resource, torch
from lemniscate.system.machine import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        [torch.ones(2**20) for _ in range(8)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

keep_freed_memory()
faults()
print(faults())
"""
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert int(said.stdout) < 1_000


@pytest.mark.parametrize("text", ["30s", "0", "-1", "nan", "inf", ""])
def test_a_patience_that_is_no_number_of_seconds_is_a_sentence(text, monkeypatch):
    monkeypatch.setenv(watchdog.PATIENCE, text)
    with pytest.raises(UserError, match=f"LEMNISCATE_PATIENCE must be a number of seconds above 0, not '{text}'"):
        watchdog.patience()
    monkeypatch.setenv(watchdog.PATIENCE, "0.5")
    assert watchdog.patience() == 0.5
