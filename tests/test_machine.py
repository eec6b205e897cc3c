"""What a machine has left: the least of its own memory, its container's, and the limit of the process."""

import inspect
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from forks import forks
from lemniscate.errors import UserError
from lemniscate.system import files, machine

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


def without_unix():
    """Take away what Windows lacks: a module, and signals; psutil needs the module here, and has its own there."""
    sys.modules["resource"] = sys.modules["fcntl"] = sys.modules["psutil"] = None
    for name in ("SIGHUP", "SIGUSR1", "SIGUSR2"):
        delattr(signal, name)
    del os.sched_getaffinity


ON_WINDOWS = f"""
import os, signal, sys
{inspect.getsource(without_unix)}
without_unix()
import lemniscate as lem
small = dict(total_steps=64, num_envs=2, num_steps=16, minibatch_size=16, backend="gymnasium", progress=False)
run = lem.train("ppo", "CartPole-v1", run="r", **small)
print(len(lem.evaluate(run.policy, episodes=2).returns), lem.load("r").step)
"""


def test_without_what_windows_lacks_runs_are_trained_and_evaluated(tmp_path):
    done = subprocess.run([sys.executable, "-c", ON_WINDOWS], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == ["2", "64"], done.stderr


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
