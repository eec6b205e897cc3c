"""What a machine has left: the least of its own memory, its container's, and the limit of the process."""

from pathlib import Path

import pytest
import torch

from forks import Forks
from lemniscate.system import machine

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
import resource
most = psutil.Process().memory_info().vms + 2 * 10**9
for limit in (most, most - 2 * 10**9):
    resource.setrlimit(resource.RLIMIT_AS, (limit, most))
    print(machine.free_memory(torch.device("cpu")))
"""


def test_the_limit_of_the_process_counts():
    forks = Forks("import psutil, torch; from lemniscate import machine")
    said, errors = forks.start(f"from __main__ import machine, psutil, torch\n{LIMITED}").communicate()
    forks.close()
    assert not errors
    free, none = map(int, said.split())
    assert 10**9 < free <= 2 * 10**9
    assert none == 0
