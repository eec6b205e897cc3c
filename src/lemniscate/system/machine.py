"""The free memory of this machine, and the files that may still be opened."""

import os
import resource
import sys
from pathlib import Path

import psutil
import torch

CGROUPS = Path("/sys/fs/cgroup")


def free_memory(device: torch.device | None = None) -> int:
    """Bytes that this process can still take: of the GPU; else of the machine, its container and its own limit."""
    if device and device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    own = _limit(resource.RLIMIT_AS) - psutil.Process().memory_info().vms
    return max(0, min(psutil.virtual_memory().available, own, *_left_in_cgroups()))


def cores() -> int:
    """The processors that this process may use; those of one run on this machine share them."""
    return max(1, len(os.sched_getaffinity(0)) // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))


def most_open_files() -> int:
    """The open files that this process may have."""
    return _limit(resource.RLIMIT_NOFILE)


def _limit(kind: int) -> int:
    """The most of a resource that this process may have (`ulimit`)."""
    most, _ = resource.getrlimit(kind)
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
