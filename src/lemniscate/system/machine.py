"""The free memory of this machine, its processors, and the files that may still be opened."""

import ctypes
import os
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from lemniscate.errors import UserError

CGROUPS = Path("/sys/fs/cgroup")
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""of glibc's mallopt(3)"""


def version() -> str:
    """The version of lemniscate that is installed."""
    return metadata.version("lemniscate")


def keep_freed_memory() -> None:
    """Let the C library keep the memory of freed tensors for the next ones, up to 1 GB.

    It would give large ones back, and each new one begins with page faults: a gradient step on 6,144 rows takes 1.3
    times as long. Other C libraries than glibc are left as they are.
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "gnu_get_libc_version"):
        for threshold in (M_TRIM_THRESHOLD, M_MMAP_THRESHOLD):
            libc.mallopt(threshold, 1 << 30)


def require_free(what: str, parts: Mapping[str, int], fields: Mapping[str, Any], device: torch.device | None) -> None:
    """Raise `UserError` where something takes more memory than is free, with the field that takes most, and its limit.

    `what` begins the sentence, such as "This run takes at least"; `parts` are the bytes that grow with each field,
    `fields` their values. The memory is the device's, or this process's if that is None.
    """
    total, free, most = sum(parts.values()), free_memory(device), max(parts, key=lambda name: parts[name])
    if total <= free:
        return
    value = fields[most]
    limit = (free - total + parts[most]) * value // parts[most] if isinstance(value, int) else 0
    advice = f"choose {most} at most {limit:,}" if limit > 0 else f"choose a smaller {most}"
    needed, there = f"{total // 10**6:,}", f"{free // 10**6:,}"
    if len(parts) == 1:
        raise UserError(f"{what} {needed} MB; {there} MB are free: {advice}.")
    share = f"{parts[most] // 10**6:,}"
    raise UserError(f"{what} {needed} MB, of which {share} MB are for {most} {value}; {there} MB are free: {advice}.")


def require_files(what: str, count: int, each: int) -> None:
    """Raise `UserError` where `count` environments need more open files, `each` so many, than the process may have."""
    most = _limit("RLIMIT_NOFILE")
    if count * each > most:
        needed = f"need {count * each:,} open files, and this process may have {most:,} (`ulimit -n`)"
        raise UserError(f"{what} {needed}: choose num_envs at most {most // each:,}.")


def require_linux(what: str, instead: str) -> None:
    """Raise `UserError` on another system, where the processes of `what` could not be ended together."""
    if sys.platform != "linux":
        raise UserError(f"{what} needs Linux, as under WSL or in the Dockerfile's image; here: {instead}.")


def free_memory(device: torch.device | None = None) -> int:
    """Bytes that this process can still take: of the GPU; else of the machine, its container and its own limit."""
    if device and device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    try:
        import psutil
    except ImportError:  # it needs modules of the platform; where they are missing, no memory is known to be short
        return sys.maxsize
    own = _limit("RLIMIT_AS") - psutil.Process().memory_info().vms
    return max(0, min(psutil.virtual_memory().available, own, *_left_in_cgroups()))


def cores() -> int:
    """The processors that this process may use; the processes of one run on this machine share them."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, there // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))


def _limit(name: str) -> int:
    """The most of a resource that this process may have (`ulimit`)."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return sys.maxsize
    most, _ = resource.getrlimit(getattr(resource, name))
    return sys.maxsize if most == resource.RLIM_INFINITY else most


def _left_in_cgroups() -> list[int]:
    """Bytes left below the limit of each control group that this process is in (Docker, Slurm, systemd)."""
    left = []
    for group in _groups():
        for limit, used in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
            try:
                most = int((group / limit).read_text())
                cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
                # Files that are cached but not in use count as used there, and are dropped where memory is asked for.
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
