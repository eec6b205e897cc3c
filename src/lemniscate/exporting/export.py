"""`export`: a policy as C99 and as ONNX, how far these are from it, and `manifest.json`, what its numbers mean."""

import hashlib
import json
import math
import subprocess
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lemniscate.api.policy import Trained, TrainedPolicy, algorithm_of, load, path_of
from lemniscate.envs.backend import Interface, Quantity
from lemniscate.errors import UserError, is_installed
from lemniscate.exporting.c_code import c_files, crazyflie_files
from lemniscate.exporting.compiled import HostPolicy, host_compiler
from lemniscate.exporting.deployed import (
    Deployed,
    act_with,
    choices,
    input_size,
    memory_size,
    safe_action,
    safe_sentence,
)
from lemniscate.exporting.onnx_model import onnx_act, onnx_model
from lemniscate.exporting.parity import TESTS, fly, parity, self_tests, sentences
from lemniscate.exporting.translation import Program, translate
from lemniscate.hub.repository import is_address
from lemniscate.run.directory import run_of
from lemniscate.run.seeding import torch_defaults
from lemniscate.spec import Action, Box, ObservationPart, Spec
from lemniscate.system.console import say
from lemniscate.system.files import DamagedFileError, read_json, replace_directory, replace_file, write_json
from lemniscate.system.machine import version

MANIFEST, PARITY, ONNX = "manifest.json", "parity.json", "policy.onnx"
CRAZYFLIE = "crazyflie"

FORMAT = 1
LICENCE = (
    "The policy is its owner's. What lemniscate adds to it in policy.c and policy.h is under the MIT licence;"
    " crazyflie/policy_controller.c, where it is, under the GPL, version 3."
)


@torch_defaults()
def export(
    run: Trained, to: str | Path | None = None, *, checkpoint: str | int | None = None, trust: bool = False
) -> Path:
    """Write a policy as ONNX and as C99 for microcontrollers, from the raw observation to the action for `env.step`.

    These are `policy.onnx`, `policy.c` and `policy.h`; `manifest.json` says what every number means. The exported C
    acts in the environment of training, and at the observations there all copies are compared with the policy:
    `parity.json`. Tools that are not installed for that (a C compiler, onnxruntime, arm-none-eabi-gcc, QEMU) are named,
    and their part is left out. A policy that flies a Crazyflie also gets an application for its firmware, `crazyflie/`.

    Args:
        run: as in `load`.
        to: the new directory; by default `export` in that of the run, of a checkpoint too. An export that is there is
            replaced.
        checkpoint: as in `load`; and so `trust`.

    Returns:
        The directory.

    Raises:
        UserError: a policy that looks at images; a network that cannot be translated; an environment that cannot be
            made; a directory that is no export, or that cannot be written. Nothing is left half-written.
    """
    policy = load(run, checkpoint=checkpoint, trust=trust)
    folder = _destination(run, policy, to)
    if policy.spec.has_images:
        raise UserError(f"A policy for {policy.spec.env_id} observes images; an export takes vectors.")
    if isinstance(policy.spec.action, Box) and not policy.spec.action.dtype.startswith("float"):
        raise UserError(f"{policy.spec.env_id} has a Box of integers as actions; an export has one of real numbers.")
    program = translate(Deployed(policy).eval(), input_size(policy.spec), memory_size(policy))
    contents, record, said = _contents(policy, program)
    try:
        with replace_directory(folder) as aside:
            for name, content in contents.items():
                (aside / name).parent.mkdir(exist_ok=True)
                replace_file(aside / name, content)
            write_json(aside / MANIFEST, record)
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror or error}.") from error
    for sentence in said:
        say(sentence)
    return folder


def _destination(run: Trained, policy: TrainedPolicy, to: str | Path | None) -> Path:
    """The directory of the export. Raises `UserError` where something else is in its place."""
    if to is None and (policy.path is None or is_address(run)):
        raise UserError("This policy is of no run here: name the directory of its export, with --to or `to`.")
    folder = path_of(to) if to is not None else run_of(Path(policy.path or "")) / "export"
    if not folder.name:
        raise UserError(f"An export gets a directory of its own: name one in {folder}, such as {folder / 'export'}.")
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
    true, action, compiler, named = act_with(policy), policy.spec.action, host_compiler(), title(policy)
    wrappers = list(policy.config.wrappers)
    facts = {"title": named, "environment": policy.spec.env_id, "wrappers": wrappers, "step": policy.step}
    model = onnx_model(program, facts) if is_installed("onnx") else None
    absent = "There is no C compiler here (cc, gcc, clang or CC): policy.c is not compared on this machine."
    try:
        acting, act = _actor(policy, program, model, compiler)
    except UserError as error:  # one that makes nothing for this machine
        compiler, absent = None, f"policy.c is not compared on this machine: {error}"
        acting, act = _actor(policy, program, model, None)
    flights, interface = fly(policy, act)
    tests = self_tests(policy, flights.rows(true, program.memory_size))
    edges = f", and {len(tests) - TESTS} with one number far outside of them" if len(tests) > TESTS else ""
    origin = f"{TESTS} of episodes of {policy.spec.env_id}{edges}"
    about = {"title": named, "origin": origin, "period": interface.period, "wrappers": wrappers}
    texts = c_files(program, action, tests, true(tests), **about)
    found = parity(program, action, true, flights, texts, model, HostPolicy(texts, compiler) if compiler else absent)
    record = {"environment": policy.spec.env_id, "acting": acting, "reference": "torch", **found}
    said, vehicle = sentences(record), dict[str, str]()
    if wrappers:
        said.append(
            f"NOT in the files: the wrappers {', '.join(wrappers)}; what they do, the caller of the policy has to do."
        )
    if interface.vehicle == CRAZYFLIE:
        try:
            vehicle = crazyflie_files(interface, observed(policy.spec, interface), action, texts, named)
        except UserError as error:
            said.append(f"{CRAZYFLIE}/ is left out: {error}.")
    contents: dict[str, bytes] = {} if model is None else {ONNX: model}
    contents |= {name: text.encode() for name, text in texts.items()}
    contents |= {f"{CRAZYFLIE}/{name}": text.encode() for name, text in vehicle.items()}
    contents[PARITY] = (json.dumps(record, indent=1, allow_nan=False) + "\n").encode()
    seen = flights.obs.reshape(-1, program.obs.size)
    return contents, _manifest(policy, program, interface, seen, contents), said


def _actor(
    policy: TrainedPolicy, program: Program, model: bytes | None, compiler: str | None
) -> tuple[str, Callable[..., np.ndarray]]:
    """The copy that acts here, by its name: the C code, or else ONNX, or else the policy itself."""
    if compiler:
        # what the self-test stores is seen on this flight, so the C that flies has an empty one
        untested = [np.zeros((1, x.size + program.memory_size)) for x in (program.obs, program.action)]
        files = c_files(program, policy.spec.action, *untested, title="", origin="")
        return "policy.c", HostPolicy(files, compiler).act
    if model and is_installed("onnxruntime"):
        return ONNX, onnx_act(model)[0]
    return "the policy itself", act_with(policy)


def _manifest(
    policy: TrainedPolicy, program: Program, interface: Interface, obs: np.ndarray, files: Mapping[str, bytes]
) -> dict[str, Any]:
    """The content of `manifest.json`: the meaning of every number of an exported policy, and its origin.

    Observations have the range of `obs` [R, O], those of its episodes; `files` are named with their sha256.
    """
    action = policy.spec.action
    seen = zip(obs.min(0).tolist(), obs.max(0).tolist(), strict=True)
    return {
        "export": FORMAT,
        "title": title(policy),
        "environment": policy.spec.env_id,
        "env_kwargs": dict(policy.config.env_kwargs),
        "wrappers": list(policy.config.wrappers),
        "wrappers_are": "between environment and policy, the first innermost, and NOT in the files: the last returns"
        " the observations and takes the actions below; wrappers that an environment brings by itself are part of it",
        "algorithm": algorithm_of(policy),
        "step": policy.step,
        "seed": policy.config.seed,
        "lemniscate": version(),
        "commit": commit(),
        "control_period_s": interface.period,
        "delay_s": interface.delay,
        "history": interface.history,
        "dynamics": interface.dynamics,
        "vehicle": interface.vehicle,
        "products": "bfloat16 between hidden layers, as in training" if program.is_rounded else "float32",
        "deterministic": True,
        "observations": [
            {"index": i, **vars(quantity), "range": list(ends)}
            for i, (quantity, ends) in enumerate(zip(observed(policy.spec, interface), seen, strict=True))
        ],
        "actions": [
            {"index": i, **vars(quantity), "range": ends}
            for i, (quantity, ends) in enumerate(zip(acted(action, interface), ranges(action), strict=True))
        ],
        "memory": program.memory_size,
        "safe_action": safe_action(action).tolist(),
        "safe_action_is": f"where an observation is not finite, policy.c writes {safe_sentence(action)}, and returns 1",
        "licence": LICENCE,
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
    }


@cache
def commit() -> str | None:
    """The commit of lemniscate's source, where it runs from its repository."""
    folder = Path(__file__).parent
    try:
        # the first command fails where lemniscate is installed into the directory of another repository
        for command in (["ls-files", "--error-unmatch", "__init__.py"], ["rev-parse", "HEAD"]):
            done = subprocess.run(
                ["git", *command], cwd=folder, capture_output=True, encoding="utf-8", timeout=10, check=True
            )
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def title(policy: TrainedPolicy) -> str:
    """The environment, algorithm, seed and step of a policy, in a line."""
    name, seed = algorithm_of(policy), policy.config.seed
    return f"A policy for {policy.spec.env_id}: {name}, seed {seed}, step {policy.step:,}."


def observed(spec: Spec, interface: Interface) -> list[Quantity]:
    """The quantities of the whole observation; where the environment says nothing, the names of its parts."""
    found = list[Quantity]()
    for part in spec.observation_parts:
        known = interface.parts.get(part.name, ())
        found += known if len(known) == part.size else map(Quantity, _names(part))
    return found + [Quantity(f"action_mask[{i}]") for i in range(spec.action.mask_size)]


def _names(part: ObservationPart) -> list[str]:
    if part.nvec:  # one-hot
        places = [f"[{i}]" if len(part.nvec) > 1 else "" for i in range(len(part.nvec))]
        columns = zip(places, part.start, part.nvec, strict=True)
        return [f"{part.name}{place}={first + i}" for place, first, n in columns for i in range(n)]
    return [part.name] if part.size == 1 else [f"{part.name}[{i}]" for i in range(part.size)]


def acted(action: Action, interface: Interface) -> list[Quantity]:
    """The quantities of the action."""
    size = len(ranges(action))
    names = ["action"] if size == 1 else [f"action[{i}]" for i in range(size)]
    return list(interface.action) if len(interface.action) == size else list(map(Quantity, names))


def ranges(action: Action) -> list[list[float | None]]:
    """The lowest and the highest number of each coordinate; None where there is none."""
    if isinstance(action, Box):
        ends = zip(action.low, action.high, strict=True)
        return [[end if math.isfinite(end) else None for end in pair] for pair in ends]
    return [[first, first + n - 1] for n, first in zip(*choices(action), strict=True)]
