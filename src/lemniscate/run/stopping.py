"""How a run is asked to stop: Ctrl-C, SIGTERM, the end of its terminal."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from lemniscate.system.console import say

PATIENCE = 1.0
"""seconds that an update has to end by itself after a signal, then to be interrupted"""

PATIENCE_OF_SEVERAL = 6.0
"""the same where several processes have to agree first"""


class Stopped(KeyboardInterrupt):
    """The run was asked to stop (Ctrl-C, SIGTERM), and has saved itself."""

    def __init__(self, message: str, signum: int) -> None:
        super().__init__(message)
        self.signum = signum


class StopRequest:
    """The request of a signal to stop after the present update; where that takes too long, the update is interrupted.

    The `several` processes of a run agree before they stop; `go_on` says how the run goes on, in a sentence; `stopping`
    is set once the run is asked to stop.
    """

    def __init__(self, several: bool, go_on: Callable[[], str], stopping: threading.Event) -> None:
        self.signum = 0
        """the signal; 0: nobody has asked"""
        self._several, self._go_on, self._stopping = several, go_on, stopping
        self._patience = PATIENCE_OF_SEVERAL if several else PATIENCE
        self._asked_at, self._ended = 0.0, threading.Event()
        self._hurry = threading.Timer(self._patience, self._ask_again)
        self._hurry.daemon = True
        self._is_storing = False

    @contextmanager
    def heard(self) -> Iterator[None]:
        """Inside, signals are heard."""
        try:
            with stop_signals_to(self._hear):
                yield
        finally:
            self.end()

    @contextmanager
    def storing(self) -> Iterator[None]:
        """Inside, the disk may take its time: nothing but a second signal interrupts it."""
        self._is_storing = True
        if self.signum:
            self._hurry.cancel()
        try:
            yield
        finally:
            self._is_storing = False

    def settle(self) -> None:
        """No more hurry: the update has ended, and the disk may take its time."""
        self._hurry.cancel()

    def end(self) -> None:
        """The loop has ended: nothing is left to interrupt."""
        self._ended.set()
        self._hurry.cancel()
        self._stopping.clear()

    def _hear(self, signum: int, _frame: FrameType | None) -> None:
        """Stop after the present update; asked again, or if that takes longer than the patience, at once."""
        if self.signum and self._several and time.monotonic() - self._asked_at < self._patience - 1:
            return  # a launcher sends on what each process has been sent
        if self.signum:
            self._hurry.cancel()
            raise Stopped(f"Stopped in the middle of an update, which is not saved. {self._go_on()}", self.signum)
        self.signum, self._asked_at = signum, time.monotonic()
        self._stopping.set()
        if not self._is_storing:
            self._hurry.start()

    def _ask_again(self) -> None:
        """In a thread: send the signal again; where even that is not heard, end the process."""
        if hasattr(signal, "pthread_kill"):
            signal.pthread_kill(threading.main_thread().ident or 0, self.signum)
        else:  # Windows
            signal.raise_signal(self.signum)
        if not self._ended.wait(self._patience):
            say(f"Stopped; the update did not let itself be interrupted. {self._go_on()}")
            os._exit(128 + self.signum)


@contextmanager
def stop_signals_to(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Inside, `handler` receives Ctrl-C, SIGTERM, and the end of the terminal unless nohup has it ignored.

    Off the main thread, where no handler can be, they are left alone.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hang_up = [signal.SIGHUP] if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_DFL else []
    previous = {signum: signal.signal(signum, handler) for signum in (signal.SIGINT, signal.SIGTERM, *hang_up)}
    try:
        yield
    finally:
        for signum, handler_before in previous.items():
            signal.signal(signum, handler_before)
