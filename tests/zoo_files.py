"""The zoo of solutions: `tests/zoo/<exercise>.<hand>.py` are plain text with many modules in each.

A solution begins with a line `# === right: <title>` or `# === wrong: <cause> | <regular expression>`, and goes on to
the next such line. The expression is what a sentence that names the cause matches, whatever its case. A solution that
differs from the last one that is written out in a few lines has those alone: `# --- instead of`, `# --- here`.
"""

import linecache
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

ZOO = Path(__file__).parent / "zoo"
HEAD = re.compile(r"^# === (right|wrong): (.*?)(?: \| (.*))?$", re.MULTILINE)
EDIT = re.compile(r"^# --- instead of\n(.*?)^# --- here\n(.*?)(?=^# --- instead of\n|\Z)", re.MULTILINE | re.DOTALL)
WHERE = re.compile(r"^# solution: (\S+)", re.MULTILINE)


class Solution(NamedTuple):
    """One solution: right or wrong, its title, what names its cause ("" of a right one), its code, where it stands."""

    kind: str
    title: str
    regex: str
    code: str
    name: str  # `gae`, or `Trainer.gae` after a line `# solution: Trainer.gae`


def load(path: Path) -> list[Solution]:
    """The solutions of a file, in its order."""
    text, exercise = path.read_text(), path.name.split(".")[0]
    heads = list(HEAD.finditer(text))
    ends = [head.start() for head in heads[1:]] + [len(text)]
    solutions, whole = [], ""
    for head, end in zip(heads, ends, strict=True):
        code = text[head.end() : end].strip("\n") + "\n"
        if edits := EDIT.findall(code):
            code = whole
            for old, new in edits:
                assert code.count(old) == 1, (path.name, head[2], old)
                code = code.replace(old, new)
        else:
            whole = code
        where = WHERE.search(code)
        solutions.append(Solution(head[1], head[2], head[3] or "", code, where[1] if where else exercise))
    return solutions


def execute(solution: Solution, module_name: str) -> ModuleType:
    """The code as a module of its own, whose source `inspect` and tracebacks find."""
    module = ModuleType(module_name)
    module.__file__ = f"<{module_name}>"
    lines = solution.code.splitlines(keepends=True)
    linecache.cache[module.__file__] = (len(solution.code), None, lines, module.__file__)
    sys.modules[module_name] = module
    exec(compile(solution.code, module.__file__, "exec"), module.__dict__)
    return module


def find(module: ModuleType, name: str) -> Any:
    """The solution in its module: the function of that name, or the method of the first class that has one."""
    if "." in name or hasattr(module, name):
        found = module
        for part in name.split("."):
            found = getattr(found, part)
        return found
    classes = [thing for thing in vars(module).values() if isinstance(thing, type) and hasattr(thing, name)]
    # The last one: its constructor may be what a class that it inherits from does not have.
    return next(getattr(thing, name) for thing in reversed(classes) if thing.__module__ == module.__name__)
