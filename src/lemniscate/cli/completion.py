"""Completion in bash, zsh and fish: a script with all that may follow a word, so that pressing TAB starts nothing."""

from collections.abc import Iterable
from shlex import quote
from typing import Literal, get_type_hints

from lemniscate.algos import ALGORITHMS, find
from lemniscate.cli import COMMANDS, EARLIER, SHELLS, Parser, flags_of, parser_of
from lemniscate.cli.fields import algorithm_parser, explain
from lemniscate.envs import registry
from lemniscate.errors import unknown_name
from lemniscate.nn.networks import NETWORKS
from lemniscate.presets import names
from lemniscate.run.fields import flag, kinds_of
from lemniscate.run.loggers import TRACKERS

FILES = {
    "bash": "~/.local/share/bash-completion/completions/lemniscate",
    "zsh": "~/.lemniscate.zsh; and in ~/.zshrc: source ~/.lemniscate.zsh",
    "fish": "~/.config/fish/completions/lemniscate.fish",
}
"""where each shell reads the script"""

BASH = """_lemniscate() {
  local here=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]} command=${COMP_WORDS[1]} known=""
  case $command in train|tune) command=${COMP_WORDS[2]} ;; esac
  case "$COMP_CWORD $command $before $here" in
CASES
  esac
  COMPREPLY=($(compgen -W "$known" -- "$here"))
}
complete -o default -F _lemniscate lemniscate
"""
"""what has no answer is completed as a file, since runs and videos are paths"""

ZSH = """(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
autoload -Uz bashcompinit && bashcompinit
"""


def script(shell: str) -> str:
    """The script with which a shell completes, with a comment on where to write it. Raises `UserError`."""
    if shell not in SHELLS:
        raise unknown_name("shell", shell, SHELLS)
    written = _fish() if shell == "fish" else (ZSH if shell == "zsh" else "") + _bash()
    return f"# Write it once, and again after an upgrade: lemniscate completion {shell} > {FILES[shell]}\n{written}"


def _bash() -> str:
    cases = [("1 *", COMMANDS), *((f"* * {word} *", words) for word, words in _followers().items())]
    cases += [(f"* {name} * -*", flags_of(parser)) for name, parser in _parsers().items()]
    lines = (f"    {pattern.replace(' ', chr(92) + ' ')}) known='{' '.join(words)}' ;;" for pattern, words in cases)
    return BASH.replace("CASES", "\n".join(lines))


def _fish() -> str:
    followers = _followers()
    variables = {word: f"__lemniscate_{word.strip('-').replace('-', '_')}" for word in followers}
    lines = [f"set -g {variables[word]} {' '.join(words)}" for word, words in followers.items()]
    begin = "complete -c lemniscate -n"
    lines += [f"{begin} __fish_use_subcommand -f -a {name} -d {quote(text)}" for name, text in COMMANDS.items()]
    for word in (command for command in (*COMMANDS, *EARLIER) if command in followers):
        after = f"test (count (commandline -opc)) = 2; and __fish_seen_subcommand_from {word}"
        lines.append(f"{begin} '{after}' -f -a '${variables[word]}'")
    for name, parser in _parsers().items():
        for option, action in flags_of(parser).items():
            known = f"-x -a '${variables[option]}'" if option in followers else "-r" if action.nargs != 0 else ""
            text = quote((action.help or "").replace("%%", "%"))
            lines.append(f"{begin} '__fish_seen_subcommand_from {name}' -l {option[2:]} {known} -d {text}")
    return "\n".join([*lines, ""])


def _parsers() -> dict[str, Parser]:
    """The parser of each command, and in the place of `train` that of each algorithm."""
    parsers = {name: parser_of(name) for name in COMMANDS if name != "train"}
    for name in ALGORITHMS:
        parsers[name] = algorithm_parser("train", name)
        explain(parsers[name], name)
    return parsers


def _followers() -> dict[str, Iterable[str]]:
    """The words that may follow a command or an option, where they are few."""
    ids, presets = registry.known_ids(), {preset: None for name in ALGORITHMS for preset in names(name)}
    found: dict[str, Iterable[str]] = {"completion": SHELLS, "course": ["start"]}
    found |= dict.fromkeys(("train", "tune"), ALGORITHMS)
    found |= dict.fromkeys(("doctor", "check", "--env"), ids)
    found |= {"--preset": presets, "--backend": registry.BACKENDS, "--track": TRACKERS, "--network": NETWORKS}
    for name in ALGORITHMS:
        for field, hint in get_type_hints(find(name).Config).items():
            if choices := kinds_of(hint).get(Literal):
                found[flag(field)] = choices
    return found
