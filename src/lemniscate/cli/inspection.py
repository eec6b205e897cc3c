"""The work of the commands that look at what there is: each takes what `parse` understood."""

import argparse
import json
from shutil import get_terminal_size
from typing import Any

from lemniscate.algos import ALGORITHMS
from lemniscate.api import plots, pushed, results
from lemniscate.api.checks import each_finding, verdict
from lemniscate.cli.completion import completion as completion
from lemniscate.envs import registry
from lemniscate.envs.check import BAD
from lemniscate.errors import UserError, unknown_name
from lemniscate.presets import best
from lemniscate.report import pages
from lemniscate.run.texts import number, read, read_json
from lemniscate.system.console import say


def evaluate(given: argparse.Namespace) -> None:
    """Play whole episodes: scores as JSON on standard output, or as a sentence."""
    own = {"env_kwargs": _env_args(given), "backend": given.backend, "video": given.video, "trust": given.trust}
    own["baseline"] = given.baseline
    scores = results.evaluate(given.run, episodes=number(given.episodes), seed=number(given.seed), **own)
    if given.json:
        print(json.dumps(scores.to_json(), allow_nan=False))
    else:
        say(pages.sentence(scores.to_json()))


def watch(given: argparse.Namespace) -> None:
    """Show episodes in a window, or record them."""
    if not given.run and not (given.random and given.env):
        raise UserError("Watch what? lemniscate watch RUN; before training, lemniscate watch --random --env ID.")
    results.watch(
        given.run,
        given.env,
        episodes=number(given.episodes),
        seed=number(given.seed),
        deterministic=not given.sample,
        random=given.random,
        video=given.video,
        trust=given.trust,
        env_kwargs=_env_args(given),
    )


def export(given: argparse.Namespace) -> None:
    """Write a policy as C and ONNX, and say how far these are from it."""
    from lemniscate.exporting.export import export

    say(f"Everything is in {export(given.run, given.to, trust=given.trust)}")


def preflight(given: argparse.Namespace) -> None:
    """Measure the margins of a policy, and name the files."""
    from lemniscate.margins.preflight import preflight

    own = {"episodes": number(given.episodes), "seed": number(given.seed), "env_kwargs": _env_args(given)}
    preflight(given.run, given.compiled, trust=given.trust, **own)
    say(f"Everything is in {given.run / 'preflight.json'} and {given.run / 'plots' / 'preflight.png'}")


def plot(given: argparse.Namespace) -> None:
    """Draw the curves of one run, or compare several, grouped by all but the seed."""
    for file in plots.plot(*given.runs, by=given.by, trust=given.trust):
        say(file)


def push(given: argparse.Namespace) -> None:
    """Upload the policy of a run to the Hub."""
    page = pushed.push(given.run, given.name, private=given.private, license=given.license, trust=given.trust)
    say(f"Uploaded: {page}. It is loaded from hf://{given.name}.")


def envs(given: argparse.Namespace) -> None:
    """List the environments, the backend of each, and the presets that fit."""
    found = [env_id for env_id in registry.known_ids() if given.filter.lower() in env_id.lower()]
    if not found:
        raise unknown_name("environment", given.filter, registry.known_ids())
    for env_id in found:
        presets = ((algorithm, best(algorithm, env_id)) for algorithm in ALGORITHMS)
        fitting = ", ".join(f"{algorithm}: {preset}" for algorithm, preset in presets if preset != "default")
        say(f"{env_id:<40} {registry.backend_for(env_id):<12} {fitting or 'default'}")


def check(given: argparse.Namespace) -> None:
    """Say what was found about an environment or the files of a run, as a list; what is bad there is an error."""
    found, wrappers = [], read("wrappers", tuple[str, ...], given.wrappers)
    for finding in each_finding(given.what, given.backend, _env_args(given), wrappers):
        found.append(finding)
        say(finding.listed(min(get_terminal_size((112, 24)).columns, 120)))
    if any(finding.grade == BAD for finding in found):
        raise UserError(verdict(given.what, found))
    say(verdict(given.what, found))


def _env_args(given: argparse.Namespace) -> dict[str, Any] | None:
    return None if given.env_args is None else read_json("--env-args", given.env_args)
