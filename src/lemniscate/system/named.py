"""Objects of a user's own by name: `module:name` in a file, the object itself where it was passed in this process."""

import ast
import importlib
import inspect
import sys
from collections.abc import Callable
from copy import deepcopy
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

from lemniscate.errors import UserError

WHERE = "here; run in its folder, or add that folder to PYTHONPATH"
"""ends the sentence on a module that cannot be found"""

_PASSED: dict[str, Any] = {}
"""every object that was passed in this process, by its name; of two of one name, the later"""


class PassedName(str):
    """The name of an object that was passed in this process, which keeps the object itself.

    A Config that holds it goes on meaning that object where another one gets the same name, as a class does whose cell
    in a notebook is run again. Written to a file or sent to another process, it is text like any other.
    """

    thing: Any

    def __deepcopy__(self, memo: dict[int, Any]) -> "PassedName":
        return self

    def __reduce__(self) -> tuple[type[str], tuple[str]]:
        return str, (str(self),)


def name_of(thing: object) -> str:
    """The name by which `find` returns an object: `module:qualname`. A string is taken to be a name already.

    A lambda, a local class, a method of an object, and what a decorator has made of a function get a name too, with a
    number where another has it; it is of use in this process only.
    """
    if isinstance(thing, str):
        return thing
    module = getattr(thing, "__module__", type(thing).__module__)
    qualname = getattr(thing, "__qualname__", f"<{type(thing).__name__}>")
    if isinstance(owner := getattr(thing, "__self__", None), type):  # a method of a class, which may inherit it
        module, qualname = owner.__module__, f"{owner.__qualname__}.{getattr(thing, '__name__', '')}"
    if "<" not in qualname and not isinstance(thing, type) and not _stands(module, qualname, thing):
        qualname = f"<{qualname}>"
    name, number = f"{module}:{qualname}", 1
    while "<" in qualname and _PASSED.get(name, thing) is not thing:
        number += 1
        name = f"{module}:{qualname}#{number}"
    _PASSED[name] = thing
    passed = PassedName(name)
    passed.thing = thing
    return passed


def _stands(module: str, qualname: str, thing: object) -> bool:
    """Whether an object, or a function of the same code, stands in its module under this name."""
    found: Any = sys.modules.get(module)
    for part in qualname.split("."):
        found = getattr(found, part, None)
    code, bound = (getattr(found, name, None) for name in ("__code__", "__self__"))
    # The functions that a decorator makes share their code, and differ in what is closed over.
    alike = code is not None and code is getattr(thing, "__code__", None) and not code.co_freevars
    return found == thing or (alike and bound is getattr(thing, "__self__", None))


def is_passed(name: str) -> bool:
    """Whether an object of this name was passed in this process."""
    return isinstance(name, PassedName) or name in _PASSED


def find(name: str) -> Any:
    """The object that `name` names.

    Raises `UserError` for no such module or object, and for one that only the process that was given it can know.
    """
    if isinstance(name, PassedName):
        return name.thing
    if name in _PASSED:
        return _PASSED[name]
    found: Any = module_of(name)
    qualname = name.rpartition(":")[2]
    for part in qualname.split("."):
        if not hasattr(found, part):
            raise _absent(name, found, part)
        found = getattr(found, part)
    return found


def _absent(name: str, inside: Any, part: str) -> UserError:
    """The sentence for an object that is not in its module, or not in its class."""
    module_name, _, qualname = name.rpartition(":")
    if isinstance(inside, ModuleType) and not getattr(inside, "__file__", None) and hasattr(inside, "__path__"):
        return UserError(f"{name} cannot be found: {module_name} is a folder here; run inside of it.")
    known = {attribute.lower(): attribute for attribute in dir(inside)}
    near = get_close_matches(part.lower(), known, n=1)
    if module_name == "__main__":
        hint = "; it was defined in another program: pass the object again."
    elif near:
        hint = f": did you mean {known[near[0]]}?"
    else:
        hint = "."
    file = Path(getattr(inside, "__file__", None) or "")
    where = f" {module_name} is {file}." if file.name and not file.is_relative_to(Path.cwd()) else ""
    return UserError(f"{name} cannot be found: {module_name} has no {qualname}{hint}{where}")


def module_of(name: str) -> ModuleType:
    """The module of `module:name`, imported; it is looked for in the working directory too. Raises `UserError`."""
    module_name, _, qualname = name.rpartition(":")
    if not module_name or not qualname:
        raise UserError(f"{name!r} is no name of an object; it has the form module:name.")
    if module_name.endswith(".py") or "/" in module_name:
        module = f"{Path(module_name).stem}:{qualname}"
        raise UserError(f"{name} names a file; name its module, without folder and ending, in that folder: {module}.")
    if "<" in name:
        raise UserError(f"{name} is not kept in any file, since it was made inside a program: pass the object again.")
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    try:
        return importlib.import_module(module_name)
    except (ImportError, SyntaxError, ValueError, TypeError) as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing and f"{module_name}.".startswith(f"{missing}."):
            raise UserError(f"{name} cannot be found: there is no module {missing} {WHERE}.") from None
        raise UserError(f"{name} cannot be found: {error}.") from error
    except SystemExit:
        raise ends_program(module_name) from None


def ends_program(module: str) -> UserError:
    """The sentence on a module that calls sys.exit() when it is imported."""
    return UserError(f'{module} ends the program when it is imported: put that below if __name__ == "__main__":')


class WithArguments(partial[Any]):
    """A function with keyword arguments, copied for each call: what is called may change what it is given."""

    def __call__(self, /, *args: Any, **keywords: Any) -> Any:
        """The function's result."""
        return self.func(*args, **{**deepcopy(self.keywords), **keywords})


def takes(function: Any, count: int) -> bool:
    """Whether it can be called with so many arguments; what does not tell, such as a built-in function, may be."""
    try:
        inspect.signature(function).bind(*range(count))
    except ValueError:
        pass
    except TypeError:
        return False
    return callable(function)


def find_callable(text: str) -> Callable[..., Any]:
    """The function or class that `module:name` names, or with `module:name(key=value, …)` one with these arguments.

    The values are literals of Python: numbers, strings, True, None, and lists, tuples and dictionaries of these.

    Raises:
        UserError: as `find`; arguments that are no literals; an object that cannot be called.
    """
    name, opening, rest = (text, "", "") if is_passed(text) else text.partition("(")
    found = find(name if is_passed(text) else name.strip())
    if not callable(found):
        raise UserError(f"{name} is neither a function nor a class.")
    if not opening:
        return found
    try:
        call = ast.parse(f"f({rest}", mode="eval").body
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):  # such as f(a=1)(b=2)
            raise ValueError("not a call")
        if any(keyword.arg is None for keyword in call.keywords):
            raise ValueError("keywords without names")
        keywords = {str(keyword.arg): ast.literal_eval(keyword.value) for keyword in call.keywords}
        positional = [ast.literal_eval(value) for value in call.args]
    except (SyntaxError, ValueError) as error:
        raise UserError(f"{text!r} cannot be read; it has the form module:name(key=1.0, other='text').") from error
    if positional:
        raise UserError(f"The arguments of {name} need their names: {name}(key=value, …).")
    return WithArguments(found, **keywords)
