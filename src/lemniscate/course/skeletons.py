"""Whole programs to fill in: what stands between `# <solution>` and `# </solution>` in the original is left out."""

import re
from pathlib import Path

from lemniscate.errors import UserError, unknown_name

SKELETONS = {"ppo": "ppo_from_scratch.py"}
SOLUTION = re.compile(r"^( *)# <solution>\n.*?# </solution>\n", re.DOTALL | re.MULTILINE)


def skeleton(name: str = "ppo", path: str | Path | None = None) -> Path:
    """Write a training loop to fill in, as one file that runs by itself and checks itself.

    Args:
        name: ppo.
        path: the new file; by default `ppo.py` here.

    Raises:
        UserError: an unknown name; a file that exists, or cannot be written.
    """
    if name not in SKELETONS:
        raise unknown_name("skeleton", name, SKELETONS)
    path = Path(path or f"{name}.py")
    if path.exists():
        raise UserError(f"{path} exists already; name another file with path.")
    try:
        path.write_text(text(name).replace(f"python {name}.py", f"python {path.name}"))
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}.") from error
    return path


def text(name: str) -> str:
    """The program with its gaps."""
    whole = (Path(__file__).parent / SKELETONS[name]).read_text()
    return SOLUTION.sub(r'\1raise NotImplementedError("to be written")\n', whole)
