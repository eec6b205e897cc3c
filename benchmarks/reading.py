"""What a reader of the source has to read: the code that runs, and the imports between the rooms.

    .venv/bin/python benchmarks/reading.py            both tables
    .venv/bin/python benchmarks/reading.py --files    also each file of the first table, and each arrow of the second
    .venv/bin/python benchmarks/reading.py --json     the same for a program

The code that runs, traced line by line: the third iteration of PPO and of SAC (act, learn, log, and the loop around
them), when nothing is warmed up any more, and the whole command `lemniscate train ppo`, what it imports included.
Counted are the files, all their lines, the executed lines and the functions entered. Formatting changes the second
number, but hardly the last two.

The imports: a room is a folder of the source or a module beside the folders; `__init__`, the table of the public names,
and `__main__` are none. An arrow is the imports of one room in another, wherever they stand: also inside functions and
under TYPE_CHECKING. The floor of a room is one above the highest of those it imports. An arrow upwards is one against
the layers of import-linter in pyproject.toml.
"""

import argparse
import ast
import io
import json
import sys
import tempfile
import tomllib
import warnings
from collections import defaultdict
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "lemniscate"

ITERATIONS: dict[str, dict[str, Any]] = {
    "ppo": {"num_envs": 4, "num_steps": 64, "minibatch_size": 64, "epochs": 2, "total_steps": 2048},
    "sac": {
        "num_envs": 1,
        "total_steps": 200,
        "learning_starts": 10,
        "batch_size": 8,
        "hidden": (8,),
        "critic_hidden": (8,),
        "log_every": 5,
    },
}
COMMAND = "train ppo --env Pendulum-v1 --total-steps 2048 --num-envs 4 --num-steps 64 --minibatch-size 64 --epochs 2"


class Trace:
    """The lines executed and the functions entered between `start` and `stop`, by file of the package."""

    def __init__(self) -> None:
        self.lines: dict[str, set[int]] = defaultdict(set)
        self.functions: dict[str, set[str]] = defaultdict(set)
        self._package = f"{SOURCE}/"

    def start(self, frame: FrameType | None = None) -> None:
        """Trace every call from here on, and the rest of the functions that are running in `frame` and below it."""
        while frame is not None:
            if frame.f_code.co_filename.startswith(self._package):
                frame.f_trace = self._executed
            frame = frame.f_back
        sys.settrace(self._entered)

    def stop(self) -> None:
        """Trace nothing more."""
        sys.settrace(None)

    def _entered(self, frame: FrameType, event: str, arg: object) -> Callable | None:
        code = frame.f_code
        if not code.co_filename.startswith(self._package):
            return None
        if code.co_name != "<module>":  # an import: its lines are executed, but it is not called by anybody
            self.functions[code.co_filename].add(code.co_qualname)
        return self._executed

    def _executed(self, frame: FrameType, event: str, arg: object) -> Callable:
        if event == "line":
            self.lines[frame.f_code.co_filename].add(frame.f_lineno)
        return self._executed

    def rows(self) -> list[tuple[str, int, int, int]]:
        """(file, its lines, those executed, functions entered) of each file, the most executed first."""
        files = sorted(self.lines, key=lambda file: -len(self.lines[file]))
        return [
            (file.removeprefix(self._package), length(Path(file)), len(self.lines[file]), len(self.functions[file]))
            for file in files
        ]


def length(file: Path) -> int:
    """The number of lines of a file."""
    return len(file.read_text().splitlines())


def trace_iteration(algorithm: str) -> Trace:
    """One iteration of training, from the callback of the second line of metrics to that of the third."""
    import lemniscate as lem

    trace, calls = Trace(), []

    def observe(step: int, metrics: object, policy: object) -> None:
        calls.append(step)
        if len(calls) == 2:
            trace.start(sys._getframe(1))  # the callback itself is no part of the source
        elif len(calls) == 3:
            trace.stop()

    with QuietFolder() as folder:
        settings = ITERATIONS[algorithm]
        lem.train(algorithm, "Pendulum-v1", run=folder / "run", callbacks=[observe], compile="off", **settings)
    assert len(calls) >= 3, f"{algorithm} logged {len(calls)} lines; the third one ends the trace"
    return trace


def trace_command() -> Trace:
    """The whole command."""
    from lemniscate import cli

    trace = Trace()
    with QuietFolder() as folder:
        words = [*COMMAND.split(), "--run", str(folder / "run")]
        trace.start()
        try:
            with suppress(SystemExit):
                cli.main(words)
        finally:
            trace.stop()
    return trace


class QuietFolder(tempfile.TemporaryDirectory):
    """A folder that is removed afterwards, as a `Path`; meanwhile nothing is printed."""

    def __enter__(self) -> Path:
        self._silence = redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO())
        for stream in self._silence:
            stream.__enter__()
        return Path(super().__enter__())

    def __exit__(self, *raised: Any) -> None:
        for stream in self._silence:
            stream.__exit__(*raised)
        super().__exit__(*raised)


def trace_all() -> dict[str, Trace]:
    """All traces, by name. In this order and in a new process, since what is imported already is not traced again."""
    import torch

    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    return {
        "an iteration of ppo": trace_iteration("ppo"),
        "an iteration of sac": trace_iteration("sac"),
        "lemniscate train ppo": trace_command(),
    }


class Graph:
    """The rooms of the source and the arrows between them.

    Args:
        source: the folder of the package.
        layers: the rooms by layer, the highest first, as import-linter's contract has them.
    """

    def __init__(self, source: Path, layers: list[set[str]]) -> None:
        self._source, self._layers = source, layers
        files = [file.relative_to(source) for file in sorted(source.rglob("*.py"))]
        self.loose = {file.stem for file in files if len(file.parts) == 1}
        """the modules beside the folders, `__init__` and `__main__` among them"""
        self.rooms = {file.with_suffix("").parts[0] for file in files} - {"__init__", "__main__"}
        self.arrows: dict[tuple[str, str], set[str]] = defaultdict(set)
        """the imports behind each arrow, as "file imports module", by (importing room, imported room)"""
        for file in files:
            self._read(file)

    def _read(self, file: Path) -> None:
        here = file.with_suffix("").parts[0]
        for node in ast.walk(ast.parse((self._source / file).read_text())):
            for module in imported(node):
                package, _, rest = module.partition(".")
                there = rest.partition(".")[0]
                if package == self._source.name and {here, there} <= self.rooms and here != there:
                    self.arrows[here, there].add(f"{file} imports {module}")

    @cached_property
    def circles(self) -> set[str]:
        """The rooms that are in a circle, or on a way from one circle to another."""
        left = set(self.rooms)
        while True:
            inside = [arrow for arrow in self.arrows if left.issuperset(arrow)]
            import_one, are_imported = ({arrow[end] for arrow in inside} for end in (0, 1))
            if left == import_one & are_imported:
                return left
            left = import_one & are_imported

    @property
    def floors(self) -> int:
        """The number of floors; 0 where a circle leaves none."""
        floor: dict[str, int] = {}
        while not self.circles and len(floor) < len(self.rooms):
            for room in self.rooms - floor.keys():
                below = [there for here, there in self.arrows if here == room]
                if all(there in floor for there in below):
                    floor[room] = 1 + max((floor[there] for there in below), default=0)
        return max(floor.values(), default=0)

    @property
    def upwards(self) -> list[tuple[str, str]]:
        """The arrows that do not lead to a lower layer, those of a room that no layer has among them."""
        height = {room: -number for number, layer in enumerate(self._layers) for room in layer}
        nowhere = self.rooms - height.keys()
        return [arrow for arrow in self.arrows if nowhere & set(arrow) or height[arrow[0]] <= height[arrow[1]]]


def imported(node: ast.AST) -> list[str]:
    """The modules that a statement imports; of `from a import b` it is a.b, which may be a module."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom) and node.module and not node.level:
        return [f"{node.module}.{alias.name}" for alias in node.names]
    return []


def layers_of(project: Path) -> list[set[str]]:
    """The rooms by layer, the highest first: the contract "layers" of import-linter in pyproject.toml."""
    contracts = tomllib.loads(project.read_text())["tool"]["importlinter"]["contracts"]
    (layers,) = (contract["layers"] for contract in contracts if contract["type"] == "layers")
    return [{name.strip() for name in layer.split("|")} for layer in layers]


def graph() -> Graph:
    """The graph of this project's source."""
    return Graph(SOURCE, layers_of(ROOT / "pyproject.toml"))


def measure() -> tuple[dict[str, dict[str, int]], dict[str, list[tuple[str, int, int, int]]]]:
    """Every number by row and column, and the files behind the traced rows. To be called in a new process."""
    files = {name: trace.rows() for name, trace in trace_all().items()}
    found = {}
    for name, rows in files.items():
        _, lines, executed, functions = zip(*rows, strict=True)
        found[name] = {
            "files": len(rows),
            "lines": sum(lines),
            "executed": sum(executed),
            "functions": sum(functions),
        }
    source = list(SOURCE.rglob("*.py"))
    found["all of the source"] = {"files": len(source), "lines": sum(map(length, source))}
    rooms = graph()
    found["imports"] = {
        "rooms": len(rooms.rooms),
        "floors": rooms.floors,
        "arrows": len(rooms.arrows),
        "loose": len(rooms.loose),
        "upwards": len(rooms.upwards),
        "circles": len(rooms.circles),
    }
    return found, files


def print_tables(detail: bool) -> None:
    """Both tables."""
    found, files = measure()
    imports = found.pop("imports")
    print(f"{'':<34}{'files':>6}{'lines':>8}{'executed':>10}{'functions':>11}")
    for name, counts in found.items():
        columns = zip(counts.values(), (6, 8, 10, 11), strict=False)  # all of the source has the first two
        print(f"{name:<34}" + "".join(f"{count:>{width}}" for count, width in columns))
        for file, *counted in files.get(name, ()) if detail else ():
            print(f"    {file:<36}" + "".join(f"{n:>{width}}" for n, width in zip(counted, (8, 10, 11), strict=True)))
    print(", ".join(f"{name} {count}" for name, count in imports.items()))
    rooms = graph()
    print("upwards:", ", ".join(f"{here} → {there}" for here, there in rooms.upwards) or "none")
    print("in a circle, or between two:", ", ".join(sorted(rooms.circles)) or "none")
    for (here, there), behind in sorted(rooms.arrows.items()) if detail else ():
        print(f"    {here} → {there}", *sorted(behind), sep="\n        ")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", action="store_true", help="also each file and each arrow")
    parser.add_argument("--json", action="store_true", help="one object on standard output")
    given = parser.parse_args()
    if given.json:
        print(json.dumps(measure()))
    else:
        print_tables(given.files)


if __name__ == "__main__":
    main()
