"""Gymnasium environments, with a process for each."""

from collections.abc import Collection

from lemniscate.envs.gymnasium import GymnasiumBackend


class AsyncGymnasiumBackend(GymnasiumBackend):
    """The same, with a process for each environment. No id is served so unless it is asked for."""

    workers = True
    in_process = "gymnasium"
    """the backend that evaluates what this one trained"""

    @classmethod
    def ids(cls) -> Collection[str]:
        """None."""
        return ()

    @classmethod
    def room(cls, env: str) -> tuple[int, int]:
        """The memory and files of a Python process with NumPy and Gymnasium, and of its pipes."""
        return 100_000_000, 5
