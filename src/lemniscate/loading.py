"""Objects of a user's own modules, named as `module:Name`."""

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from lemniscate.errors import UserError, unknown_name


def load_object(kind: str, reference: str) -> Any:
    """The object called `reference`, such as "my_module:MyClass". The working directory is searched too.

    Args:
        kind: what it is to be, for the sentence of the error.
        reference: module and name, with a colon between them.

    Raises:
        UserError: no such module, or no such name in it.
    """
    module_name, _, name = reference.rpartition(":")
    if not module_name:
        raise UserError(f"{kind} must be named as module:name, not {reference!r}.")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        module = import_module(module_name)
    except ImportError as error:
        raise UserError(f"{kind} {reference} cannot be loaded: {error}.") from error
    if not hasattr(module, name):
        names = (known for known in vars(module) if not known.startswith("_"))
        raise UserError(f"{kind} {reference} cannot be loaded. {unknown_name(f'name in {module_name}', name, names)}")
    return getattr(module, name)
