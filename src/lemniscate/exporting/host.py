"""The exported C on this machine, as a shared library."""

import ctypes
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from lemniscate.errors import UserError
from lemniscate.exporting.c_files import TEMPLATES

FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror")
POINTER = ctypes.c_void_p


def host_compiler() -> str | None:
    """The C compiler of this machine: that of CC, or the first that there is."""
    names = [*filter(None, [os.environ.get("CC")]), "cc", "gcc", "clang"]
    return next(filter(None, map(shutil.which, names)), None)


class HostPolicy:
    """`policy.c`, compiled and loaded.

    Args:
        files: the texts of `policy.c` and `policy.h`.
        compiler: the C compiler.
        flags: besides those that ask for warnings, as errors.

    Raises:
        UserError: the compiler refuses.
    """

    def __init__(self, files: Mapping[str, str], compiler: str, flags: tuple[str, ...] = ("-O2",)) -> None:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for file, text in {**files, "rows.c": (TEMPLATES / "rows.c").read_text()}.items():
                (folder / file).write_text(text)
            command = [compiler, *FLAGS, *flags, "-fPIC", "-shared", "-o", "policy.so", "policy.c", "rows.c"]
            run_tool(command, folder)
            self._library = ctypes.CDLL(str(folder / "policy.so"))
        self._library.policy_self_test.restype = ctypes.c_float
        header = dict(
            line.split()[1:3]
            for line in files["policy.h"].splitlines()
            if line.startswith("#define POLICY_") and len(line.split()) > 2
        )
        self.actions = int(header["POLICY_ACTIONS"])
        """A"""

    def act(self, obs: np.ndarray) -> np.ndarray:
        """The actions [R, A] at raw observations [R, O] float32."""
        obs = np.ascontiguousarray(obs, dtype=np.float32)
        action = np.empty((len(obs), self.actions), dtype=np.float32)
        self.flags = self._library.policy_act_rows(
            obs.ctypes.data_as(POINTER), action.ctypes.data_as(POINTER), len(obs)
        )
        return action

    def self_test(self) -> float:
        """The largest difference at the stored observations."""
        return float(self._library.policy_self_test())


def run_tool(command: list[str], folder: Path, seconds: float = 120) -> str:
    """Standard output of a compiler or an emulator. Raises `UserError` with its first complaint where it fails."""
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=seconds, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UserError(f"{Path(command[0]).name} did not run: {str(error).partition(chr(10))[0]}.") from None
    if done.returncode:
        said = (done.stderr or done.stdout or "nothing was said").strip().splitlines()
        first = next((line for line in said if "error:" in line), said[0] if said else "")
        raise UserError(f"{Path(command[0]).name} failed: {first}")
    return done.stdout


def nanoseconds(call: Callable[[], object], seconds: float = 0.2) -> float:
    """The time of one call: the least of several rounds."""
    call()
    best, end = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < end:
        begun = time.perf_counter_ns()
        call()
        best = min(best, time.perf_counter_ns() - begun)
    return best
