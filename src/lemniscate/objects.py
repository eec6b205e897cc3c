"""Python objects by name: `module:name`, found by import, or kept from this process where no import finds them."""

import importlib
import sys
from pathlib import Path
from typing import Any

from lemniscate.errors import UserError

_KNOWN: dict[str, Any] = {}


def name_of(thing: Any) -> str:
    """The name `module:name` under which `find_object` returns `thing` in this process."""
    name = f"{thing.__module__}:{thing.__qualname__}"
    _KNOWN[name] = thing
    return name


def find_object(name: str, kind: str) -> Any:
    """The object called `module:name`; a module is looked for in the working directory too.

    Raises:
        UserError: it cannot be imported; one that was passed in Python has to be passed again.
    """
    if name in _KNOWN:
        return _KNOWN[name]
    module_name, _, path = name.rpartition(":")
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        thing = importlib.import_module(module_name)
        for part in path.split("."):
            thing = getattr(thing, part)
    except ImportError as error:
        raise UserError(f"The {kind} {name} cannot be imported: {error}.") from error
    except AttributeError:
        if "<" in path or module_name == "__main__":
            raise UserError(
                f"The {kind} {name} was an object of another process and cannot be found by name: pass it again,"
                " or define it in a module."
            ) from None
        raise UserError(f"The {kind} {name} cannot be found: {module_name} has no {path}.") from None
    return thing
