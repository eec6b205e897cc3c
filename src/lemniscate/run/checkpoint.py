"""Checkpoints: a directory of raw tensors and JSON, no pickle, a sha256 for each file.

    step-N/tensors.safetensors   every tensor of the State
    step-N/state.json            every number of it, the Spec, the Config
    step-N/manifest.json         format version, sha256 of the two

Written under another name, synced, then renamed: under its own name a checkpoint is whole or absent. The hashes find
damage, not malice; but nothing in these files can be executed.
"""

import dataclasses
import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any, get_args

import torch
from safetensors import SafetensorError
from safetensors.torch import load as tensors_from_bytes
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor

from lemniscate.errors import UserError
from lemniscate.types import Action, Part, Spec

FORMAT = 1
PARTS = ("tensors.safetensors", "state.json")


class DamagedCheckpointError(UserError):
    """A checkpoint whose files are missing, or not what their hashes say."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """What `read` found: tensors and numbers by name, and the record that `write` was given."""

    path: Path
    tensors: dict[str, Tensor]
    numbers: dict[str, Any]
    record: dict[str, Any]

    def restore(self, state: Any) -> None:
        """Put everything back into a State of the same make: generators, what has a `state_dict`, numbers."""
        for name, value in _parts(state):
            mine = self.part(name)
            if isinstance(value, torch.Generator):
                value.set_state(mine["state"])
            elif hasattr(value, "load_state_dict"):
                value.load_state_dict(mine)
            else:
                setattr(state, name, self.numbers[name])

    def part(self, name: str) -> dict[str, Tensor]:
        """The tensors of one field of the State; of a module, its state_dict."""
        prefix = f"{name}."
        return {key.removeprefix(prefix): t for key, t in self.tensors.items() if key.startswith(prefix)}


def write(directory: Path, state: Any, step: int, record: dict[str, Any], keep: int) -> Path:
    """Write `directory/step-N` with every field of the dataclass `state`, and delete all but the newest `keep`.

    `record` is any JSON: what a reader needs to know beside the state.
    """
    final = directory / f"step-{step}"
    tensors: dict[str, Tensor] = {}
    numbers: dict[str, Any] = {}
    for name, value in _parts(state):
        if isinstance(value, torch.Generator):
            tensors[f"{name}.state"] = value.get_state()
        elif hasattr(value, "state_dict"):
            tensors |= {f"{name}.{key}": t for key, t in value.state_dict().items()}
        else:
            numbers[name] = value
    contents = {
        # Clones, because modules may share a normalizer and safetensors refuses shared memory.
        PARTS[0]: tensors_to_bytes({k: t.detach().cpu().clone().contiguous() for k, t in tensors.items()}),
        PARTS[1]: _json({"numbers": numbers, "record": record}),
    }
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in contents.items()}
    contents["manifest.json"] = _json({"format": FORMAT, "sha256": hashes})

    directory.mkdir(parents=True, exist_ok=True)
    for stale in directory.glob("*.tmp"):
        shutil.rmtree(stale)
    temporary = directory / f"step-{step}.tmp"
    temporary.mkdir()
    for name, data in contents.items():
        with (temporary / name).open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    _sync(temporary)
    if final.exists():
        shutil.rmtree(final)
    temporary.rename(final)
    _sync(directory)
    for old in list_steps(directory)[:-keep]:
        shutil.rmtree(directory / f"step-{old}")
    return final


def read(path: Path) -> Checkpoint:
    """Read one checkpoint directory, every byte of it checked.

    Raises:
        DamagedCheckpointError: naming the file and what is wrong with it.
    """
    manifest = _parse(path / "manifest.json")
    if manifest.get("format") != FORMAT:
        raise UserError(f"{path} has format {manifest.get('format')!r}; this version of lemniscate reads {FORMAT}.")
    contents = {}
    for name in PARTS:
        contents[name] = _bytes(path / name)
        if hashlib.sha256(contents[name]).hexdigest() != manifest.get("sha256", {}).get(name):
            raise DamagedCheckpointError(f"{path / name} is not what was written: its sha256 differs.")
    try:
        tensors = tensors_from_bytes(contents[PARTS[0]])
        state = json.loads(contents[PARTS[1]])
        return Checkpoint(path, tensors, state["numbers"], state["record"])
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise DamagedCheckpointError(f"{path} cannot be read: {error}.") from error


def list_steps(directory: Path) -> list[int]:
    """The steps of the checkpoints in a run's `checkpoints`, ascending."""
    names = (p.name.removeprefix("step-") for p in directory.glob("step-*") if p.is_dir())
    return sorted(int(name) for name in names if name.isdigit())


def spec_to_json(spec: Spec) -> dict[str, Any]:
    """A Spec as JSON."""
    return dataclasses.asdict(spec) | {
        "action": {"kind": type(spec.action).__name__, **dataclasses.asdict(spec.action)}
    }


def spec_from_json(record: dict[str, Any]) -> Spec:
    """The Spec that `spec_to_json` came from."""
    action = _tuples(record["action"])
    kind = {k.__name__: k for k in get_args(Action)}[action.pop("kind")]
    layout = tuple(Part(**_tuples(part)) for part in record["layout"])
    return Spec(**{**_tuples(record), "action": kind(**action), "layout": layout})


def _tuples(record: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in record.items()}


def _parts(state: Any) -> list[tuple[str, Any]]:
    return [(field.name, getattr(state, field.name)) for field in dataclasses.fields(state)]


def _json(record: Any) -> bytes:
    return json.dumps(record, indent=1).encode()


def _bytes(path: Path) -> bytes:
    if not path.is_file():
        raise DamagedCheckpointError(f"{path} is missing.")
    return path.read_bytes()


def _parse(path: Path) -> dict[str, Any]:
    try:
        parsed = json.loads(_bytes(path))
        if isinstance(parsed, dict):
            return parsed
    except ValueError:
        pass
    raise DamagedCheckpointError(f"{path} is not JSON any more.")


def _sync(directory: Path) -> None:
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
