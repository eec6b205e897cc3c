"""The commands. What a program reads goes to standard output (`evaluate --json`), what a person reads to the error one.

Exit codes: 0 done, 1 training could not go on, 2 a mistake in what was asked, 130 stopped by Ctrl-C, 143 by SIGTERM.

`parsers` reads the words and imports nothing heavy, so that help and most mistakes take no time; `fields` adds the
options of an algorithm's Config, which imports torch; `commands` works.
"""

import argparse
import atexit
import gc
import os
import sys
from collections.abc import Sequence

from lemniscate.cli.parsers import parse as parse
from lemniscate.errors import NonFiniteError, NotStoredError, RankError, SweepError, UserError, WorkerError
from lemniscate.system.console import say, talks

FAILURES = (NonFiniteError, WorkerError, NotStoredError, RankError, SweepError, MemoryError)
"""what training ends with that is neither the user's mistake nor ours"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    atexit.register(gc.freeze)  # else the interpreter spends a second on looking through torch for what to free
    given = argparse.Namespace(command=None)
    if "RANK" in os.environ:  # torch has whole pages to say of a connection that ends
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
    try:
        given = parse(sys.argv[1:] if arguments is None else arguments)
        from lemniscate.cli import commands  # imports torch

        getattr(commands, given.command)(given)
    except SystemExit as done:  # argparse has printed help, or the version
        return int(done.code or 0)
    except BaseException as error:
        code = exit_code(error)
        if code is None:
            raise
        say(sentence(error, given.command))
        return code
    return 0


def exit_code(error: BaseException) -> int | None:
    """The exit code for what ended a command; None for a mistake of our own."""
    if isinstance(error, KeyboardInterrupt):
        return 128 + getattr(error, "signum", 2)
    if isinstance(error, BrokenPipeError):  # whoever read the output has read enough
        return 141
    if isinstance(error, UserError):
        return 2
    return 1 if isinstance(error, FAILURES) or (isinstance(error, OSError) and error.errno is not None) else None


def sentence(error: BaseException, command: str | None) -> str:
    """The message of an error; empty if another process of the run prints it."""
    if isinstance(error, BrokenPipeError) or (isinstance(error, UserError) and not talks()):
        return ""
    ended = isinstance(error, NonFiniteError | WorkerError | RankError) and command in ("train", "resume")
    if ended and str(error):
        return f"{error} Training stopped; the last checkpoint is as it was."
    if isinstance(error, KeyboardInterrupt):  # a run that was asked to stop has a sentence of its own
        return str(error) or ("" if hasattr(error, "signum") else "Interrupted.")
    if isinstance(error, MemoryError):
        return str(error) or "The memory is full: choose smaller numbers."
    if isinstance(error, OSError):  # a disk that is full, a folder that cannot be written
        return f"{error.filename or 'A file could not be written'}: {error.strerror}."
    return str(error)
