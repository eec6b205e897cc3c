"""The commands. What a program reads goes to standard output (`evaluate --json`), what a person reads to the error one.

Exit codes: 0 done, 1 training could not go on, 2 a mistake in what was asked, 130 stopped by Ctrl-C, 143 by SIGTERM.

This module is light: help, and a mistake that is seen without torch, take no time. `training` and `inspection` work.
"""

import argparse
import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from shutil import get_terminal_size
from typing import Any, NoReturn

from lemniscate import __version__
from lemniscate.algos import ALGORITHMS, RECOMMENDED
from lemniscate.cli.endings import exit_code, sentence, unknown_argument
from lemniscate.errors import UserError, is_installed, unknown_name
from lemniscate.system.console import say

COMMANDS = {
    "train": "Train a policy, or one for each of several algorithms and seeds, to compare them.",
    "tune": "Search for the settings with which an algorithm learns an environment best.",
    "resume": "Continue an interrupted run, sweep or search.",
    "evaluate": "Play whole episodes with the newest policy of a run.",
    "watch": "Show episodes in a window, or record them.",
    "export": "Write a policy as C for microcontrollers and as ONNX, and measure how far these are from it.",
    "preflight": "Measure how much delay, mass, wind and noise a policy bears, one at a time.",
    "plot": "Draw the curves of a run and its report.html, or compare several, grouped by all but the seed.",
    "push": "Upload the policy of a run to the Hugging Face Hub, with a page about it.",
    "envs": "List the environments, their backends, and the preset that fits.",
    "check": "Check that an environment is suitable for training, or that the files of a run are whole.",
    "completion": "Print the script with which a shell completes; its first line says where to write it.",
}

TRAINING = ("train", "tune", "resume")
SHELLS = ("bash", "zsh", "fish")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    given = argparse.Namespace(command=None)
    if "RANK" in os.environ:  # torch has whole pages to say of a connection that ends
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
    try:
        given = parse(sys.argv[1:] if arguments is None else arguments)
        work = import_module(f"lemniscate.cli.{'training' if given.command in TRAINING else 'inspection'}")
        getattr(work, given.command)(given)
    except SystemExit as done:  # argparse has printed help, or the version
        return int(done.code or 0)
    except BaseException as error:
        code = exit_code(error)
        if code is None:
            raise
        say(sentence(error, given.command))
        return code
    return 0


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The command and its options. Raises `UserError` with one sentence on what is not understood."""
    words = _normalized(arguments) or ["--help"]
    parser, commands = parsers()
    if not words[0].startswith("-"):
        if words[0] not in COMMANDS:
            raise unknown_name("command", words[0], COMMANDS)
        if words[0] in ("train", "tune"):
            return _parse_algorithm(words[0], commands[words[0]], words[1:])
    given, rest = parser.parse_known_args(words)
    if rest:
        options = [option for option in commands[given.command]._option_string_actions if option.startswith("--")]
        raise unknown_argument(rest, lambda flag: unknown_name("option", flag, options))
    return given


def add_train_options(parser: argparse.ArgumentParser) -> None:
    """The options of `lemniscate train` besides the fields of a Config."""
    parser.add_argument("--env", metavar="ID", help="environment id, or module:Class of your own")
    parser.add_argument("--run", type=Path, metavar="DIR", help="run directory; must not exist [runs/…]")
    parser.add_argument("--preset", metavar="NAME", help="tuned settings [those of the environment]")
    parser.add_argument("--seeds", metavar="LIST", help="one run for each seed: 1-5 or 1,3,7")
    _add_endings(parser)


class Parser(argparse.ArgumentParser):
    """argparse, but a mistake is one sentence, and help has a line for most options."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=_Help, **options)

    def error(self, message: str) -> NoReturn:
        """Raise the `UserError` for a value that is missing."""
        raise UserError(f"{message[0].upper()}{message[1:]}; --help lists what there is.")


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


def parsers() -> tuple[Parser, dict[str, Parser]]:
    """The parser of everything, and that of each command."""
    parser = Parser(prog="lemniscate", description="Train, evaluate and watch reinforcement-learning policies.")
    parser.add_argument("--version", action="version", version=f"lemniscate {__version__}", help="print the version")
    commands = parser.add_subparsers(dest="command", required=True, title="commands", metavar="COMMAND")
    subs = {name: commands.add_parser(name, help=text, description=text) for name, text in COMMANDS.items()}
    subs["train"].usage = "lemniscate train [ALGORITHM] --env ID [--run DIR] [--preset NAME] [--FIELD VALUE …]"
    subs["tune"].usage = "lemniscate tune ALGORITHM --env ID --search RANGES [--trials INT] [--FIELD VALUE …]"

    subs["resume"].add_argument("run", type=Path, metavar="RUN", help="a run, a sweep or a search")
    _add_endings(subs["resume"])
    for name in ("resume", "evaluate", "watch", "export", "preflight", "plot", "push"):
        subs[name].add_argument(
            "--trust", action="store_true", help="import a run's own code (module:name) also if the run is not yours"
        )

    for name in ("export", "evaluate", "preflight"):
        known = "a run" if name == "preflight" else "a run, a checkpoint or hf://user/name"
        subs[name].add_argument("run", type=Path, metavar="RUN", help=known)
    subs["export"].add_argument("--to", type=Path, metavar="DIR", help="new directory, or an export [RUN/export]")
    for sub, episodes in ((subs["preflight"], 64), (subs["evaluate"], 100), (subs["watch"], 1)):
        sub.add_argument("--episodes", default=episodes, metavar="INT", help=f"how many [{episodes}]")
        sub.add_argument("--seed", default=0, metavar="INT", help="seed of the starts [0]")
        sub.add_argument("--env-args", metavar="JSON", help="arguments of the environment [as in training]")
    sub = subs["evaluate"]
    sub.add_argument("--backend", metavar="NAME", help="simulation backend [as in training]")
    sub.add_argument("--baseline", action="store_true", help="play by the environment's classical controller instead")
    sub.add_argument("--video", type=Path, metavar="FILE", help=".gif, .webp or .mp4 to record all episodes into")
    sub.add_argument("--json", action="store_true", help="print one JSON object on standard output")

    sub = subs["watch"]
    sub.usage = "lemniscate watch RUN [options]\n       lemniscate watch --random --env ID [options]"
    sub.add_argument("run", type=Path, nargs="?", metavar="RUN", help="a run, a checkpoint or hf://user/name")
    sub.add_argument("--sample", action="store_true", help="draw actions from the policy [the most likely ones]")
    sub.add_argument("--random", action="store_true", help="act uniformly at random")
    sub.add_argument("--video", type=Path, metavar="FILE", help=".gif, .webp or .mp4 instead of a window")
    sub.add_argument("--env", metavar="ID", help="environment [that of training]; without RUN, with --random")

    subs["preflight"].add_argument("--compiled", action="store_true", help="let the exported C act, RUN/export")
    subs["plot"].add_argument("runs", type=Path, nargs="+", metavar="RUN", help="runs or sweeps")
    subs["plot"].add_argument(
        "--by", default="step", metavar="AXIS", help="learning curve by step, episode or minute [step]"
    )

    sub = subs["push"]
    sub.add_argument("run", type=Path, metavar="RUN", help="a run or a checkpoint")
    sub.add_argument("name", metavar="USER/NAME", help="repository; new, or of a policy to be replaced")
    sub.add_argument("--private", action="store_true", help="make a new repository private")
    sub.add_argument("--license", metavar="NAME", help="licence on the page, as the Hub abbreviates it: mit [none]")

    subs["envs"].add_argument("filter", nargs="?", default="", metavar="FILTER", help="a part of the id")
    subs["check"].add_argument("what", metavar="ENV|RUN", help="an id, module:Class of your own, a run or a sweep")
    subs["check"].add_argument("--env-args", metavar="JSON", help="arguments of the environment")
    subs["check"].add_argument("--wrappers", nargs="+", default=[], metavar="NAME", help="wrappers, as in training")
    subs["check"].add_argument("--backend", metavar="NAME", help="simulation backend [chosen from the id]")

    subs["completion"].add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))
    return parser, subs


def _add_endings(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--track", metavar="LOGGER", help="another logger: wandb, or module:Class of your own")
    called = "called after each logged line: module:function"
    parser.add_argument("--callbacks", nargs="+", metavar="FUNCTION", help=called)
    parser.add_argument("--processes", default=1, metavar="INT", help="processes of this machine for one run [1]")
    add_cluster_options(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    parser.add_argument("--report", action="store_true", help="evaluate the final policy, draw plots and videos")
    parser.add_argument("--score", action="store_true", help="store the final return over 100 episodes")


def add_cluster_options(parser: argparse.ArgumentParser) -> None:
    """The options of the commands that train on Ray."""
    parser.add_argument("--cluster", metavar="ray[=ADDRESS]", help="train on Ray: --workers INT [--storage DIR]")
    parser.add_argument("--workers", metavar="INT", help=argparse.SUPPRESS)
    parser.add_argument("--storage", metavar="DIR", help=argparse.SUPPRESS)


def _parse_algorithm(command: str, parser: Parser, words: list[str]) -> argparse.Namespace:
    """The words of `train` and `tune`, which begin with an algorithm."""
    verb = f"lemniscate {command}"
    asks = "-h" in words or "--help" in words
    if asks and (words[0].startswith("-") or "," in words[0]):
        from lemniscate.cli.help import print_help

        print_help(command, parser)
    apart = list(takewhile(ALGORITHMS.__contains__, (word.strip(",") for word in words)))
    if len(apart) > 1:
        raise UserError(f"Several algorithms are one word: lemniscate train {','.join(apart)} --seeds 1-5 …")
    names = list(dict.fromkeys(words[0].split(","))) if words and not words[0].startswith("-") else []
    if command == "tune" and len(names) > 1:
        raise UserError(f"A search is for one algorithm: {verb} {names[0]} …")
    strangers = [name for name in names if name not in ALGORITHMS and not _is_own(name)]
    misplaced = [word for word in words if word in ALGORITHMS]
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
    given.unnamed = unnamed
    return given


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
