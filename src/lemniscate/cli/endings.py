"""The message and the exit code of a command that ends with an error."""

from collections.abc import Callable

from lemniscate.errors import NonFiniteError, NotStoredError, RankError, SweepError, UserError, WorkerError
from lemniscate.system.console import talks


def exit_code(error: BaseException) -> int | None:
    """The exit code for what ended a command; None for a mistake of our own."""
    if isinstance(error, KeyboardInterrupt):
        return 128 + getattr(error, "signum", 2)
    if isinstance(error, BrokenPipeError):  # whoever read the output has read enough
        return 141
    if isinstance(error, UserError):
        return 2
    known = (NonFiniteError, WorkerError, NotStoredError, RankError, SweepError, MemoryError)
    return 1 if isinstance(error, known) or (isinstance(error, OSError) and error.errno is not None) else None


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


def unknown_argument(rest: list[str], sentence_for: Callable[[str], UserError]) -> UserError:
    """The sentence for the arguments that no parser understood: `sentence_for` the first flag among them."""
    flags = [word.partition("=")[0] for word in rest if word.startswith("-")]
    is_switch = rest[0].lower() in ("true", "false", "on", "off", "yes", "no")
    hint = "a switch has no value: --flag or --no-flag." if is_switch else "--help lists what there is."
    return sentence_for(flags[0]) if flags else UserError(f"Unknown argument {rest[0]!r}; {hint}")
