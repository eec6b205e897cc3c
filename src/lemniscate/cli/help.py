"""The help of `train` and `tune` without an algorithm, which lists them all."""

from pathlib import Path
from typing import NoReturn

from lemniscate.algos import ALGORITHMS
from lemniscate.cli import Parser, add_train_options
from lemniscate.cli.tune_options import add_tune_options


def algorithms() -> dict[str, str]:
    """The algorithms, and the first line of each file, read from there: to import them is to import torch."""
    folder = Path(__file__).parents[1] / "algos"
    lines = {name: (folder / f"{name}.py").read_text().partition("\n")[0] for name in ALGORITHMS}
    return {name: line.removeprefix('"""') for name, line in lines.items()}


def print_help(command: str, parser: Parser) -> NoReturn:
    """Print the options that all algorithms share, and the algorithms; ends the command."""
    (add_train_options if command == "train" else add_tune_options)(parser)
    listed = "\n".join(f"  {name:<12}{title}" for name, title in algorithms().items())
    several = "several, such as ppo,sac, with --seeds; " if command == "train" else ""
    parser.epilog = f"algorithms ({several}or a module of your own; ppo --help lists the fields of ppo):\n{listed}"
    parser.print_help()
    parser.exit()
