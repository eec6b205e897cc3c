"""The commands. What a program reads goes to standard output (`evaluate --json`), what a person reads to the error one.

Exit codes: 0 done, 1 training could not go on, 2 a mistake in what was asked, 130 stopped by Ctrl-C, 143 by SIGTERM.

Here the words are read, and nothing heavy is imported, so that help and most mistakes take no time; `fields` adds the
options of an algorithm's Config, which imports torch; `commands` works.
"""

import argparse
import atexit
import gc
import io
import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import pairwise, takewhile
from pathlib import Path
from shutil import get_terminal_size
from typing import Any, NoReturn

from lemniscate.algos import ALGORITHMS, RECOMMENDED
from lemniscate.errors import (
    NonFiniteError,
    NotStoredError,
    RankError,
    SweepError,
    UserError,
    WorkerError,
    is_installed,
    unknown_name,
)
from lemniscate.run.fields import read
from lemniscate.system.console import say, talks
from lemniscate.system.files import at_home

EARLIER = {"check": "doctor"}
"""names that commands had, which still work"""

SHELLS = ("bash", "zsh", "fish")

COMMANDS = {
    "train": "Train a policy, or one for each of several algorithms and seeds, to compare them.",
    "tune": "Search for the settings with which an algorithm learns an environment best.",
    "resume": "Continue an interrupted run, sweep or search.",
    "evaluate": "Play whole episodes with the newest policy of a run, or with one of your own.",
    "watch": "Show episodes in a window, or record them.",
    "export": "Write a policy as C for microcontrollers and as ONNX, and measure how far these are from it.",
    "preflight": "Measure how much delay, mass, wind and noise a policy bears, one at a time.",
    "plot": "Draw the curves of a run and its report.html, or compare several, grouped by all but the seed.",
    "push": "Upload the policy of a run to the Hugging Face Hub, with a page about it.",
    "envs": "List the environments, their backends, and the preset that fits.",
    "doctor": "Say what is wrong with a run, or with an environment before training, and what to change.",
    "course": "Lay out the course: notebooks with gaps to fill in and their checks, and a page on the order.",
    "grade": "Judge a folder of students' hand-ins: a table, every finding, a page for each.",
    "completion": "Print the script with which a shell completes; its first line says where to write it.",
}

USAGES = {
    "train": "lemniscate train [ALGORITHM] --env ID [--run DIR] [--preset NAME] [--FIELD VALUE …]",
    "tune": "lemniscate tune ALGORITHM --env ID --search RANGES [--trials INT] [--FIELD VALUE …]",
    "watch": "lemniscate watch RUN [options]\n       lemniscate watch --random --env ID [options]",
}
"""of the commands whose usage says more than argparse would"""

POLICY = "a run, a checkpoint or hf://user/name; or a .pt file or module:policy, with --env"
OPTIONS: list[tuple[str, str, str, Any]] = [
    ("train tune", "--env ID", "environment id, or module:Class of your own", None),
    ("train", "--run DIR", "run directory; must not exist [runs/…]", None),
    ("train", "--preset NAME", "tuned settings [those of the environment]", None),
    ("train", "--seeds LIST", "one run for each seed: 1-5 or 1,3,7", None),
    ("tune", "--run DIR", "directory of the search; must not exist [runs/…]", None),
    ("tune", "--preset NAME", "settings that are not searched [those of the environment]", None),
    ("tune", "--search RANGES", "fields as 'learning_rate=log:1e-4:1e-2, gamma=.9:.999, clip=0.1|0.2'", None),
    ("tune", "--trials INT", "number of settings that are tried [40]", 40),
    ("tune", "--seeds LIST", "seeds of each trial [101-103]", "101-103"),
    ("tune", "--[no-]prune", "end a trial after 1/9 or 1/3 of its steps if it is not among the best third [on]", True),
    ("resume", "run RUN", "a run, a sweep or a search", None),
    ("resume", "--total-steps INT", "go on to so many steps of the whole run [as it was to be]", None),
    ("train resume", "--track LOGGER", "another logger: wandb, or your own module:Class", None),
    ("train resume", "--callbacks FUNCTION …", "called after each logged line: module:function", None),
    ("train resume", "--processes INT", "processes of this machine for one run [1]", 1),
    ("train resume tune", "--cluster ray[=ADDRESS]", "train on Ray: --workers INT [--storage DIR]", None),
    ("train resume tune", "--workers INT", argparse.SUPPRESS, None),
    ("train resume tune", "--storage NAME", argparse.SUPPRESS, None),
    ("train resume tune", "--quiet", "no progress on standard error", True),
    ("train resume", "--report", "evaluate the policy, draw plots and videos", False),
    ("train resume", "--score", "store the final return over 100 episodes", False),
    ("evaluate watch", "--stochastic", "sample the policy's actions [take the most likely ones]", True),
    ("evaluate watch export", "--trust", "import the code (module:name) that a policy from hf:// names", False),
    ("evaluate watch export", "--checkpoint STEP", "best (see --keep-best), or a step [the newest]", None),
    ("export", "run RUN", "a run, a checkpoint or hf://user/name", None),
    ("evaluate", "policy RUN", POLICY, None),
    ("watch", "policy [RUN]", POLICY, None),
    ("evaluate watch", "--agent NAME", "module:Class that the weights of a .pt file are of [a course's]", None),
    ("evaluate watch", "--[no-]normalized-actions", "a .pt file acts in [-1, 1] [whichever returns more]", None),
    ("preflight", "run RUN", "a run", None),
    ("push", "run RUN", "a run or a checkpoint", None),
    ("export", "--to DIR", "new directory, or an export [RUN/export]", None),
    ("evaluate", "--episodes INT", "how many [100]", 100),
    ("watch", "--episodes INT", "how many [1]", 1),
    ("preflight", "--episodes INT", "how many [64]", 64),
    ("evaluate watch preflight", "--seed INT", "seed of the starts [0]", 0),
    ("evaluate watch preflight", "--env-args JSON", "arguments of the environment [as in training]", None),
    ("evaluate", "--backend NAME", "simulation backend [as in training]", None),
    ("evaluate", "--env ID", "environment [that of training]", None),
    ("evaluate", "--report DIR", "directory for a page with pictures and a video, plots/report.html", None),
    ("evaluate", "--baseline", "play by the environment's classical controller instead", False),
    ("evaluate", "--video FILE", ".gif, .webp or .mp4 to record all episodes into", None),
    ("grade", "folder FOLDER", "a .py file, a .ipynb file or a folder for each hand-in", None),
    ("grade", "--exercises LIST", "exercises that each hand-in must have: gae,Agent [those found]", ""),
    ("grade", "--to DIR", "where findings, pages and results go [FOLDER-grades]", None),
    ("grade", "--csv", "print the table as CSV on standard output", False),
    ("evaluate grade doctor", "--json", "print one JSON object on standard output", False),
    ("watch", "--sample", argparse.SUPPRESS, True),
    ("watch", "--random", "act uniformly at random", False),
    ("watch", "--video FILE", ".gif, .webp or .mp4 instead of a window", None),
    ("watch", "--env ID", "environment [that of training]; without RUN, with --random", None),
    ("preflight", "--compiled", "let the exported C act, RUN/export", False),
    ("plot", "runs RUN …", "runs or sweeps", None),
    ("plot", "--by AXIS", "learning curve by step, episode or minute [step]", "step"),
    ("push", "name USER/NAME", "repository; new, or of a policy to be replaced", None),
    ("push", "--private", "make a new repository private", False),
    ("push", "--license NAME", "licence on the page, as the Hub abbreviates it: mit [none]", None),
    ("envs", "filter [FILTER]", "a part of the id", ""),
    ("doctor", "what RUN|ENV", "a run, a sweep, an id, or module:Class of your own", None),
    ("doctor", "--env-args JSON", "arguments of the environment", None),
    ("doctor", "--wrappers NAME …", "wrappers, as in training", []),
    ("doctor", "--backend NAME", "simulation backend [chosen from the id]", None),
    ("course", "action start", "lay it out", None),
    ("course", "folder DIR", "where to; no file is overwritten", None),
    ("course", "--solutions", "the solutions too, in DIR/solutions", False),
    ("completion", "shell SHELL", ", ".join(SHELLS), None),
]
"""(commands, the option as the help shows it, its text, its default): all but the fields of a Config.

A flag whose default is True turns that off. What an option is called here or in `KEYWORDS` is the argument in Python.
"""

KEYWORDS = {"--env-args": "env_kwargs", "--quiet": "progress"}
KEYWORDS |= {"--stochastic": "deterministic", "--sample": "deterministic"}

KINDS = {"INT": int, "STEP": int, "JSON": dict}
PATHS = ("RUN", "DIR", "FILE", "FOLDER")
"""what stands for a path; Ray's storage may also be the address of one in a cloud"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    atexit.register(gc.freeze)  # else the interpreter spends a second on looking through torch for what to free
    command = None
    if "RANK" in os.environ:  # torch has whole pages to say of a connection that ends
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
    if isinstance(sys.stdout, io.TextIOWrapper):  # not every locale has the letters of a help
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        words = sys.argv[1:] if arguments is None else list(arguments)
        if words[:1] in (["train"], ["resume"]) and "torch" not in sys.modules and "RANK" not in os.environ:
            with suppress(Exception):  # a sandbox may not tell
                give_way(words)
        options = vars(parse(words))
        command = options.pop("command")
        from lemniscate.cli import commands  # imports torch

        getattr(commands, command)(**options)
    except SystemExit as done:  # argparse has printed help, or the version
        return int(done.code or 0)
    except BaseException as error:
        ended = ending(error, command)
        if ended is None:
            raise
        code, sentence = ended
        say(sentence)
        return code
    return 0


def give_way(words: Sequence[str]) -> None:
    """Have torch's threads wait for each other briefly, then sleep: at once where other programs keep the cores busy.

    Called before torch is imported, whose OpenMP reads it then. By itself a thread spins for milliseconds after each
    operation, on a core that the environments' threads need meanwhile; drones are simulated by no such threads.
    """
    import psutil  # takes as long as all of the help

    def free() -> float:
        busy = psutil.cpu_percent(interval=0.1, percpu=True)
        mine = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(len(busy))
        return sum(1 - busy[core] / 100 for core in mine)

    if all(free() < 1.5 for _ in range(8)):  # what ends in a moment is not to slow down a run of minutes
        os.environ.setdefault("GOMP_SPINCOUNT", "100")
    elif words[0] == "train" and not any(word.removeprefix("--env=").startswith("Drone") for word in words):
        os.environ.setdefault("GOMP_SPINCOUNT", "20000")


def ending(error: BaseException, command: str | None) -> tuple[int, str] | None:
    """The exit code and the sentence for what ended a command; None for a mistake of our own.

    The sentence is empty where another process of the run says it.
    """
    if isinstance(error, BrokenPipeError):  # whoever read the output has read enough
        return 141, ""
    if isinstance(error, UserError):
        return 2, str(error) if talks() else ""
    if isinstance(error, KeyboardInterrupt):  # a run that was asked to stop has a sentence of its own
        signum = getattr(error, "signum", None)
        return 128 + (signum or 2), str(error) or ("Interrupted." if signum is None else "")
    if isinstance(error, MemoryError):
        return 1, str(error) or "The memory is full: choose smaller numbers."
    if isinstance(error, OSError) and error.errno is not None:  # a disk that is full, a folder that cannot be written
        return 1, f"{error.filename or 'A file could not be written'}: {error.strerror}."
    if isinstance(error, NonFiniteError | WorkerError | RankError):
        stopped = " Training stopped; the last checkpoint is as it was." if command in ("train", "resume") else ""
        return 1, f"{error}{stopped}" if str(error) else ""
    return (1, str(error)) if isinstance(error, NotStoredError | SweepError) else None


class Parser(argparse.ArgumentParser):
    """argparse, but a mistake is one sentence, and help has a line for most options."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=_Help, **options)

    def error(self, message: str) -> NoReturn:
        """Raise what argparse has to say as a `UserError`."""
        raise UserError(f"{message[0].upper()}{message[1:]}; --help lists what there is.")

    def add(self, written: str, text: str, default: Any) -> None:
        """Add an option as the help shows it: `--flag`, `--[no-]flag`, `--flag METAVAR`, `name METAVAR`.

        Of a METAVAR with … there are several, and one in brackets may be missing.
        """
        name, _, metavar = written.partition(" ")
        shared: dict[str, Any] = {"help": text, "default": default}
        if name in KEYWORDS:
            shared["dest"] = KEYWORDS[name]
        if not metavar:
            switch = f"store_{str(not default).lower()}"
            action = argparse.BooleanOptionalAction if "[no-]" in name else switch
            self.add_argument(name.replace("[no-]", ""), action=action, **shared)
            return
        kind, several = metavar.removesuffix(" …"), metavar.endswith(" …")
        if metavar.startswith("["):
            kind, shared["nargs"] = metavar.strip("[]"), "?"
        elif several:
            shared["nargs"] = "+"
        hint = tuple[str, ...] if several else KINDS.get(kind, str)
        shared |= {"type": _path} if kind in PATHS else {"action": Read, "hint": hint}
        self.add_argument(name, metavar=kind, **shared)


def _path(text: str) -> Path:
    """A path, with `~` for the home folder; what argparse says where it is none is the sentence on it."""
    try:
        return at_home(text)
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


class Read(argparse.Action):
    """Keeps the value that a text, or several, stand for, where a field of this type would be meant."""

    def __init__(self, hint: Any, **options: Any) -> None:
        super().__init__(**options)
        self._hint = hint

    def __call__(
        self, parser: object, namespace: argparse.Namespace, values: Any, option_string: object = None
    ) -> None:
        """Raises `UserError` for what is no JSON."""
        setattr(namespace, self.dest, read(self.dest, self._hint, values))


class _Help(argparse.RawDescriptionHelpFormatter):
    """A wide first column; --[no-]flag where there are both; `INT …` for several; the epilog as it is."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=31, width=min(get_terminal_size((112, 24)).columns, 120) - 2)

    def _format_action_invocation(self, action: argparse.Action) -> str:
        if isinstance(action, argparse.BooleanOptionalAction):
            return action.option_strings[0].replace("--", "--[no-]", 1)
        if action.option_strings and action.nargs != 0:
            return f"{action.option_strings[0]} {action.metavar}{' …' if action.nargs == '+' else ''}"
        return super()._format_action_invocation(action)


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The command and its options. Raises `UserError` with one sentence on what is not understood."""
    words = _normalized(arguments) or ["help"]
    if words[0] == "help":
        words = [*words[1:2], "--help"]
    command = EARLIER.get(words[0], words[0])
    if command.startswith("-"):
        return _parse_none(words)
    if command not in COMMANDS:
        raise unknown_name("command", command, COMMANDS, otherwise=f"there is {', '.join(COMMANDS)}.")
    if command in ("train", "tune"):
        return _parse_algorithm(command, words[1:])
    parser = parser_of(command)
    given, rest = parser.parse_known_args(words[1:], argparse.Namespace(command=command))
    if rest:
        raise unknown_argument(rest, lambda flag: unknown_name("option", flag, flags_of(parser)))
    return given


def parser_of(command: str) -> Parser:
    """The parser of one command, without the fields of a Config."""
    parser = Parser(prog=f"lemniscate {command}", usage=USAGES.get(command), description=COMMANDS[command])
    for commands, written, text, default in OPTIONS:
        if command in commands.split():
            parser.add(written, text, default)
    return parser


def flags_of(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """The long options of a parser."""
    return {name: action for name, action in parser._option_string_actions.items() if name.startswith("--")}


def unknown_argument(rest: list[str], sentence_for: Callable[[str], UserError]) -> UserError:
    """The sentence for the arguments that no parser understood: `sentence_for` the first flag among them."""
    flags = [word.partition("=")[0] for word in rest if word.startswith("-")]
    is_switch = rest[0].lower() in ("true", "false", "on", "off", "yes", "no")
    hint = "a switch has no value: --flag or --no-flag." if is_switch else "--help lists what there is."
    return sentence_for(flags[0]) if flags else UserError(f"Unknown argument {rest[0]!r}; {hint}")


def _parse_none(words: list[str]) -> argparse.Namespace:
    """The words where no command is named: help and the version, which end the program, or a mistake."""
    parser = Parser(prog="lemniscate", description="Train, evaluate and watch reinforcement-learning policies.")
    version = ""
    if "--version" in words:
        from importlib import metadata  # takes as long as all of the help

        version = f"lemniscate {metadata.version('lemniscate')}"
    parser.add_argument("--version", action="version", version=version, help="print the version")
    commands = parser.add_subparsers(dest="command", required=True, title="commands", metavar="COMMAND")
    for name, text in COMMANDS.items():
        commands.add_parser(name, help=text)
    return parser.parse_args(words)


def _parse_algorithm(command: str, words: list[str]) -> argparse.Namespace:
    """The words of `train` and `tune`, which begin with an algorithm."""
    verb = f"lemniscate {command}"
    asks = "-h" in words or "--help" in words
    if asks and (words[0].startswith("-") or "," in words[0]):
        _print_help(command)
    apart = list(takewhile(ALGORITHMS.__contains__, (word.strip(",") for word in words)))
    if len(apart) > 1:
        raise UserError(f"Several algorithms are one word: lemniscate train {','.join(apart)} --seeds 1-5 …")
    names = list(dict.fromkeys(words[0].split(","))) if words and not words[0].startswith("-") else []
    if command == "tune" and len(names) > 1:
        raise UserError(f"A search is for one algorithm: {verb} {names[0]} …")
    strangers = [name for name in names if name not in ALGORITHMS and not _is_own(name)]
    pairs = pairwise(["", *words])  # what follows an option is its value
    misplaced = [word for before, word in pairs if word in ALGORITHMS and not before.startswith("--")]
    if misplaced and (strangers or not names):
        raise UserError(f"The algorithm comes first, then its fields: {verb} {misplaced[0]} …")
    unnamed = command == "train" and not names and any(re.match("--env(=|$)", word) for word in words)
    if unnamed:
        names, words = [RECOMMENDED], [RECOMMENDED, *words]
    if not names:
        raise UserError(f"Which algorithm? {verb} ALGORITHM …, with one of {', '.join(ALGORITHMS)}.")
    if strangers:
        raise unknown_name("algorithm", strangers[0], ALGORITHMS)
    from lemniscate.cli.fields import parse_fields  # imports torch

    given = parse_fields(command, names, words[1:])
    if unnamed and talks():
        why = "takes every kind of actions and, mostly, needs the fewest minutes"
        say(f"No algorithm is named: {RECOMMENDED} {why}.")
    return given


def algorithms() -> dict[str, str]:
    """The algorithms, and the first line of each file, read from there: to import them is to import torch."""
    folder = Path(__file__).parents[1] / "algos"
    lines = {name: (folder / f"{name}.py").read_text("utf-8").partition("\n")[0] for name in ALGORITHMS}
    return {name: line.removeprefix('"""') for name, line in lines.items()}


def _print_help(command: str) -> NoReturn:
    """Print the options that all algorithms share, and the algorithms; ends the program."""
    parser = parser_of(command)
    listed = "\n".join(f"  {name:<12}{title}" for name, title in algorithms().items())
    several = "several, such as ppo,sac, with --seeds; " if command == "train" else ""
    parser.epilog = f"algorithms ({several}or a module of your own; ppo --help lists the fields of ppo):\n{listed}"
    parser.print_help()
    parser.exit()


def _is_own(name: str) -> bool:
    """Whether `name` is of somebody's own algorithm: a module that is there, one in a package, or `module:name`."""
    if not name.isidentifier():
        return all(part.isidentifier() for part in re.split(r"[.:]", name))
    return Path(f"{name}.py").exists() or Path(name).is_dir() or is_installed(name)


def _normalized(arguments: Sequence[str]) -> list[str]:
    """Flags with dashes for underscores, and a negative number joined to its flag, which argparse would misread."""
    words: list[str] = []
    for word in arguments:
        if words and re.match(r"-[\d.]", word) and re.fullmatch(r"--[\w-]+", words[-1]):
            words[-1] += f"={word}"
        elif word.startswith("--"):
            flag, equals, value = word.partition("=")
            words.append(flag.replace("_", "-") + equals + value)
        else:
            words.append(word)
    return words
