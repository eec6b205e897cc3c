"""What this machine still has: memory, and processors."""

import os
import resource
import sys
from pathlib import Path

import psutil
import torch

from lemniscate.errors import UserError

CGROUPS = Path("/sys/fs/cgroup")
FEWEST_MOST_THREADS = 64
"""threads that every machine may be asked for, so that a run of a larger one can be resumed"""


def free_memory(device: torch.device) -> int:
    """Bytes that this process can still take: of the GPU; else of the machine, its container and its own limit."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return max(0, min([psutil.virtual_memory().available, *_left_in_cgroups(), *_left_of_own_limit()]))


def require_threads(threads: int) -> None:
    """Raise `UserError` for more threads than this machine could ever use."""
    cores = os.cpu_count() or 1
    most = max(FEWEST_MOST_THREADS, 4 * cores)
    if threads > most:
        raise UserError(f"threads is {threads:,}, and this machine has {cores:,} processors: choose at most {most:,}.")


def most_open_files() -> int:
    """The open files that this process may have."""
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return sys.maxsize if most == resource.RLIM_INFINITY else most


def _left_in_cgroups() -> list[int]:
    """Bytes left below the limit of each control group that this process is in (Docker, Slurm, systemd)."""
    left = []
    for group in _groups():
        for limit, used in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
            try:
                most = int((group / limit).read_text())
                cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
                left.append(most - int((group / used).read_text()) + int(cached.get("inactive_file", 0)))
            except (OSError, ValueError):  # there is no such group, or it has no limit
                continue
    return left


def _groups() -> list[Path]:
    """The folders of the control groups of this process and of those above them, versions 2 and 1."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []
    groups = []
    for number, controllers, path in (line.split(":", 2) for line in lines):
        if number == "0" or "memory" in controllers.split(","):
            root = CGROUPS if number == "0" else CGROUPS / "memory"
            own = root / path.lstrip("/")
            groups += [own, *(parent for parent in own.parents if parent.is_relative_to(root))]
    return groups


def _left_of_own_limit() -> list[int]:
    """Bytes of address space left, where there is a limit (`ulimit -v`)."""
    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    return [] if most == resource.RLIM_INFINITY else [most - psutil.Process().memory_info().vms]
