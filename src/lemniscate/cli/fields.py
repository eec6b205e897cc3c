"""The options of `lemniscate train ALGORITHM` and `tune`, one for each field of the algorithm's Config."""

import argparse
from contextlib import nullcontext
from textwrap import fill
from types import NoneType
from typing import Any, Literal, get_type_hints

from lemniscate.algos import find
from lemniscate.cli import Parser, Read, parser_of, unknown_argument
from lemniscate.errors import UserError, prefix_errors, unknown_name
from lemniscate.presets import names
from lemniscate.run.fields import field_help, flag, kinds_of, typed, unknown_field

GROUPS = {
    "run": "seed total_steps average_last device threads shards compile matmul warm_start freeze",
    "environment": "env_kwargs symmetry reset_options wrappers curriculum backend num_envs",
    "algorithm": "",
    "networks": "network hidden critic_hidden activation initial_log_std normalize_observations",
    "logging and checkpoints": "log_every checkpoint_every keep_checkpoints evaluate_every evaluate_episodes keep_best"
    " video_every video_every_episodes",
}
"""the fields under each heading of the help; those that are not named here are the algorithm's"""


def parse_fields(command: str, algorithms: list[str], words: list[str]) -> argparse.Namespace:
    """The options in `words`, for all of `algorithms`; the fields of their Configs as a dictionary `fields`.

    Raises `UserError` for a flag that one of the algorithms does not have, or a value that cannot be read.
    """
    fields: dict[str, Any] = {}
    options: dict[str, Any] = {}
    for algorithm in algorithms:
        with prefix_errors(algorithm) if len(algorithms) > 1 else nullcontext():
            parser = algorithm_parser(command, algorithm)
            hints = get_type_hints(find(algorithm).Config, include_extras=True)
            if {"-h", "--help"} & set(words):
                explain(parser, algorithm)
            given, rest = parser.parse_known_args([_switch(word, hints) for word in words])
            if rest:
                known = [action.dest for action in parser._actions]
                raise unknown_argument(rest, lambda word, known=known: _unknown_flag(word, known))
            for name, value in vars(given).items():
                (fields if name in hints and name != "env" else options)[name] = value
    return argparse.Namespace(command=command, algorithm=",".join(algorithms), fields=fields, **options)


def algorithm_parser(command: str, algorithm: str) -> Parser:
    """The parser of `train ALGORITHM` or `tune ALGORITHM`, with an option for each field; `explain` adds their help."""
    config, parser = find(algorithm).Config, parser_of(command)
    parser.prog = f"lemniscate {command} {algorithm}"
    parser.description = None  # the help of an algorithm is to fit on two pages
    parser.usage = f"{parser.prog} --env ID [--run DIR] [--preset NAME] [--FIELD VALUE …]"
    hints = get_type_hints(config, include_extras=True)
    grouped = {"env", *" ".join(GROUPS.values()).split()}
    for title, members in GROUPS.items():
        group = parser.add_argument_group(title)
        own = [name for name in config.names() if name not in grouped] if title == "algorithm" else members.split()
        for name in filter(hints.__contains__, own):
            kinds = kinds_of(hints[name])
            kind: dict[str, Any] = {"action": Read, "hint": hints[name]}
            if bool in kinds:
                kind = {"action": argparse.BooleanOptionalAction}
            elif tuple in kinds:
                kind["nargs"] = "+"
            flags = dict.fromkeys([flag(name), f"--{name.replace('_', '-')}"])
            group.add_argument(*flags, dest=name, default=argparse.SUPPRESS, **kind)
    return parser


def explain(parser: Parser, algorithm: str) -> None:
    """Give each field in a parser its help: its docstring, the values that it may have, and its default."""
    config = find(algorithm).Config
    texts, defaults, hints = field_help(config), config(), get_type_hints(config, include_extras=True)
    for action in parser._actions:
        if action.dest in hints and action.dest != "env":
            hint, text = hints[action.dest], texts.get(action.dest, "")
            if choices := kinds_of(hint).get(Literal):
                text += f" {{{', '.join(map(str, choices))}}}"
            default = getattr(defaults, action.dest)
            if default not in ((), {}) and "(default" not in text:
                text += f" [{typed(default)}]"
            action.help, action.metavar = text.replace("%", "%%"), _metavar(hint)
    bracket = "[…] is the default, where neither --preset nor the environment's own preset says otherwise."
    schedule = "Learning rates, clips, entropy_coef, noise_std: also '3e-4>1e-5' in quotes, linear over total_steps."
    parser.epilog = fill(f"presets: {', '.join(names(algorithm))}", 110) + f"\n{schedule}\n{bracket}"


def _switch(word: str, hints: dict[str, Any]) -> str:
    """The flag or the no-flag that `--field=on` or `--field=off` means, as programs that start others write it."""
    name, _, value = word.partition("=")
    if bool not in kinds_of(hints.get(name.removeprefix("--").replace("-", "_"))):
        return word
    no = name.replace("--", "--no-", 1)
    return {"on": name, "true": name, "off": no, "false": no}.get(value.lower(), word)


def _unknown_flag(word: str, known: list[str]) -> UserError:
    name = word.lstrip("-").replace("-", "_")
    if name in known:  # it was written with one dash
        return unknown_name("field", word, [flag(name)])
    return unknown_field(name, known, flag)


def _metavar(hint: Any) -> str:
    """INT, FLOAT, NAME or JSON; `|none` where nothing is a value too."""
    words = {int: "INT", float: "FLOAT", dict: "JSON", NoneType: "none"}
    kinds = kinds_of(hint).items()
    return "|".join(dict.fromkeys(_metavar(of[0]) if kind is tuple else words.get(kind, "NAME") for kind, of in kinds))
