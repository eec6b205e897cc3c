"""`export`: a policy as C99 and as ONNX, with what its numbers mean and how far the copies are from it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lemniscate.api.policy import Trained, TrainedPolicy, load, path_of
from lemniscate.envs.backend import Interface
from lemniscate.errors import UserError, is_installed
from lemniscate.exporting.c_code import c_files
from lemniscate.exporting.compiled import HostPolicy, host_compiler
from lemniscate.exporting.crazyflie import crazyflie_files
from lemniscate.exporting.deployed import Act, Deployed, act_with, input_size
from lemniscate.exporting.manifest import manifest, observed, title
from lemniscate.exporting.onnx_model import onnx_act, onnx_model
from lemniscate.exporting.operations import Program
from lemniscate.exporting.parity import fly, origin, parity, self_tests, sentences
from lemniscate.exporting.translation import translate
from lemniscate.hub.repository import is_address
from lemniscate.system.console import say
from lemniscate.system.files import DamagedFileError, make_directory, read_json, remove, replace_file, sync, write_json

MANIFEST, PARITY, ONNX = "manifest.json", "parity.json", "policy.onnx"
CRAZYFLIE = "crazyflie"


def export(run: Trained, to: str | Path | None = None, *, trust: bool = False) -> Path:
    """Write a policy as ONNX and as C99 for microcontrollers, from the raw observation to the action for `env.step`.

    These are `policy.onnx`, `policy.c` and `policy.h`; `manifest.json` says what every number means. The exported C
    acts in the environment of training, and at the observations there all copies are compared with the policy:
    `parity.json`. Tools that are not installed for that (a C compiler, onnxruntime, arm-none-eabi-gcc, QEMU) are named,
    and their part is left out. A policy that flies a Crazyflie also gets an application for its firmware, `crazyflie/`.

    Args:
        run: as in `load`.
        to: the new directory; by default `export` in that of the run. An export that is there is replaced.
        trust: as in `load`.

    Returns:
        The directory.

    Raises:
        UserError: a policy that looks at images; a network that cannot be translated; an environment that cannot be
            made; a directory that is no export, or that cannot be written. Nothing is left half-written.
    """
    policy = load(run, trust=trust)
    folder = _destination(run, policy, to)
    if policy.spec.image:
        raise UserError(f"A policy for {policy.spec.env_id} looks at images; what can be exported looks at vectors.")
    program = translate(Deployed(policy).eval(), input_size(policy.spec))
    contents, record, said = _contents(policy, program)
    try:
        _write(folder, contents, record)
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror or error}.") from error
    for sentence in said:
        say(sentence)
    return folder


def _destination(run: Trained, policy: TrainedPolicy, to: str | Path | None) -> Path:
    """The directory of the export. Raises `UserError` where something else is in its place."""
    if to is None and (policy.path is None or is_address(run)):
        raise UserError("This policy is of no run here: name the directory of its export, with --to or `to`.")
    folder = path_of(to) if to is not None else Path(policy.path or "") / "export"
    if folder.is_symlink() or (folder.exists() and not is_export(folder)):
        raise UserError(f"{folder} exists already, and is no export; choose another directory.")
    return folder


def is_export(folder: Path) -> bool:
    """Whether a directory is an export, or empty, and may be replaced by one."""
    try:
        return folder.is_dir() and (not any(folder.iterdir()) or "export" in read_json(folder / MANIFEST))
    except (DamagedFileError, OSError):
        return False


def _contents(policy: TrainedPolicy, program: Program) -> tuple[dict[str, bytes], dict[str, Any], list[str]]:
    """The content of every file but the manifest by its name, the manifest, and sentences for a person."""
    true, action, compiler = act_with(policy), policy.spec.action, host_compiler()
    facts = {"title": title(policy), "environment": policy.spec.env_id, "step": policy.step}
    model = onnx_model(program, facts) if is_installed("onnx") else None
    acting, act = _actor(policy, program, model, compiler)
    obs, interface = fly(policy, act)
    tests = self_tests(policy, obs)
    named = {"title": facts["title"], "origin": origin(policy, len(tests)), "period": interface.period}
    texts = c_files(program, action, tests, true(tests), **named)
    found = parity(program, true, obs, texts, model, HostPolicy(texts, compiler) if compiler else None)
    record = {"environment": policy.spec.env_id, "acting": acting, "reference": "torch", **found}
    vehicle, left_out = _vehicle_files(policy, interface, texts)
    contents: dict[str, bytes] = {} if model is None else {ONNX: model}
    contents |= {name: text.encode() for name, text in {**texts, **vehicle}.items()}
    contents[PARITY] = (json.dumps(record, indent=1, allow_nan=False) + "\n").encode()
    return contents, manifest(policy, program, interface, obs, contents), [*sentences(record), *left_out]


def _actor(policy: TrainedPolicy, program: Program, model: bytes | None, compiler: str | None) -> tuple[str, Act]:
    """The copy that acts here, by its name: the C code, or else ONNX, or else the policy itself."""
    if compiler:
        # what the self-test stores is seen on this flight, so the C that flies has an empty one
        untested = np.zeros((1, program.obs.size)), np.zeros((1, program.action.size))
        files = c_files(program, policy.spec.action, *untested, title="", origin="")
        return "policy.c", HostPolicy(files, compiler).act
    if model and is_installed("onnxruntime"):
        return ONNX, onnx_act(model)[0]
    return "the policy itself", act_with(policy)


def _vehicle_files(
    policy: TrainedPolicy, interface: Interface, texts: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """The files for the vehicle's firmware, and why there are none for a vehicle that could have some."""
    if interface.vehicle != CRAZYFLIE:
        return {}, []
    quantities = observed(policy.spec, interface)
    try:
        found = crazyflie_files(interface, quantities, policy.spec.action, texts, title(policy))
    except UserError as error:
        return {}, [f"{CRAZYFLIE}/ is left out: {error}."]
    return {f"{CRAZYFLIE}/{name}": text for name, text in found.items()}, []


def _write(folder: Path, contents: Mapping[str, bytes], record: Mapping[str, Any]) -> None:
    """Write all files aside, then put the directory in its place. Raises `OSError`, and leaves nothing behind then."""
    aside, before = (folder.with_name(f"{folder.name}.{end}") for end in ("tmp", "old"))
    make_directory(folder.parent)
    remove(aside)
    try:
        aside.mkdir()
        for name, content in contents.items():
            (aside / name).parent.mkdir(exist_ok=True)
            replace_file(aside / name, content)
        write_json(aside / MANIFEST, record)
        remove(before)
        if folder.exists():
            folder.replace(before)
        aside.replace(folder)
        sync(folder.parent)
        remove(before)
    except BaseException:
        remove(aside)
        if before.exists() and not folder.exists():
            before.replace(folder)
        raise
