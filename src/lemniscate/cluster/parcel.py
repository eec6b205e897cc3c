"""A run directory as bytes, to be sent to another machine and back."""

import io
import tarfile
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from lemniscate.run.directory import CONFIG, LOCK
from lemniscate.system.files import make_directory, remove

STORAGE = "ray"
"""the folder of a run directory that has Ray's storage, where no other is named"""
LEFT = (LOCK, STORAGE, "plots", "videos")
"""what is only of the machine where it is"""


def pack(path: Path) -> bytes:
    """A run directory, which another process may be writing to: its checkpoints first, then all that is after them."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for file in sorted(path.rglob("*"), key=lambda file: "checkpoints" not in file.parts):
            own = file.relative_to(path)
            if own.parts[0] not in LEFT and file.suffix != ".tmp":
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
        ours, theirs = path / "checkpoints", new / "checkpoints"
        if not theirs.exists():
            return
        make_directory(ours)
        sent = {checkpoint.name for checkpoint in theirs.iterdir()}
        for name in sent - {checkpoint.name for checkpoint in ours.iterdir()}:
            (theirs / name).rename(ours / name)
        for checkpoint in ours.iterdir():
            if checkpoint.name not in sent:
                remove(checkpoint)
