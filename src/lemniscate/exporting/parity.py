"""`parity.json`: how far the exported policies are from the policy itself, and what they cost."""

import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lemniscate.errors import UserError, is_installed, missing_extra
from lemniscate.exporting import target
from lemniscate.exporting.actions import Act, as_rows
from lemniscate.exporting.host import HostPolicy, nanoseconds
from lemniscate.exporting.operations import Program

TOLERANCE = 1e-5
"""of an action; that of bfloat16 is one in its last place, where another order of sums rounds it the other way"""
BFLOAT16_TOLERANCE = 0.05


def onnx_act(model: bytes) -> tuple[Act, str]:
    """The policy in onnxruntime, on one thread, and its version."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    return lambda obs: as_rows(np.asarray(session.run(None, {"obs": obs})[0])), onnxruntime.__version__


def missing_onnx() -> list[str]:
    """The sentences for what ONNX needs and is not installed."""
    left_out = {"onnx": "policy.onnx is left out", "onnxruntime": "policy.onnx is not compared"}
    return [f"{missing_extra(name, 'export')}; {what}." for name, what in left_out.items() if not is_installed(name)]


def compare(actions: np.ndarray, true: np.ndarray, tolerance: float) -> dict[str, Any]:
    """The difference of actions [R, A] from the true ones: the largest, also in last places of the largest action."""
    difference = np.abs(actions.astype(np.float64) - true)
    largest = float(difference.max())
    return {
        "observations": len(actions),
        "max_abs_difference": largest,
        "max_ulp": largest / float(np.spacing(np.float32(np.abs(true).max()))),
        "above_tolerance": int((difference.max(1) > tolerance).sum()),
    }


def parity(
    program: Program,
    act: Act,
    obs: np.ndarray,
    files: Mapping[str, str],
    model: bytes | None,
    host: HostPolicy | None,
    compiler: str | None,
) -> tuple[dict[str, Any], list[str]]:
    """The record, and a sentence for everything that could not be compared.

    Args:
        program: the policy.
        act: the policy itself, in torch.
        obs: at which all are compared, [R, O].
        files: the texts of `policy.c` and `policy.h`.
        model: `policy.onnx`.
        host: `policy.c` on this machine.
        compiler: that of this machine.
    """
    true, tolerance = act(obs), BFLOAT16_TOLERANCE if program.is_rounded else TOLERANCE
    costs: dict[str, float | None] = {"c": None, "onnxruntime": None, "torch": nanoseconds(lambda: act(obs[:1]))}
    record: dict[str, Any] = {"observations": len(obs), "tolerance": tolerance, "onnx": None, "c_host": None}
    missing = missing_onnx()
    if model is not None and is_installed("onnxruntime"):
        run, version = onnx_act(model)
        record["onnx"] = {**compare(run(obs), true, tolerance), "onnxruntime": version}
        costs["onnxruntime"] = nanoseconds(lambda: run(obs[:1]))
    if host is None:
        missing.append("There is no C compiler here (cc, gcc, clang or CC): policy.c is not compared on this machine.")
    else:
        compared = compare(host.act(obs), true, tolerance)
        record["c_host"] = {**compared, "self_test": host.self_test(), "compiler": Path(compiler or "").name}
        costs["c"] = nanoseconds(lambda: host.act(obs)) / len(obs)
    record["c_cortex_m4f"], said = on_target(program, files, obs, true, tolerance)
    record["multiplications"] = program.multiplications
    record["ns_per_action"] = {name: cost and round(cost) for name, cost in costs.items()}
    record["ns_are"] = "C in a loop in C, the others called from Python with one observation, all on one core"
    return {**record, "machine": platform.machine(), "missing": missing + said}, missing + said


def on_target(
    program: Program, files: Mapping[str, str], obs: np.ndarray, true: np.ndarray, tolerance: float
) -> tuple[dict[str, Any] | None, list[str]]:
    """The figures of a Cortex-M4F, and a sentence for what is not there."""
    absent = target.missing_tools()
    if target.COMPILER in absent:
        return None, [
            f"{target.COMPILER} is not installed: nothing is known of the target (Debian: gcc-arm-none-eabi)."
        ]
    sizes = target.sizes(files)
    record: dict[str, Any] = {
        "flash_bytes": sizes.flash,
        "flash_bytes_with_self_test": sizes.flash + sizes.self_test,
        "ram_bytes": sizes.static + sizes.stack,
        "static_bytes": sizes.static,
        "stack_bytes": sizes.stack,
        "compiled_with": " ".join((target.COMPILER, *target.CORE)),
    }
    if absent:
        return record, [
            f"{target.EMULATOR} is not installed: policy.c is not run on the target (Debian: qemu-system-arm)."
        ]
    rows = min(len(obs), max(64, target.INSTRUCTIONS // (8 * program.multiplications + 10_000)))
    try:
        done = target.simulate(files, obs[:rows], true.shape[1])
    except UserError as error:
        return record, [f"policy.c is not run on the target: {error}"]
    compared = compare(done.actions, true[: len(done.actions)], tolerance)
    return {**record, **compared, "self_test": done.self_test, "instructions_per_call": done.instructions}, []


def sentences(record: Mapping[str, Any]) -> list[str]:
    """The record as sentences for a person."""
    names = {"onnx": "ONNX", "c_host": "C", "c_cortex_m4f": "C on the simulated Cortex-M4F"}
    compared = {name: record[key] for key, name in names.items() if (record[key] or {}).get("observations")}
    said = [_distance(name, each) for name, each in compared.items()]
    if sizes := record["c_cortex_m4f"]:
        counted = sizes.get("instructions_per_call")
        said.append(
            f"On a Cortex-M4F: {sizes['flash_bytes']:,} bytes of flash, {sizes['ram_bytes']:,} of RAM"
            + (f", {counted:,} instructions a call." if counted else ".")
        )
    for name, each in compared.items():
        if each["above_tolerance"]:
            said.append(f"{name} is beyond {record['tolerance']:g} at {each['above_tolerance']:,} of them.")
    return said


def _distance(name: str, compared: Mapping[str, Any]) -> str:
    largest, rows = compared["max_abs_difference"], f"at {compared['observations']:,} observations."
    return f"{name} differs from the policy by at most {largest:.1e} {rows}" if largest else f"{name} is exact {rows}"
