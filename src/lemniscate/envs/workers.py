"""Environments in a process each, watched: one that dies or hangs is named, and closing never hangs."""

import multiprocessing
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from gymnasium.vector import AsyncVectorEnv

from lemniscate.errors import WorkerError

CLOSING_SECONDS = 2.0
"""how long workers may take to close their environments before they are killed"""


class WatchedVectorEnv(AsyncVectorEnv):
    """Gymnasium's `AsyncVectorEnv`, with at most `patience` seconds for each answer."""

    patience: float = 60.0

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """Gymnasium's, with the timeout. Raises `WorkerError` if a worker died or does not answer."""
        return self._watched(lambda: self.reset_async(seed=seed, options=options), self.reset_wait)

    def step(self, actions: Any) -> Any:
        """Gymnasium's, with the timeout. Raises `WorkerError` if a worker died or does not answer."""
        return self._watched(lambda: self.step_async(actions), self.step_wait)

    def _check_spaces(self) -> None:
        """Gymnasium's, which waits without end; so every worker has to answer once before."""
        try:
            self._watched(lambda: self.call_async("metadata"), self.call_wait)
        except WorkerError:
            self.close_extras(terminate=True)
            self.closed = True
            raise
        super()._check_spaces()

    def _watched(self, ask: Callable[[], None], wait: Callable[..., Any]) -> Any:
        try:
            ask()
            return wait(timeout=self.patience)
        except (multiprocessing.TimeoutError, EOFError, ConnectionError) as error:
            raise WorkerError(self._diagnosis()) from error

    def _diagnosis(self) -> str:
        for i, process in enumerate(self.processes):
            process.join(timeout=0.1)  # one that has just closed its pipe may not be dead yet
            if not process.is_alive():
                return f"The process of environment {i} died (exit code {process.exitcode})."
        silent = [str(i) for i, pipe in enumerate(self.parent_pipes) if not pipe.poll(0)]
        return f"Environment {', '.join(silent) or 'unknown'} has not answered for {self.patience:g} s."

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """Ask every worker to close its environment; kill those that do not."""
        for pipe in self.parent_pipes:
            if pipe is not None and not pipe.closed:
                with suppress(OSError):
                    pipe.send(("close", None))
        deadline = time.monotonic() + (0 if terminate else CLOSING_SECONDS)
        for process in self.processes:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
        for pipe in self.parent_pipes:
            if pipe is not None:
                pipe.close()
