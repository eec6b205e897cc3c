"""The cluster that a user names, the connection to it, and the run directories that are sent there and back."""

# pyright: reportMissingImports=false
# Ray is an extra that no check of types needs.

import io
import logging
import os
import socket
import sys
import tarfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from shutil import copytree
from tempfile import TemporaryDirectory
from typing import Annotated, Any
from urllib.parse import urlsplit

from lemniscate.errors import UserError, is_installed, missing_extra, shown
from lemniscate.run.config import Range, checked
from lemniscate.run.directory import BEST, CONFIG, LOCK
from lemniscate.system.files import at_home, make_directory, remove
from lemniscate.system.machine import require_linux

Workers = Annotated[int, Range(1, 4096)]
STORAGE = "ray"
"""the folder of a run directory that has Ray's storage, where no other is named"""
ITS_OWN = (LOCK, STORAGE)
"""what stays on its own machine, and is never sent"""
LEFT = (*ITS_OWN, "plots", "videos")
"""what is not sent before the end"""


@dataclass(frozen=True)
class Cluster:
    """The cluster of the processes: `ray` is this machine, or RAY_ADDRESS; `ray=ADDRESS` another.

    Args:
        address: None for this machine, or for RAY_ADDRESS.
        workers: number of processes; None for one of a run, or as many runs of a set as there are cores.
        storage: a folder that all machines reach, or the address of one in a cloud; None: in the run directory.
    """

    address: str | None
    workers: int | None
    storage: str | None


def find_cluster(cluster: object, workers: object = None, storage: object = None) -> Cluster | None:
    """The cluster that a user names as `ray` or `ray=ADDRESS`; None if nothing is named.

    Raises `UserError` for another name, or a number that is none; without Ray; where nobody listens at the address.
    """
    if cluster is None:
        for name, verb, value in (("workers", "are", workers), ("storage", "is", storage)):
            if value is not None:
                raise UserError(f"{name} {verb} of a cluster: add --cluster ray; on this machine, --processes.")
        return None
    kind, _, address = cluster.partition("=") if isinstance(cluster, str) else ("", "", "")
    if kind != "ray":
        raise UserError(f"cluster must be ray or ray=ADDRESS, not {shown(cluster)}.")
    most = None if workers is None else checked("workers", workers, Workers)
    require_linux("Training on Ray", "one process, with --threads")
    if not is_installed("ray"):
        raise missing_extra("ray", "ray")
    _require_answer(address or os.environ.get("RAY_ADDRESS", ""))
    place = None if storage is None else str(storage)
    if place and "://" not in place:  # a folder: Ray takes no relative one
        place = str(at_home(place).absolute())
    return Cluster(address or None, most, place)


@contextmanager
def connected(cluster: Cluster) -> Iterator[None]:
    """Ray, started on this machine unless there is one to connect to; it says nothing by itself.

    Raises `UserError` if no cluster answers at the address.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray

    if ray.is_initialized():
        yield
        return
    options: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    if cluster.address is None and "RAY_ADDRESS" not in os.environ:
        modules = os.pathsep.join([str(Path.cwd()), *filter(None, sys.path)])
        options |= {"num_cpus": max(cluster.workers or 1, os.cpu_count() or 1), "include_dashboard": False}
        options["runtime_env"] = {"env_vars": {"PYTHONPATH": modules}}
    disabled = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        ray.init(cluster.address, **options)
    except (ConnectionError, RuntimeError, ValueError) as error:
        logging.disable(disabled)
        raise _no_answer(cluster.address or os.environ.get("RAY_ADDRESS", "this machine"), error) from None
    try:
        yield
    finally:
        ray.shutdown()
        logging.disable(disabled)


def _require_answer(address: str) -> None:
    """Raise `UserError` at once where Ray would try for minutes: at a HOST:PORT that nobody listens at."""
    try:
        place = urlsplit(address if "://" in address else f"//{address}")
        if place.hostname and place.port:
            socket.create_connection((place.hostname, place.port), timeout=10).close()
    except (OSError, ValueError) as error:
        raise _no_answer(address, error) from None


def _no_answer(address: str, error: Exception) -> UserError:
    return UserError(f"No Ray cluster answers at {address}: {str(error).partition(chr(10))[0]}")


def pack(path: Path, left: Collection[str] = LEFT) -> bytes:
    """A run directory, which another process may be writing to: its checkpoints first, then all that is after them.

    What has a name in `left` at its root is not sent.
    """
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        # Not by rglob, which fails at a folder that is renamed meanwhile.
        files = [Path(folder) / name for folder, _, names in os.walk(path) for name in names]
        for file in sorted(files, key=lambda file: "checkpoints" not in file.parts):
            own = file.relative_to(path)
            if own.parts[0] not in left and not any(part.endswith(".tmp") for part in own.parts):
                with suppress(FileNotFoundError):  # the process deletes what it needs no longer
                    archive.add(file, str(own), recursive=False)
    return packed.getvalue()


def unpack(packed: bytes, path: Path) -> None:
    """Make a run directory what was packed; its config stays if it has one.

    A checkpoint comes whole or not at all, and after the metrics up to it; those that were deleted are deleted last.
    """
    make_directory(path)
    with TemporaryDirectory(dir=path, prefix=".incoming-") as folder:
        new = Path(folder)
        with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
            archive.extractall(new, filter="data")
        for file in new.iterdir():
            if file.is_file() and not (file.name == CONFIG and (path / CONFIG).exists()):
                file.replace(path / file.name)
        for name in ("plots", "videos"):
            if (new / name).exists():
                copytree(new / name, path / name, dirs_exist_ok=True)
        ours, theirs = path / "checkpoints", new / "checkpoints"
        if not theirs.exists():
            return
        make_directory(ours)
        sent = {checkpoint.name for checkpoint in theirs.iterdir()}
        for name in sent - {checkpoint.name for checkpoint in ours.iterdir() if checkpoint.name != BEST}:
            remove(ours / name)
            (theirs / name).rename(ours / name)
        for checkpoint in ours.iterdir():
            if checkpoint.name not in sent:
                remove(checkpoint)
