"""Processes that end with the process that they work for, however it ends."""

import os
import select

OWNED = "LEMNISCATE_OWNED"
"""in the environment of a process that works for another: the file of the pipe from there"""


def end_with_owner() -> bool:
    """End this process with its owner, if it was started with `OWNED`; returns whether it was."""
    pipe = os.environ.pop(OWNED, None)
    if pipe:
        end_when_closed(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK))
    return bool(pipe)


def end_when_closed(pipe: int) -> None:
    """Have the system end this process once nobody holds the writing end of `pipe`, whose reading end this is.

    The signal comes from the kernel, so it also ends a process that is caught in a loop. No data may come.
    """
    import fcntl  # there is none on Windows

    fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)  # sends SIGIO, which terminates
    if select.select([pipe], [], [], 0)[0]:  # closed before
        os._exit(1)
