"""Environments in a process each, watched: one that dies or hangs is named, and closing never hangs."""

import multiprocessing
import os
import queue
import signal
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from multiprocessing import connection
from typing import Any

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, VectorEnv
from gymnasium.vector.async_vector_env import AsyncState

from lemniscate.envs.returned import told_with_place, words_of
from lemniscate.errors import UserError, WorkerError
from lemniscate.system.watchdog import end_when_closed

CLOSING_SECONDS = 2.0
"""how long workers may take to close their environments before they are killed"""


class RaisedInWorkerError(RuntimeError):
    """An exception of an environment, as a sentence: the exception itself may not pass through a pipe."""


class Unmade(gym.Env):
    """The place of an environment whose constructor raised; reading its `metadata` raises the same."""

    observation_space = action_space = gym.spaces.Discrete(1)

    def __init__(self, error: Exception) -> None:
        self._error = error

    @property
    def metadata(self) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Raises what the constructor raised: the first question to every worker."""
        raise self._error


class Worker(gym.Wrapper):
    """An environment in a process of its own, which ends with the process that it works for.

    Ctrl-C is left to that process, which stops the run in order.
    """

    def __init__(self, make: Callable[[], gym.Env], owner: int) -> None:
        process = multiprocessing.parent_process()
        if process and os.getpid() != owner:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            end_when_closed(process.sentinel)
            try:
                super().__init__(_call(make))
            except (RaisedInWorkerError, UserError) as error:
                super().__init__(Unmade(error))
        else:  # the owner makes one, too, to look at its spaces
            super().__init__(make())

    def reset(self, **options: Any) -> Any:
        """The environment's. Raises `RaisedInWorkerError` for whatever it raises but a `UserError`."""
        return _call(self.env.reset, **options)

    def step(self, action: Any) -> Any:
        """The environment's. Raises `RaisedInWorkerError` for whatever it raises but a `UserError`."""
        return _call(self.env.step, action)

    def call_method(self, name: str, argument: Any) -> str | None:
        """The sentence of the `UserError` that the function `call_method` raises, which would end this process."""
        try:
            call_method(self.env, name, argument)
        except UserError as error:
            return str(error)


def call_method(env: gym.Env | VectorEnv, name: str, argument: Any) -> None:
    """Call a method of an environment or of one of its wrappers. Raises `UserError` if it is not there, or raises."""
    what = f"{type(env.unwrapped).__name__}.{name}"
    try:
        method = env.get_wrapper_attr(name) if isinstance(env, gym.Env) else getattr(env, name)
    except AttributeError:
        raise UserError(f"There is no method {what}, which the curriculum calls.") from None
    try:
        method(argument)
    except Exception as error:
        raise UserError(f"{what}({argument!r}), which the curriculum calls, raised {words_of(error)}.") from error


def _call(call: Callable[..., Any], *args: Any, **options: Any) -> Any:
    try:
        return call(*args, **options)
    except UserError as error:
        raise UserError(str(error)) from None
    except WorkerError as error:
        raise RaisedInWorkerError(str(error).rstrip(".")) from None
    except BaseException as error:  # also what ends a process: this one ends with its owner
        raise RaisedInWorkerError(told_with_place(error)) from None


class WatchedVectorEnv(AsyncVectorEnv):
    """Gymnasium's `AsyncVectorEnv`, with at most `patience` seconds for each answer."""

    patience: float = 60.0
    _is_broken = False
    """whether a worker has died or has not answered"""

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """Gymnasium's, with the timeout. Raises `WorkerError` if a worker died or does not answer."""
        return self._watched(lambda: self.reset_async(seed=seed, options=options), self.reset_wait)

    def step(self, actions: Any) -> Any:
        """Gymnasium's, with the timeout. Raises `WorkerError` if a worker died or does not answer."""
        return self._watched(lambda: self.step_async(actions), self.step_wait)

    def call_method(self, name: str, argument: Any) -> None:
        """Call a method of each environment. Raises `UserError` as `call_method`, and `WorkerError` as `step`."""
        ask = partial(self.call_async, "call_method", name, argument)
        if sentences := [said for said in self._watched(ask, self.call_wait) if said]:
            raise UserError(sentences[0])

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
        except (multiprocessing.TimeoutError, EOFError, ConnectionError):
            self._is_broken = True
            raise WorkerError(self._diagnosis()) from None

    def _raise_if_errors(self, successes: Iterable[bool]) -> None:
        """Gymnasium's, as one sentence that names the environment, and without waiting for a word that never comes."""
        failed = [index for index, success in enumerate(successes) if not success]
        if failed:
            said = f"Environment {failed[0]} failed"
            with suppress(queue.Empty):
                index, kind, error, _ = self.error_queue.get(timeout=5.0)
                if issubclass(kind, UserError):
                    raise error
                said = f"Environment {index} raised {error}"
            raise WorkerError(f"{said}.")

    def _diagnosis(self) -> str:
        # One that has just closed its pipe may not be dead yet.
        connection.wait([process.sentinel for process in self.processes], timeout=1.0)
        for i, process in enumerate(self.processes):
            if not process.is_alive():
                guard = " A script needs `if __name__ == '__main__':` before it." if process.exitcode == 1 else ""
                return f"The process of environment {i} died (exit code {process.exitcode}).{guard}"
        silent = [str(i) for i, pipe in enumerate(self.parent_pipes) if not pipe.poll(0)]
        return f"Environment {', '.join(silent) or 'unknown'} has not answered for {self.patience:g} s."

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """Ask every worker to close its environment; kill those that do not, or are in the middle of a step.

        Where one has not answered, all of them are killed at once.
        """
        terminate = terminate or self._is_broken or self._state is not AsyncState.DEFAULT
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
