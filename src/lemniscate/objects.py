"""Python objects by name: `module:name`, found by import, or kept from this process where no import finds them."""

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from lemniscate.errors import UserError, unknown_name

_KEPT: dict[str, Any] = {}


def name_of(thing: Any) -> str:
    """The name `module:name` under which `find_object` returns a class or function in this process.

    In another process it is found if its module can be imported there, and it is neither local nor a lambda.
    """
    name = f"{thing.__module__}:{thing.__qualname__}"
    _KEPT[name] = thing
    return name


def find_object(name: str, kind: str) -> Any:
    """The object called `module:name`; a module is looked for in the working directory too.

    Args:
        name: module and name, with a colon between them.
        kind: what it is to be, for the sentence of the error.

    Raises:
        UserError: no such module, or no such name in it; an object of another process, which has to be passed again.
    """
    if name in _KEPT:
        return _KEPT[name]
    module_name, _, path = name.rpartition(":")
    if not module_name:
        raise UserError(f"The {kind} must be named as module:name, not {name!r}.")
    if "<" in path or module_name == "__main__":
        raise UserError(f"The {kind} {name} was an object of another process: pass it again, or put it into a module.")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        thing = import_module(module_name)
    except ImportError as error:
        raise UserError(f"The {kind} {name} cannot be imported: {error}.") from error
    for part in path.split("."):
        if not hasattr(thing, part):
            names = (known for known in vars(thing) if not known.startswith("_"))
            raise unknown_name(f"{kind} in {module_name}", part, names)
        thing = getattr(thing, part)
    return thing
