"""Files that can be trusted after a crash, and read without trust.

What is written is written aside, synced, then renamed: under its own name it is whole or absent, also after a power
cut. JSON carries the sha256 of its content. What is read is a regular file of a bounded size: no link is followed, no
pipe is waited for, and nothing in it is executed.
"""

import errno
import hashlib
import json
import os
import shutil
import stat
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any

from lemniscate.errors import UserError

MAX_JSON_BYTES = 64 * 2**20
"""more than any JSON that is written here"""

LONGEST_NAME = 255
"""bytes of a name in a folder, on every common file system"""

HASH = "sha256"


class DamagedFileError(UserError):
    """A file that is missing, or is not what was written: names it."""


class UnreadableFileError(DamagedFileError):
    """A file that the system does not open at the moment: it may be whole."""


def at_home(path: str | os.PathLike[str]) -> Path:
    """A path as a person gives it: `~` at its beginning is the home folder. Raises `UserError` for no possible name."""
    found = Path(os.path.expanduser(path))  # noqa: PTH111 (pathlib's raises where `~name` is no user)
    if "\0" in str(found) or any(len(os.fsencode(part)) > LONGEST_NAME for part in found.parts):
        what = "has a zero byte" if "\0" in str(found) else f"has a name of more than {LONGEST_NAME} bytes"
        raise UserError(f"{str(found)[:40]!r}… {what}, and is no path.")
    return found


def write_json(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record with the sha256 of its content, in the place of a file that is there. Raises `OSError`."""
    replace_file(path, (json.dumps({HASH: _hash_of(record), **record}, indent=1) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """The object that `write_json` stored.

    Raises `DamagedFileError` if the file is missing, is no regular file, or has another content than was written.
    """
    with open_regular(path) as file:
        content = file.read(MAX_JSON_BYTES + 1)
    try:
        record = json.loads(content)
    except (ValueError, RecursionError):
        raise DamagedFileError(f"{path} is damaged: it is not JSON.") from None
    is_record = isinstance(record, dict) and len(content) <= MAX_JSON_BYTES
    if is_record and HASH not in record:
        raise DamagedFileError(f"{path} has no sha256: it is damaged, or of another version of lemniscate.")
    if is_record and record.pop(HASH) == _hash_of(record):
        return record
    raise DamagedFileError(f"{path} is damaged: its sha256 differs from the one that was written.")


def replace_file(path: Path, content: bytes) -> None:
    """Write a file whole or not at all. Raises `OSError`, and leaves nothing behind then."""
    # Of this thread alone: two may write the same file at a time.
    temporary = path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}.tmp")
    try:
        remove(temporary)
        with temporary.open("xb") as file:  # "x" does not follow a link
            file.write(content)
            file.flush()
            # In this order: renamed before it is synced, a power cut could leave the name with an empty file.
            os.fsync(file.fileno())
        temporary.replace(path)
        sync(path.parent)  # only now is the new name itself on the disk
    except BaseException:
        with suppress(OSError):
            remove(temporary)
        raise


@contextmanager
def replace_directory(final: Path) -> Iterator[Path]:
    """A new directory to write into, which then takes the place of `final`: whole, or not at all. Raises `OSError`."""
    aside, before = (final.with_name(f"{final.name}.{end}") for end in ("tmp", "old.tmp"))
    make_directory(final.parent)
    remove(aside)
    try:
        aside.mkdir()
        yield aside
        # The names inside are synced before the directory has its own name: else a power cut leaves it without them.
        sync(aside)
        if final.exists():  # a directory that is not empty cannot be renamed over
            remove(before)
            final.rename(before)
        aside.rename(final)
        sync(final.parent)
    finally:
        with suppress(OSError):
            if before.exists() and not final.exists():
                before.rename(final)
            remove(aside)
            remove(before)


def is_whole(path: Path) -> bool:
    """Whether a file is there and has the JSON that `write_json` stored."""
    try:
        read_json(path)
    except DamagedFileError:
        return False
    return True


def open_regular(path: Path) -> BufferedReader:
    """A file, opened to be read. Raises `DamagedFileError` if it is missing, a link, a pipe or a directory."""
    return os.fdopen(_open(path, os.O_RDONLY), "rb")


def open_log(path: Path) -> FileIO:
    """A file, opened to be written at its end; new if it is missing. Raises `DamagedFileError` as `open_regular`."""
    return FileIO(_open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "ab")


def _open(path: Path, flags: int) -> int:
    # A run from elsewhere may hold a link to a file of this user (O_NOFOLLOW), or a pipe that nobody writes to, for
    # which an ordinary open waits for ever (O_NONBLOCK). Windows knows neither.
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        handle = os.open(path, flags, 0o666)
    except FileNotFoundError:
        raise DamagedFileError(f"{path} is missing.") from None
    except OSError as error:
        kind = DamagedFileError if error.errno in (errno.ELOOP, errno.ENXIO) else UnreadableFileError
        reason = "it is a link" if error.errno == errno.ELOOP else error.strerror
        raise kind(f"{path} cannot be opened: {reason}.") from None
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise DamagedFileError(f"{path} cannot be opened: it is no regular file.")
    return handle


@contextmanager
def parsing(path: Path) -> Iterator[None]:
    """Turns the errors of a record with other content than expected into a `DamagedFileError` that names `path`."""
    try:
        yield
    except UserError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = str(error).partition("\n")[0].rstrip(".:")
        raise DamagedFileError(f"{path} cannot be read: {type(error).__name__}, {reason}.") from error


def remove(path: Path) -> None:
    """Remove what is at `path`, if anything: a file, a link (not what it leads to), or a directory."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def file_in_the_way(path: Path) -> Path | None:
    """The file that stands where a directory `path`, or one above it, would have to be."""
    return next((place for place in (path, *path.parents) if place.is_file()), None)


def make_directory(path: Path) -> None:
    """Make a directory and those above it, synced. Raises `FileExistsError` where a link or a file is in its place."""
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        raise FileExistsError(errno.EEXIST, "there is a link or a file in the place of a directory", str(path))
    if not path.exists():
        if path.parent != path:
            path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(exist_ok=True)
        sync(path.parent)


def sync(path: Path) -> None:
    """Have the disk store a file, or the names in a directory, before anything that follows. Raises `OSError`."""
    is_windows = os.name == "nt"
    if is_windows and path.is_dir():  # it opens no directory; the names are in the journal of its file system
        return
    handle = os.open(path, os.O_RDWR if is_windows else os.O_RDONLY)  # Windows syncs only what it could write to
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _hash_of(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def filled(template: Path, filters: dict[str, Callable[..., Any]], **context: Any) -> str:
    """The text of a template of Jinja's, which names `filters` and the values of the `context`.

    Beside its file are those that it includes. What is put into HTML is escaped, into other texts not.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # a training without a report needs none

    templates = Environment(
        loader=FileSystemLoader(template.parent),
        autoescape=".html" in template.name,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters |= filters
    return templates.get_template(template.name).render(context)
