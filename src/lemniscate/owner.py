"""Processes that end with the process that they work for, however it ends."""

import os
import select

OWNED = "LEMNISCATE_OWNED"
"""in the environment of a process whose standard input is a pipe from the process that it works for"""


def end_with_owner() -> None:
    """End this process with its owner, if it was started with `OWNED`."""
    if os.environ.pop(OWNED, None):
        end_when_closed(0)


def end_when_closed(pipe: int) -> None:
    """Have the system end this process once nobody holds the writing end of `pipe`, whose reading end this is.

    The signal comes from the kernel, so it also ends a process that is caught in a loop. No data may come.
    """
    import fcntl  # there is none on Windows

    fcntl.fcntl(pipe, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)  # sends SIGIO, which terminates
    if select.select([pipe], [], [], 0)[0]:  # closed before
        os._exit(1)
