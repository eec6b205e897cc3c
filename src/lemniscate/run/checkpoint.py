"""Checkpoints: a directory of raw tensors and JSON, no pickle, a sha256 for each file.

    step-N/tensors.safetensors   the tensors of the State
    step-N/state.json            the numbers of the State, the Spec, the Config
    step-N/manifest.json         format version, sha256 of the other two

A checkpoint is written under another name, synced, then renamed: under its own name it is whole or absent. The hashes
find damage, not malice; but nothing in these files can be executed.
"""

import dataclasses
import hashlib
import json
import os
import shutil
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from lemniscate.errors import UserError
from lemniscate.run.state import TrainState
from lemniscate.spec import Action, ObservationPart, Spec

FORMAT = 1
FILES = ("tensors.safetensors", "state.json")


class DamagedCheckpointError(UserError):
    """A checkpoint with a file that is missing or does not match its hash."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The content of a checkpoint: tensors and numbers by name, and the record that `write` was given."""

    path: Path
    tensors: dict[str, Tensor]
    numbers: dict[str, Any]
    record: dict[str, Any]

    def restore(self, state: TrainState) -> None:
        """Restore every saved field of a State of the same Config."""
        for name, value in state.saved().items():
            if hasattr(value, "load_state_dict"):
                value.load_state_dict(self.tensors_of(name))
            else:
                setattr(state, name, self.numbers[name])

    def tensors_of(self, name: str) -> dict[str, Tensor]:
        """The `state_dict` of one field of the State."""
        prefix = f"{name}."
        return {key.removeprefix(prefix): t for key, t in self.tensors.items() if key.startswith(prefix)}


def write(directory: Path, state: TrainState, step: int, record: dict[str, Any], keep: int) -> Path:
    """Write `directory/step-N` with the saved fields of `state`, and delete all but the newest `keep`.

    `record` is any JSON that a reader needs beside the state.
    """
    final = directory / f"step-{step}"
    for stale in directory.glob("*.tmp"):
        shutil.rmtree(stale)
    write_fields(final, state.saved(), record)
    for old in list_steps(directory)[:-keep]:
        shutil.rmtree(directory / f"step-{old}")
    return final


def write_fields(final: Path, fields: Mapping[str, Any], record: dict[str, Any]) -> None:
    """Write the checkpoint `final` with these fields, in the place of one that is there."""
    tensors: dict[str, Tensor] = {}
    numbers: dict[str, Any] = {}
    for name, value in fields.items():
        if hasattr(value, "state_dict"):
            tensors |= {f"{name}.{key}": t for key, t in value.state_dict().items()}
        else:
            numbers[name] = value
    temporary, old = final.with_name(f"{final.name}.tmp"), final.with_name(f"{final.name}.old")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    save_file(_to_save(tensors), temporary / FILES[0])
    (temporary / FILES[1]).write_text(_json({"numbers": numbers, "record": record}))
    hashes = {name: _sha256(temporary / name) for name in FILES}
    (temporary / "manifest.json").write_text(_json({"format": FORMAT, "sha256": hashes}))
    for path in temporary.iterdir():
        _sync(path)
    _sync(temporary)
    if final.exists():  # at every moment one of them is whole, under some name
        shutil.rmtree(old, ignore_errors=True)
        final.rename(old)
    temporary.rename(final)
    _sync(final.parent)
    shutil.rmtree(old, ignore_errors=True)


def read(path: Path) -> Checkpoint:
    """Read one checkpoint directory and check every byte of it.

    Raises:
        DamagedCheckpointError: naming the file and what is wrong with it.
    """
    _verify(path)
    try:
        tensors = load_file(path / FILES[0])
        state = json.loads((path / FILES[1]).read_bytes())
        return Checkpoint(path, tensors, state["numbers"], state["record"])
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise DamagedCheckpointError(f"{path} cannot be read: {error}.") from error


def is_whole(path: Path) -> bool:
    """Whether every file of a checkpoint directory matches its hash."""
    try:
        _verify(path)
    except DamagedCheckpointError:
        return False
    return True


def list_steps(directory: Path) -> list[int]:
    """The steps of the checkpoints in a run's `checkpoints` directory, ascending."""
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
    parts = tuple(ObservationPart(**_tuples(part)) for part in record["observation_parts"])
    return Spec(**{**_tuples(record), "action": kind(**action), "observation_parts": parts})


def _tuples(record: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in record.items()}


def _to_save(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors on the CPU, no two of them in the same memory, which safetensors refuses.

    Only tensors that share memory are copied; a replay buffer, the largest, shares none.
    """
    at = {name: t.untyped_storage().data_ptr() for name, t in tensors.items()}
    times = Counter(at.values())
    return {name: (t.clone() if times[at[name]] > 1 else t).detach().cpu().contiguous() for name, t in tensors.items()}


def _verify(path: Path) -> None:
    manifest = _parse(path / "manifest.json")
    if manifest.get("format") != FORMAT:
        raise UserError(f"{path} has format {manifest.get('format')!r}; this version of lemniscate reads {FORMAT}.")
    for name in FILES:
        if _sha256(path / name) != manifest.get("sha256", {}).get(name):
            raise DamagedCheckpointError(f"{path / name} is damaged: its sha256 differs from the one that was written.")


def _json(record: Any) -> str:
    return json.dumps(record, indent=1)


def _sha256(path: Path) -> str:
    if not path.is_file():
        raise DamagedCheckpointError(f"{path} is missing.")
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _parse(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise DamagedCheckpointError(f"{path} is missing.")
    try:
        parsed = json.loads(path.read_bytes())
        if isinstance(parsed, dict):
            return parsed
    except ValueError:
        pass
    raise DamagedCheckpointError(f"{path} is damaged: it is not JSON.")


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
