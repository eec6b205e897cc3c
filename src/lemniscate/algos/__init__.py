"""The algorithms. One file each, with the same names in the same order; one name each in this table."""

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from lemniscate.errors import UserError, shown, unknown_name
from lemniscate.system import named

ALGORITHMS = ("reinforce", "a2c", "trpo", "ppo", "reppo", "pqn", "shac", "ddpg", "td3", "sac")

RECOMMENDED = "ppo"
"""for who names none: it takes every kind of actions, and mostly needs the fewest minutes (docs/results.md)"""


def find(algorithm: str | ModuleType) -> Any:
    """The module of an algorithm: one in `ALGORITHMS`, one's own by its name `module` or `module:name`, or itself.

    A module of one's own is looked for in the working directory too.

    Raises:
        UserError: there is no such module, it cannot be imported, or it lacks `Config` or `train`.
    """
    if isinstance(algorithm, str) and algorithm in ALGORITHMS:
        return import_module(f"{__name__}.{algorithm}")
    own = _import(algorithm) if isinstance(algorithm, str) else algorithm
    missing = [name for name in ("Config", "train") if not hasattr(own, name)]  # `testing` checks the rest
    if missing:
        name = algorithm if isinstance(algorithm, str) else getattr(own, "__name__", shown(own))
        raise UserError(f"{name} is not an algorithm: it has no {' and no '.join(missing)}.")
    return own


def name_of(algorithm: str | ModuleType) -> str:
    """The name under which `find` returns an algorithm. Raises `UserError` as `find` does."""
    found = find(algorithm)
    theirs = found.Config.__module__
    if theirs.startswith(f"{__name__}.") and theirs != found.__name__:
        given = theirs.rpartition(".")[2]
        raise UserError(f"The Config of {found.__name__} is that of {given}: write class Config({given}.Config) in it.")
    return algorithm if isinstance(algorithm, str) else found.__name__.removeprefix(f"{__name__}.")


def _import(name: str) -> Any:
    if name.endswith(".py"):
        raise UserError(f"{name} is a file: name its module, {Path(name).stem}.")
    if not name or name.startswith("."):
        raise unknown_name("algorithm", name, ALGORITHMS)
    if ":" in name:
        return named.find(name)
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        return import_module(name)
    except (ImportError, SyntaxError, ValueError, TypeError) as error:
        if isinstance(error, ModuleNotFoundError) and error.name in (name, name.partition(".")[0]):
            said = unknown_name("algorithm", name, ALGORITHMS)
            raise UserError(f"{said} A module of your own is not {named.WHERE}.") from None
        raise UserError(f"The algorithm {name} cannot be imported: {error}.") from error
    except SystemExit:
        raise named.ends_program(name) from None
