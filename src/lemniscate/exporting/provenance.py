"""Which lemniscate writes."""

import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as version_of
from pathlib import Path


def version() -> str:
    """The version of lemniscate."""
    try:
        return version_of("lemniscate")
    except PackageNotFoundError:
        return "unknown"


@cache
def commit() -> str | None:
    """The commit of its source, where it runs from its repository."""
    folder = Path(__file__).parent
    try:
        for command in (["ls-files", "--error-unmatch", "__init__.py"], ["rev-parse", "HEAD"]):
            done = subprocess.run(["git", *command], cwd=folder, capture_output=True, text=True, timeout=10, check=True)
        return done.stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
