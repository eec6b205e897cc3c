"""The options of `lemniscate train ALGORITHM` and `tune`, one for each field of the algorithm's Config."""

import argparse
import ast
import inspect
from contextlib import nullcontext
from itertools import pairwise
from textwrap import dedent, fill
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from lemniscate.algos import find
from lemniscate.cli import Parser, add_train_options
from lemniscate.cli.endings import unknown_argument
from lemniscate.cli.tune_options import add_tune_options
from lemniscate.errors import UserError, prefix_errors, unknown_name
from lemniscate.presets import PRESETS, names
from lemniscate.run import glossary
from lemniscate.run.config import RunConfig, flag, options_of
from lemniscate.run.texts import is_dict, number_type, read

GROUPS: dict[str, tuple[str, ...]] = {
    "run": ("seed", "total_steps", "device", "threads", "shards", "compile", "matmul", "warm_start"),
    "environment": ("env_kwargs", "wrappers", "backend", "num_envs"),
    "algorithm": (),
    "networks": ("network", "hidden", "critic_hidden", "activation", "initial_log_std", "normalize_observations"),
    "logging and checkpoints": (
        "log_every",
        "checkpoint_every",
        "keep_checkpoints",
        "evaluate_every",
        "evaluate_episodes",
        "video_every",
        "video_every_episodes",
    ),
}
"""the fields under each heading of the help; those that are not named here are the algorithm's"""


def parse_fields(command: str, algorithms: list[str], words: list[str]) -> argparse.Namespace:
    """The options in `words`, for all of `algorithms`; the fields of their Configs as a dictionary `fields`.

    Raises:
        UserError: a flag that one of the algorithms does not have, or a value that cannot be read.
    """
    fields: dict[str, Any] = {}
    given = argparse.Namespace()
    for algorithm in algorithms:
        with prefix_errors(algorithm) if len(algorithms) > 1 else nullcontext():
            given, own = _parse(command, algorithm, words)
            fields |= own
    given.command, given.algorithm, given.fields = command, ",".join(algorithms), fields
    return given


def field_help(config: type[RunConfig]) -> dict[str, str]:
    """The docstring below each field, read from the source of the Config and of those it inherits from."""
    found: dict[str, str] = {}
    for kind in reversed(config.__mro__[:-1]):
        try:
            (tree,) = ast.parse(dedent(inspect.getsource(kind))).body
        except (OSError, TypeError):  # typed into an interpreter, say
            continue
        for field, below in pairwise(tree.body if isinstance(tree, ast.ClassDef) else []):
            match field, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = " ".join(text.split())
    return found


def _parse(command: str, algorithm: str, words: list[str]) -> tuple[argparse.Namespace, dict[str, Any]]:
    hints = get_type_hints(find(algorithm).Config, include_extras=True)
    parser = parser_of(algorithm, command)
    given, rest = parser.parse_known_args([_switch(word, hints) for word in words])
    if rest:
        known = [action.dest for action in parser._actions]
        raise unknown_argument(rest, lambda word: _unknown_flag(word, known))
    values = {name: value for name, value in vars(given).items() if name in hints and name != "env"}
    return given, {name: read(name, hints[name], value) for name, value in values.items()}


def _switch(word: str, hints: dict[str, Any]) -> str:
    """The flag or the no-flag that `--field=on` or `--field=off` means, as programs that start others write it."""
    name, _, value = word.partition("=")
    if bool not in options_of(hints.get(name.removeprefix("--").replace("-", "_"))):
        return word
    no = name.replace("--", "--no-", 1)
    return {"on": name, "true": name, "off": no, "false": no}.get(value.lower(), word)


def _unknown_flag(word: str, known: list[str]) -> UserError:
    name = word.lstrip("-").replace("-", "_")
    if name in known:  # it was written with one dash
        return unknown_name("field", word, [flag(name)])
    return glossary.unknown_field(name, known, flag)


def parser_of(algorithm: str, command: str = "train") -> Parser:
    """The parser of `lemniscate train ALGORITHM` or `tune ALGORITHM`, with an option for each field."""
    config = find(algorithm).Config
    hints = get_type_hints(config, include_extras=True)
    parser = Parser(
        prog=f"lemniscate {command} {algorithm}",
        usage=f"lemniscate {command} {algorithm} --env ID [--run DIR] [--preset NAME] [--FIELD VALUE …]",
        epilog=_presets(algorithm),
    )
    (add_train_options if command == "train" else add_tune_options)(parser)
    texts, defaults = field_help(config), config()
    grouped = {name for members in GROUPS.values() for name in members} | {"env"}
    for title, members in GROUPS.items():
        own = [name for name in config.names() if name not in grouped] if title == "algorithm" else members
        group = parser.add_argument_group(title)
        for name in own:
            if name in hints:
                _add(group, name, hints[name], texts.get(name, ""), getattr(defaults, name))
    return parser


def _presets(algorithm: str) -> str:
    """The presets of an algorithm, and what the brackets of its help mean."""
    listed = fill(f"presets: {', '.join(names(algorithm) if algorithm in PRESETS else ['default'])}", 110)
    return f"{listed}\n[…] is the default, where neither --preset nor the environment's own preset says otherwise."


def _add(group: argparse._ArgumentGroup, name: str, hint: Any, text: str, default: Any) -> None:
    flags = list(dict.fromkeys([flag(name), f"--{name.replace('_', '-')}"]))
    options = options_of(hint)
    choices = [str(choice) for option in options if get_origin(option) is Literal for choice in get_args(option)]
    if choices:
        text += f" {{{', '.join(choices)}}}"
    if default not in ((), {}) and "(default" not in text:
        text += f" [{_shown(default)}]"
    shared: dict[str, Any] = {"dest": name, "default": argparse.SUPPRESS, "help": text.replace("%", "%%")}
    if bool in options:
        group.add_argument(*flags, action=argparse.BooleanOptionalAction, **shared)
    elif any(get_origin(option) is tuple for option in options):
        group.add_argument(*flags, nargs="+", metavar=_metavar(options), **shared)
    else:
        group.add_argument(*flags, metavar=_metavar(options), **shared)


def _metavar(options: tuple[Any, ...]) -> str:
    """INT, FLOAT, NAME or JSON; `|none` where nothing is a value too."""
    kinds: list[str] = []
    for option in options:
        if get_origin(option) is tuple:
            kinds.append(_metavar(options_of(get_args(option)[0])))
        elif option is not NoneType:
            number = number_type(option)
            kinds.append("INT" if number is int else "FLOAT" if number else "JSON" if is_dict(option) else "NAME")
    return "|".join([*dict.fromkeys(kinds), *(["none"] if NoneType in options else [])])


def _shown(value: Any) -> str:
    """A default, as it would be typed."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple):
        return " ".join(map(_shown, value))
    if isinstance(value, int):
        return f"{value:_}" if value >= 10_000 else str(value)
    return "none" if value is None else str(value)
