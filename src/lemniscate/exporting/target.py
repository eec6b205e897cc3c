"""The exported C on a Cortex-M4F: sizes from its compiler, actions and instructions from QEMU's simulation of one."""

import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lemniscate.exporting.c_files import TEMPLATES
from lemniscate.exporting.host import FLAGS, run_tool

COMPILER, EMULATOR = "arm-none-eabi-gcc", "qemu-system-arm"
CORE = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-Os")
SECTIONS = ("-ffunction-sections", "-fdata-sections", "-fstack-usage")
INSTRUCTIONS = 10**9
"""of a simulation, at most: it takes some ten seconds"""


@dataclass(frozen=True)
class Sizes:
    """Bytes on the target: flash of code, weights and the self-test; static memory, and the deepest stack."""

    flash: int
    self_test: int
    static: int
    stack: int


@dataclass(frozen=True)
class Simulated:
    """The results of the simulated core: actions [R, A] at R observations, the self-test, instructions per call."""

    actions: np.ndarray
    self_test: float
    instructions: int


def missing_tools() -> list[str]:
    """The names of those that are not installed."""
    return [name for name in (COMPILER, EMULATOR) if shutil.which(name) is None]


def sizes(files: Mapping[str, str]) -> Sizes:
    """The sizes of `policy.c`, from the sections of its object file and the stack of each function.

    The stack is that of `policy_act` and of all functions that it may call, added up.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, files)
        run_tool([COMPILER, *FLAGS, *CORE, *SECTIONS, "-c", "policy.c", "-o", "policy.o"], folder)
        listed = run_tool([COMPILER.replace("gcc", "size"), "-A", "policy.o"], folder)
        stacks = (folder / "policy.su").read_text()
    sections = {line.split()[0]: int(line.split()[1]) for line in listed.splitlines() if line.startswith(".")}
    flash = {name: size for name, size in sections.items() if re.match(r"\.(text|rodata|data)", name)}
    test = sum(size for name, size in flash.items() if "self_test" in name)
    static = sum(size for name, size in sections.items() if re.match(r"\.(data|bss)", name))
    used = {line.split()[0].rpartition(":")[2]: int(line.split()[1]) for line in stacks.splitlines()}
    stack = sum(size for name, size in used.items() if name != "policy_self_test")
    return Sizes(sum(flash.values()) - test, test, static, stack)


def simulate(files: Mapping[str, str], obs: np.ndarray, actions: int) -> Simulated:
    """Act at observations [R, O] on the simulated core. Raises `UserError` where compiler or emulator fails."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, files)
        for file in ("runner.c", "runner.ld"):
            shutil.copyfile(TEMPLATES / file, folder / file)
        linked = ["-nostartfiles", "--specs=nano.specs", "-T", "runner.ld", "-Wl,--no-warn-rwx-segments"]
        run_tool([COMPILER, *CORE, "-std=gnu99", *linked, "policy.c", "runner.c", "-o", "runner.elf"], folder)
        obs.astype("<f4").tofile(folder / "observations.bin")
        machine = ["-M", "mps2-an386", "-cpu", "cortex-m4", "-display", "none", "-serial", "none", "-monitor", "none"]
        clock = ["-icount", "shift=0", "-semihosting-config", "enable=on,target=native"]
        run_tool([EMULATOR, *machine, *clock, "-kernel", "runner.elf"], folder, seconds=300)
        done = np.fromfile(folder / "actions.bin", dtype="<f4").reshape(-1, actions)
        self_test, instructions = np.fromfile(folder / "figures.bin", dtype="<f4")
    return Simulated(done, float(self_test), round(float(instructions)))


def write(folder: Path, files: Mapping[str, str]) -> None:
    """Write texts by name."""
    for name, text in files.items():
        (folder / name).write_text(text)
