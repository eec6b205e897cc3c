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
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from lemniscate.errors import NonFiniteError, UserError, shown, with_article
from lemniscate.run.state import TrainState
from lemniscate.spec import Action, ObservationPart, Spec
from lemniscate.system import files
from lemniscate.system.files import DamagedFileError, UnreadableFileError, parsing

FORMAT = 5
TENSORS, STATE, MANIFEST = "tensors.safetensors", "state.json", "manifest.json"
FILES = (TENSORS, STATE)


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The content of a checkpoint: tensors and numbers by name, and the record that `write` was given."""

    path: Path
    tensors: dict[str, Tensor]
    numbers: dict[str, Any]
    record: dict[str, Any]

    def restore(self, state: TrainState) -> None:
        """Restore every saved field of a State of the same Config. Raises `DamagedFileError` if one does not fit."""
        with parsing(self.path):
            for name, value in state.saved().items():
                if hasattr(value, "load_state_dict"):
                    value.load_state_dict(self.tensors_of(name))
                else:
                    setattr(state, name, self.numbers[name])

    def tensors_of(self, name: str) -> dict[str, Tensor]:
        """The `state_dict` of one field of the State."""
        prefix = f"{name}."
        return {key.removeprefix(prefix): t for key, t in self.tensors.items() if key.startswith(prefix)}


def write(directory: Path, fields: Mapping[str, Any], step: int, record: dict[str, Any], keep: int) -> Path:
    """Write `directory/step-N` with the fields of a State, as of `saved`, and delete all but the newest `keep`.

    `record` is any JSON that a reader needs beside the state.

    Raises:
        OSError: it could not be written; the checkpoints before are untouched, and nothing is left of this one.
        NonFiniteError: a NaN or an infinity in a parameter or an optimizer; nothing is written.
    """
    final = directory / f"step-{step}"
    stale = list(directory.glob("*.tmp"))
    write_fields(final, fields, record)
    for path in [*stale, *(directory / f"step-{old}" for old in list_steps(directory)[:-keep])]:
        with suppress(OSError):  # the next one tries again
            files.remove(path)
    return final


def require_storable(kind: str, fields: Mapping[str, Any]) -> None:
    """Raise `UserError` for a field of a State of this `kind` that a checkpoint cannot hold."""
    for name, value in fields.items():
        if hasattr(value, "state_dict"):
            if odd := [key for key, tensor in value.state_dict().items() if not isinstance(tensor, Tensor)]:
                what = f"{with_article(type(value).__name__)}, whose state_dict has {odd[0]!r}, no tensor"
                raise UserError(f"{kind}.{name} is {what}: optimizers are those of lemniscate.optim.adam.")
            continue
        try:
            json.dumps(value)
        except (TypeError, ValueError):
            raise UserError(
                f"{kind}.{name} is {shown(value)}: a field of a State is a number, or has state_dict and"
                " load_state_dict; or field(metadata={'saved': False}) keeps it out of checkpoints."
            ) from None


def write_fields(final: Path, fields: Mapping[str, Any], record: dict[str, Any]) -> None:
    """Write the checkpoint `final` with these fields, in the place of one that is there; raises as `write`."""
    tensors: dict[str, Tensor] = {}
    numbers: dict[str, Any] = {}
    for name, value in fields.items():
        if hasattr(value, "state_dict"):
            tensors |= {f"{name}.{key}": t for key, t in value.state_dict().items()}
        else:
            numbers[name] = value
    if name := _not_finite(tensors):
        raise NonFiniteError(f"{name} has a value that is not finite; {final} is not written.")
    with files.replace_directory(final) as folder:
        files.write_json(folder / STATE, {"numbers": numbers, "record": record})
        _write_tensors(folder / TENSORS, tensors, mode=(folder / STATE).stat().st_mode)
        hashes = {name: _sha256(folder / name) for name in FILES}
        files.write_json(folder / MANIFEST, {"format": FORMAT, "files": hashes})


def _write_tensors(path: Path, tensors: Mapping[str, Tensor], mode: int) -> None:
    """Write tensors into a new file with the permissions `mode`, and have the disk store it. Raises `OSError`."""
    distinct: dict[str, Tensor] = {}
    taken = set[int]()
    for name, tensor in tensors.items():
        values = tensor.detach().contiguous()
        # The library refuses names of one memory, such as a normalizer that policy and value share.
        distinct[name] = values.clone() if values.data_ptr() in taken else values
        taken.add(values.data_ptr())
    try:
        save_file(distinct, path)  # to the disk without a copy in memory: a replay buffer may be all that fits
    except SafetensorError as error:  # the library's name for the system's error, whose number is in its text
        number = re.search(r"os error (\d+)", str(error))
        if number is None:
            raise
        raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from error
    path.chmod(mode)  # the library makes files that only their owner can read
    files.sync(path)


def read(path: Path) -> Checkpoint:
    """A checkpoint directory, of which every byte is checked. Raises `DamagedFileError`, naming what is wrong where."""
    _verify(path)
    try:
        tensors = load_file(path / TENSORS)
    except (SafetensorError, OSError, RuntimeError) as error:  # its content was right a moment ago
        raise UnreadableFileError(f"{path / TENSORS} cannot be read: {error}.") from error
    if name := _not_finite(tensors):
        raise DamagedFileError(f"{path / TENSORS} has a value that is not finite in {name}.")
    state = files.read_json(path / STATE)
    with parsing(path / STATE):
        return Checkpoint(path, tensors, dict(state["numbers"]), dict(state["record"]))


def is_whole(path: Path) -> bool:
    """Whether every file of a checkpoint directory matches its hash."""
    try:
        _verify(path)
    except DamagedFileError:
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
    record = _tuples(record)
    action = record["action"]
    kind = {k.__name__: k for k in get_args(Action)}[action.pop("kind")]
    parts = tuple(ObservationPart(**part) for part in record["observation_parts"])
    return Spec(**{**record, "action": kind(**action), "observation_parts": parts})


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuples(inner) for name, inner in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """The name of a tensor with a NaN or an infinity. Replayed rows were looked at when they were collected."""
    looked_at = (name for name in tensors if not name.startswith("replay."))
    return next((name for name in looked_at if not bool(tensors[name].isfinite().all())), None)


def _verify(path: Path) -> None:
    manifest = files.read_json(path / MANIFEST)
    if "export" in manifest:
        raise UserError(f"{path} is an export, for other programs: load the run or the checkpoint that it is of.")
    if manifest.get("format") != FORMAT:
        raise UserError(f"{path} has format {manifest.get('format')!r}; this version of lemniscate reads {FORMAT}.")
    with parsing(path / MANIFEST):
        hashes = {name: manifest["files"][name] for name in FILES}
    for name in FILES:
        if _sha256(path / name) != hashes[name]:
            raise DamagedFileError(f"{path / name} is damaged: its sha256 differs from the one that was written.")


def _sha256(path: Path) -> str:
    with files.open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
