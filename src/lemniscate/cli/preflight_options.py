"""The options of `lemniscate preflight`. Like the other options this imports nothing heavy."""

import argparse
from pathlib import Path


def add_preflight_options(parser: argparse.ArgumentParser) -> None:
    """The options of `lemniscate preflight`."""
    parser.add_argument("run", type=Path, metavar="RUN", help="a run")
    parser.add_argument("--compiled", action="store_true", help="let the exported C act, which is in RUN/export")
    parser.add_argument("--episodes", default=64, metavar="INT", help="starts, the same at every point [64]")
    parser.add_argument("--seed", default=0, metavar="INT", help="seed of the starts [0]")
    parser.add_argument("--env-args", metavar="JSON", help="arguments that are nominal here [as in training]")
