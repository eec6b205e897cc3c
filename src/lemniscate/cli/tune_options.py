"""The options of `lemniscate tune`. Like the other options this imports nothing heavy."""

import argparse
from pathlib import Path

from lemniscate.cli import add_cluster_options


def add_tune_options(parser: argparse.ArgumentParser) -> None:
    """The options of `lemniscate tune` besides the fields of a Config."""
    parser.add_argument("--env", metavar="ID", help="environment id, or module:Class of your own")
    parser.add_argument("--run", type=Path, metavar="DIR", help="directory of the search; must not exist [runs/…]")
    parser.add_argument("--preset", metavar="NAME", help="settings that are not searched [those of the environment]")
    parser.add_argument(
        "--search", metavar="RANGES", help="fields as 'learning_rate=log:1e-4:1e-2, gamma=.9:.999, clip=0.1|0.2'"
    )
    parser.add_argument("--trials", default=40, metavar="INT", help="number of settings that are tried [40]")
    parser.add_argument("--seeds", default="101-103", metavar="LIST", help="of each trial [101-103]")
    parser.add_argument(
        "--prune",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="end a trial after 1/9 or 1/3 of its steps if it is not among the best third [on]",
    )
    add_cluster_options(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
