"""The exported C, compiled: on this machine as a shared library, and for a Cortex-M4F that QEMU simulates."""

import ctypes
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lemniscate.errors import UserError
from lemniscate.exporting.c_code import TEMPLATES

FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror")

TARGET_COMPILER, EMULATOR = "arm-none-eabi-gcc", "qemu-system-arm"
CORE = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-Os")
SECTIONS = ("-ffunction-sections", "-fdata-sections", "-fstack-usage")


def host_compiler() -> str | None:
    """The C compiler of this machine: that of the variable CC, or the first of cc, gcc and clang that is installed."""
    names = os.environ.get("CC") or "cc", "cc", "gcc", "clang"
    return next(filter(None, map(shutil.which, names)), None)


class HostPolicy:
    """`policy.c`, compiled and loaded on this machine.

    Args:
        files: the texts of `policy.c` and `policy.h`.
        compiler: the C compiler.
        flags: besides `FLAGS`, which ask for warnings as errors.

    Raises:
        UserError: the compiler refuses, or makes what cannot be loaded here.
    """

    def __init__(self, files: Mapping[str, str], compiler: str, flags: tuple[str, ...] = ("-O2",)) -> None:
        with _written(files, "rows.c") as folder:
            command = [compiler, *FLAGS, *flags, "-fPIC", "-shared", "-o", "policy.so", "policy.c", "rows.c"]
            run_tool(command, folder)
            try:
                self._library = ctypes.CDLL(str(folder / "policy.so"))
            except OSError as error:  # of another machine, or on a disk from which nothing may be executed
                raise UserError(f"What {Path(compiler).name} made cannot be loaded here: {error}.") from None
        self._library.policy_self_test.restype = ctypes.c_float
        sizes = re.findall(r"^#define POLICY_(?:ACTIONS|MEMORY) (\d+)$", files["policy.h"], re.MULTILINE)
        self.columns = sum(map(int, sizes))
        """A + K, of rows of actions"""
        self.compiler = Path(compiler).name

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Rows of actions [R, A + K] at raw observations [R, O + K]; `flags` counts those that are not finite."""
        obs = np.ascontiguousarray(obs, dtype=np.float32)
        action = np.empty((len(obs), self.columns), dtype=np.float32)
        self.flags = self._library.policy_act_rows(obs.ctypes, action.ctypes, len(obs))
        return action

    def self_test(self) -> float:
        """The largest difference at the stored observations."""
        return float(self._library.policy_self_test())


def run_tool(command: list[str], folder: Path, seconds: float = 120) -> str:
    """Standard output of a compiler or an emulator. Raises `UserError` with its first complaint where it fails."""
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, encoding="utf-8", errors="replace", timeout=seconds, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UserError(f"{Path(command[0]).name} did not run: {str(error).partition(chr(10))[0]}.") from None
    if done.returncode:
        said = (done.stderr or done.stdout or "nothing was said").strip().splitlines()
        first = next((line for line in said if "error:" in line), said[0] if said else "")
        raise UserError(f"{Path(command[0]).name} failed: {first}")
    return done.stdout


def missing_target_tools() -> list[str]:
    """The names of the tools for the Cortex-M4F that are not installed."""
    return [name for name in (TARGET_COMPILER, EMULATOR) if shutil.which(name) is None]


def target_sizes(files: Mapping[str, str]) -> dict[str, int]:
    """The bytes of `policy.c` on the target, as `parity.json` names them.

    They come from the sections of its object file and from the stack of each function; the stacks of `policy_act` and
    of all functions that it may call are added up.
    """
    with _written(files) as folder:
        run_tool([TARGET_COMPILER, *FLAGS, *CORE, *SECTIONS, "-c", "policy.c", "-o", "policy.o"], folder)
        listed = run_tool([TARGET_COMPILER.replace("gcc", "size"), "-A", "policy.o"], folder)
        stacks = (folder / "policy.su").read_text("utf-8")
    sections = {line.split()[0]: int(line.split()[1]) for line in listed.splitlines() if line.startswith(".")}
    flash = {name: size for name, size in sections.items() if re.match(r"\.(text|rodata|data)", name)}
    test = sum(size for name, size in flash.items() if "self_test" in name)
    static = sum(size for name, size in sections.items() if re.match(r"\.(data|bss)", name))
    used = {line.split()[0].rpartition(":")[2]: int(line.split()[1]) for line in stacks.splitlines()}
    stack = sum(size for name, size in used.items() if name != "policy_self_test")
    return {
        "flash_bytes": sum(flash.values()) - test,
        "flash_bytes_with_self_test": sum(flash.values()),
        "ram_bytes": static + stack,
        "static_bytes": static,
        "stack_bytes": stack,
    }


def simulate(files: Mapping[str, str], obs: np.ndarray, columns: int) -> tuple[np.ndarray, float, int]:
    """The simulated core's actions [R, A + K] at observations, its self-test, and the instructions of an action.

    Raises:
        UserError: compiler or emulator fails.
    """
    with _written(files, "runner.c", "runner.ld") as folder:
        linked = ["-nostartfiles", "--specs=nano.specs", "-T", "runner.ld"]
        run_tool([TARGET_COMPILER, *CORE, "-std=gnu99", *linked, "policy.c", "runner.c", "-o", "runner.elf"], folder)
        obs.astype("<f4").tofile(folder / "observations.bin")
        machine = ["-M", "mps2-an386", "-cpu", "cortex-m4", "-display", "none", "-serial", "none", "-monitor", "none"]
        clock = ["-icount", "shift=0", "-semihosting-config", "enable=on,target=native"]
        run_tool([EMULATOR, *machine, *clock, "-kernel", "runner.elf"], folder, seconds=300)
        done = np.fromfile(folder / "actions.bin", dtype="<f4").reshape(-1, columns)
        self_test, instructions = np.fromfile(folder / "figures.bin", dtype="<f4")
    return done, float(self_test), round(float(instructions))


@contextmanager
def _written(files: Mapping[str, str], *templates: str) -> Iterator[Path]:
    """A temporary directory with texts by name, and with templates that have nothing to be filled in."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        for file, text in {**files, **{file: (TEMPLATES / file).read_text("utf-8") for file in templates}}.items():
            (folder / file).write_text(text, "utf-8")
        yield folder
