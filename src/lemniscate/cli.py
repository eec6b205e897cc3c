"""The commands. What a program reads goes to standard output (`evaluate --json`), what a person reads to the error one.

Exit codes: 0 done, 1 training could not go on, 2 a mistake in what was asked, 130 stopped by Ctrl-C, 143 by SIGTERM.
"""

import argparse
import contextlib
import io
import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import tyro

from lemniscate import api, sweep
from lemniscate.algos import ALGORITHMS, find
from lemniscate.envs import registry
from lemniscate.envs.check import check as check_environment
from lemniscate.errors import NonFiniteError, SweepError, UserError, WorkerError, prefix_errors, unknown_name
from lemniscate.presets import best, choose, names
from lemniscate.report import pictures
from lemniscate.run.config import RunConfig
from lemniscate.run.run import Stopped, is_compiled
from lemniscate.run.sweep_file import is_sweep

Command = Callable[[argparse.Namespace, list[str]], None]

COMMANDS = ("train", "resume", "evaluate", "watch", "plot", "envs", "check")

MARKS = {"good": "✓", "note": "·", "bad": "✗"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    given = None
    try:
        given, rest = _parser().parse_known_args(arguments)
        given.run_command(given, rest)
    except UserError as error:
        return _say(error, 2)
    except (NonFiniteError, WorkerError) as error:
        learning = given is not None and given.run_command in (train, resume)
        return _say(f"{error} Training stopped; the last checkpoint is as it was." if learning else error, 1)
    except SweepError as error:
        return _say(error, 1)
    except Stopped as stopped:
        return _say(stopped, 128 + stopped.signum)
    except KeyboardInterrupt:
        return _say("Interrupted.", 130)
    return 0


def train(given: argparse.Namespace, rest: list[str]) -> None:
    """Train a policy, or with --seeds one for each of several algorithms and seeds, to compare them."""
    misplaced = sorted(set(rest) & set(ALGORITHMS))
    if misplaced and given.algorithm not in ALGORITHMS:
        raise UserError(f"The algorithm comes first, then its fields: lemniscate train {misplaced[0]} …")
    if given.seeds is not None or "," in given.algorithm:
        return _train_sweep(given, rest)
    config = _with_fields(api.config_for(given.algorithm, given.env, given.preset), rest)
    if config.backend:
        registry.require_backend(config.backend)
    preset, _ = choose(given.algorithm, config.env, given.preset)
    what = f"{given.algorithm} on {config.num_envs} × {config.env} by {config.backend}"
    _say(f"{what}: preset {preset}, seed {config.seed}, {'compiled' if is_compiled(config) else 'not compiled'}")
    fields = {name: getattr(config, name) for name in config.names() if name != "env"}
    run = api.train(
        given.algorithm,
        config.env,
        run=given.run,
        preset=given.preset,
        track=given.track,
        report=given.report,
        **fields,
    )
    if given.score:
        api.final_return(run.path)
    _say(f"Trained in {run.seconds:.1f} s. Everything is in {run.path}")


def _train_sweep(given: argparse.Namespace, rest: list[str]) -> None:
    if any(argument.partition("=")[0] == "--seed" for argument in rest):
        raise UserError("Several runs have several seeds: --seeds 1-5, not --seed.")
    if given.seeds is None:
        raise UserError("Algorithms are compared over several seeds: add --seeds 1-5.")
    fields: dict[str, Any] = {}
    for algorithm in sweep.algorithms_of(given.algorithm):
        with prefix_errors(algorithm):
            preset = api.config_for(algorithm, given.env, given.preset)
            config = _with_fields(preset, rest)
        values = {name: getattr(config, name) for name in config.names()}
        fields |= {name: value for name, value in values.items() if value != getattr(preset, name)}
    trained = sweep.train_sweep(
        given.algorithm,
        given.env,
        given.seeds,
        run=given.run,
        preset=given.preset,
        track=given.track,
        report=given.report,
        **fields,
    )
    _say(f"Everything is in {trained.path}")


def resume(given: argparse.Namespace, rest: list[str]) -> None:
    """Go on with an interrupted run, or with a set of them."""
    _nothing_left(rest)
    go_on = sweep.resume_sweep if is_sweep(given.run) else api.resume
    run = go_on(given.run, track=given.track, report=given.report)
    if given.score and not is_sweep(given.run):
        api.final_return(run.path)
    _say(f"Done. Everything is in {run.path}")


def evaluate(given: argparse.Namespace, rest: list[str]) -> None:
    """Play whole episodes with the newest policy of a run."""
    _nothing_left(rest)
    policy = api.load(given.run)
    scores = api.evaluate(policy, episodes=given.episodes, seed=given.seed, backend=given.backend)
    if given.json:
        print(json.dumps(scores.to_json()))
    else:
        _say(pictures.sentence(scores))


def watch(given: argparse.Namespace, rest: list[str]) -> None:
    """Show one episode in a window, or record it."""
    _nothing_left(rest)
    said = api.watch(api.load(given.run), seed=given.seed, video=given.video)
    if said:
        _say(said)


def plot(given: argparse.Namespace, rest: list[str]) -> None:
    """Draw the curves of one run, or compare several, grouped by all but the seed."""
    _nothing_left(rest)
    for file in api.plot(*given.runs):
        _say(file)


def envs(given: argparse.Namespace, rest: list[str]) -> None:
    """List the environments, who serves each, and the preset that fits."""
    _nothing_left(rest)
    for env_id in registry.known_ids():
        if given.filter.lower() in env_id.lower():
            presets = ((algorithm, best(algorithm, env_id)) for algorithm in ALGORITHMS)
            fitting = ", ".join(f"{algorithm}: {preset}" for algorithm, preset in presets if preset != "default")
            _say(f"{env_id:<40} {registry.backend_for(env_id):<12} {fitting or 'default'}")


def check(given: argparse.Namespace, rest: list[str]) -> None:
    """Look whether an environment is fit to be learned in, and say so in words."""
    _nothing_left(rest)
    bad = 0
    for finding in check_environment(given.env, given.backend):
        bad += finding.grade == "bad"
        _say(f"{MARKS[finding.grade]} {finding.sentence}")
    if bad:
        raise UserError(f"{given.env} is not fit to be learned in: {bad} finding{'s' * (bad > 1)} above.")


def _with_fields(config: RunConfig, arguments: list[str]) -> RunConfig:
    """`config` with the fields that the command line sets, such as --learning-rate 1e-3."""
    known = {f"--{name.replace('_', '-')}" for name in config.names()}
    for argument in arguments:
        flag = argument.partition("=")[0].replace("_", "-")
        if flag.startswith("--") and flag not in known and flag.replace("--no-", "--", 1) not in known:
            raise unknown_name("field", flag, known)
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stdout(complaint), contextlib.redirect_stderr(complaint):
            return tyro.cli(type(config), args=arguments, default=config, add_help=False)
    except SystemExit:
        raise UserError(_first_sentence(complaint.getvalue())) from None


def _first_sentence(box: str) -> str:
    """What tyro wrote in the first compartment of the box that it draws around an error."""
    flat = " ".join(re.sub("[│╭╮╰╯]", " ", box).split())
    compartment = re.split("[-─]{5,}", flat)[1 if re.search("[-─]{5,}", flat) else 0]
    return compartment.replace("Error parsing Config: ", "").strip().rstrip(".") + "."


def _nothing_left(rest: list[str]) -> None:
    if rest:
        raise UserError(f"{rest[0]} is not understood here; --help lists what is.")


def _say(text: object, code: int = 0) -> int:
    print(text, file=sys.stderr, flush=True)
    return code


class _Parser(argparse.ArgumentParser):
    """argparse, but a mistake is one sentence."""

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message[0].upper()}{message[1:]}; --help lists what there is.")


class _TrainParser(_Parser):
    """Its help goes on with the fields of each algorithm's Config, which are options too."""

    def format_help(self) -> str:
        fields = [
            tyro.extras.get_parser(module.Config, prog=name).format_help()
            for name in ALGORITHMS
            for module in [find(name)]
        ]
        return "\n".join([super().format_help(), "And every field of the algorithm's Config:\n", *fields])


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="lemniscate", description="Train, fly and watch reinforcement-learning policies.")
    commands = parser.add_subparsers(required=True, metavar=" | ".join(COMMANDS))

    def command(function: Command, kind: type[_Parser] = _Parser) -> argparse.ArgumentParser:
        commands._parser_class = kind
        sub = commands.add_parser(
            function.__name__, help=function.__doc__, description=function.__doc__, allow_abbrev=False
        )
        sub.set_defaults(run_command=function)
        return sub

    sub = command(train, _TrainParser)
    sub.add_argument("algorithm", help=f"{', '.join(ALGORITHMS)}; or several, such as {','.join([*ALGORITHMS][:2])}")
    sub.add_argument("--env", help="environment id, or module:Class of your own; a preset may have one")
    sub.add_argument("--run", type=Path, metavar="DIR", help="run directory; must not exist (default: runs/…)")
    sub.add_argument("--seeds", help="a run for each, such as 1-5 or 1,3,7, as many at once as cores serve")
    sub.add_argument("--preset", help="; ".join(f"{a}: {', '.join(names(a))}" for a in ALGORITHMS))
    _add_endings(sub)

    sub = command(resume)
    sub.add_argument("run", type=Path, help="a run or a set of runs")
    _add_endings(sub)

    sub = command(evaluate)
    sub.add_argument("run", type=Path, help="a run or a checkpoint")
    sub.add_argument("--episodes", type=int, default=100)
    sub.add_argument("--seed", type=int, default=0, help="of the starts")
    sub.add_argument("--backend", help="who steps the environments; as in training unless named")
    sub.add_argument("--json", action="store_true", help="one JSON object on standard output")

    sub = command(watch)
    sub.add_argument("run", type=Path, help="a run or a checkpoint")
    sub.add_argument("--video", type=Path, metavar="FILE", help=".gif, .webp or .mp4 instead of a window")
    sub.add_argument("--seed", type=int, default=0)

    sub = command(plot)
    sub.add_argument("runs", type=Path, nargs="+", help="runs or sets of runs")

    sub = command(check)
    sub.add_argument("env", help="an id, or module:Class of your own")
    sub.add_argument("--backend", help="who steps it; chosen by the id unless named")

    sub = command(envs)
    sub.add_argument("filter", nargs="?", default="", help="a part of the id")
    return parser


def _add_endings(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--track", metavar="LOGGER", help="a logger beside the local ones: wandb")
    sub.add_argument("--report", action="store_true", help="evaluate the result and leave pictures")
    sub.add_argument("--score", action="store_true", help="evaluate the result as `plot` will to compare it")


if __name__ == "__main__":
    sys.exit(main())
