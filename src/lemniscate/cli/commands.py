"""The work of each command: each takes what `parse` understood, and imports what it alone needs."""

import argparse
import json
from itertools import groupby
from shutil import get_terminal_size
from typing import Any

from lemniscate.algos import ALGORITHMS
from lemniscate.api import training
from lemniscate.api.options import RunOptions
from lemniscate.api.policy import TrainedRun
from lemniscate.envs import registry
from lemniscate.errors import UserError, is_installed, missing_extra, unknown_name
from lemniscate.run.directory import SWEEP, TUNE
from lemniscate.run.fields import number, read, read_json
from lemniscate.run.run import is_compiled
from lemniscate.system.console import say, talks
from lemniscate.system.watchdog import end_with_owner


def train(given: argparse.Namespace) -> None:
    """Train one policy, or with --seeds one for each algorithm and seed."""
    if given.unnamed:
        why = "takes every kind of actions and, mostly, needs the fewest minutes"
        tell(f"No algorithm is named: {given.algorithm} {why}.")
    if given.seeds is not None or "," in given.algorithm:
        train_sweep(given)
        return
    name, preset, config = training.choose_config(given.algorithm, given.env, given.preset, given.fields)
    registry.backend_class(str(config.backend))  # refuses one that is not there
    what = f"{name} on {config.num_envs} × {config.env}, backend {config.backend}"
    tell(f"{what}: preset {preset}, seed {config.seed}, {'compiled' if is_compiled(config) else 'not compiled'}")
    run = training.begin(name, config, given.run, _options(given))
    if given.score:
        _say_score(run)
    tell(f"Trained in {run.seconds:.1f} s. Everything is in {run.path}")


def train_sweep(given: argparse.Namespace) -> None:
    """Train one policy for each algorithm and seed, and compare them."""
    from lemniscate.sweeps.sweep import train_sweep

    if "seed" in given.fields:
        raise UserError("Several runs have several seeds: --seeds 1-5, not --seed.")
    if given.seeds is None:
        raise UserError("Algorithms are compared over several seeds: add --seeds 1-5.")
    shared = {"run": given.run, "preset": given.preset, **given.fields, **_of_several(given)}
    runs = train_sweep(given.algorithm, given.env, given.seeds, **shared)
    tell(f"Everything is in {runs.path}")


def tune(given: argparse.Namespace) -> None:
    """Search for the best settings."""
    from lemniscate.sweeps.tuner import tune

    if given.search is None:
        raise UserError("Search what? Name fields with their ranges: --search 'learning_rate=log:1e-4:1e-2'.")
    fields = {"run": given.run, "preset": given.preset, "seeds": given.seeds, "prune": given.prune, **given.fields}
    fields |= {**_cluster(given), "trials": number(given.trials), "progress": not given.quiet}
    tuned = tune(given.algorithm, given.env, search=given.search, **fields)
    tell(f"Everything is in {tuned.path}")


def resume(given: argparse.Namespace) -> None:
    """Continue an interrupted run, sweep or search. The runs of the latter two are begun by this command, too."""
    owned = end_with_owner()
    changes = {} if given.total_steps is None else {"total_steps": number(given.total_steps)}
    if changes and ((given.run / TUNE).exists() or (given.run / SWEEP).exists()):
        raise UserError(f"--total-steps is for one run, and {given.run} is a set of them: name one of its runs.")
    if (given.run / TUNE).exists():
        from lemniscate.sweeps.tuner import resume_tuning

        run = resume_tuning(given.run, **_cluster(given), progress=not given.quiet)
    elif (given.run / SWEEP).exists():
        from lemniscate.sweeps.sweep import resume_sweep

        run = resume_sweep(given.run, **_of_several(given))
    else:
        run = training.go_on(training.path_of(given.run), _options(given), changes)
        if given.score:
            _say_score(run)
        if not run.seconds:  # it was finished, which has been said
            return
    if not owned:
        tell(f"Done. Everything is in {run.path}")


def evaluate(given: argparse.Namespace) -> None:
    """Play whole episodes: scores as JSON on standard output, or as a sentence."""
    from lemniscate.api import results
    from lemniscate.report import pages

    own = {"backend": given.backend, "baseline": given.baseline, "video": given.video, "report": given.report}
    own |= {"deterministic": not given.stochastic, **_own(given)}
    scores = results.evaluate(given.run, given.env, **_episodes(given), **own, **_policy(given))
    if given.json:
        print(json.dumps(scores.to_json(), allow_nan=False))
    else:
        say(pages.sentence(scores.to_json()))


def watch(given: argparse.Namespace) -> None:
    """Show episodes in a window, or record them."""
    from lemniscate.api import results

    if not given.run and not (given.random and given.env):
        raise UserError("Watch what? lemniscate watch RUN; before training, lemniscate watch --random --env ID.")
    own = {"random": given.random, "video": given.video, "deterministic": not (given.stochastic or given.sample)}
    own |= _own(given)
    results.watch(given.run, given.env, **_episodes(given), **own, **_policy(given))


def export(given: argparse.Namespace) -> None:
    """Write a policy as C and ONNX, and say how far these are from it."""
    from lemniscate.exporting.export import export

    say(f"Everything is in {export(given.run, given.to, **_policy(given))}")


def preflight(given: argparse.Namespace) -> None:
    """Measure the margins of a policy, and name the files."""
    from lemniscate.margins.preflight import preflight

    preflight(given.run, given.compiled, **_episodes(given))
    say(f"Everything is in {given.run / 'preflight.json'} and {given.run / 'plots' / 'preflight.png'}")


def plot(given: argparse.Namespace) -> None:
    """Draw the curves of one run, or compare several, grouped by all but the seed."""
    from lemniscate.api.plots import plot

    for file in plot(*given.runs, by=given.by):
        say(file)


def push(given: argparse.Namespace) -> None:
    """Upload the policy of a run to the Hub."""
    from lemniscate.api.results import push

    page = push(given.run, given.name, private=given.private, license=given.license)
    say(f"Uploaded: {page}. It is loaded from hf://{given.name}.")


def envs(given: argparse.Namespace) -> None:
    """List the families of environments; those of one, each with its backend and the presets that fit."""
    from lemniscate.presets import best

    ids, wanted = registry.known_ids(), given.filter.lower()
    if not wanted:
        for family, found in groupby(sorted(ids, key=_family), _family):
            first, *rest = found
            say(f"{family:<28} {1 + len(rest):>4}  {first}{', …' if rest else ''}")
        say("`lemniscate envs NAME` lists those with that word in family or id, and the presets that fit.")
        extras = {"envpool": "envpool", "mujoco": "mujoco", "Box2D": "box2d", "crazyflow": "drone"}
        for package, extra in extras.items():
            say("" if is_installed(package) else missing_extra(package, extra))
        return
    found = [env_id for env_id in ids if wanted in env_id.lower() or wanted in _family(env_id).lower()]
    if not found:
        raise registry.unknown_env(given.filter)
    for env_id in found:
        presets = ((algorithm, best(algorithm, env_id)) for algorithm in ALGORITHMS)
        fitting = ", ".join(f"{algorithm}: {preset}" for algorithm, preset in presets if preset != "default")
        say(f"{env_id:<40} {registry.backend_for(env_id):<12} {fitting or 'default'}")


def _family(env_id: str) -> str:
    """The library of an id, and the part of it that the id belongs to."""
    from gymnasium import registry as theirs

    if env_id.startswith("EnvPool/"):
        from lemniscate.envs.envpool import family

        return f"EnvPool {family(env_id.partition('/')[2])}"
    spec = theirs.get(env_id)
    maker: Any = (spec.entry_point or spec.vector_entry_point) if spec else registry.backend_for(env_id)
    place = getattr(maker, "__module__", maker).partition(":")[0].split(".")
    return f"Gymnasium {place[2]}" if place[:2] == ["gymnasium", "envs"] else place[0]


def doctor(given: argparse.Namespace) -> None:
    """Say what was found about an environment, or a run and its files, as a list; what is bad there is an error."""
    from lemniscate.api.results import diagnose, each_finding, runs_in, spread_of, verdict
    from lemniscate.envs.check import BAD

    found, wrappers = [], read("wrappers", tuple[str, ...], given.wrappers)
    width = min(get_terminal_size((112, 24)).columns, 120)
    for finding in each_finding(given.what, given.backend, _env_args(given), wrappers):
        found.append(finding)
        say(finding.listed(width))
    if any(finding.grade == BAD for finding in found):
        raise UserError(verdict(given.what, found))
    say(verdict(given.what, found))
    diagnoses = {str(run): diagnose(run) for run in runs_in(given.what)}
    for run, of_run in diagnoses.items():
        names = ", ".join(one.name for one in of_run if one.sure != "hint")
        say(f"{run}: {names or 'no rule finds a fault'}.")
        for one in of_run:
            say(one.listed(width))
    if spread := spread_of(given.what):
        say(spread)
    if given.json:
        runs = {run: [vars(one) for one in of_run] for run, of_run in diagnoses.items()}
        print(json.dumps({"checked": [vars(one) for one in found], "runs": runs}))


def course(given: argparse.Namespace) -> None:
    """Lay out the course, and name the page to begin with."""
    from lemniscate.course import start

    if given.action != "start":
        raise unknown_name("word after `course`", given.action, ("start",))
    say(f"Begin with {start(given.folder, solutions=given.solutions)}")


def grade(given: argparse.Namespace) -> None:
    """Judge hand-ins: a table, and on standard output what a program reads."""
    from lemniscate.course.grading import as_csv, grade

    grades = grade(given.folder, given.exercises, to=given.to)
    if given.json:
        print(json.dumps(grades))
    if given.csv:
        print(as_csv(grades), end="")


def completion(given: argparse.Namespace) -> None:
    """Print the script with which a shell completes."""
    from lemniscate.cli.completion import script

    print(script(given.shell), end="")


def tell(text: str) -> None:
    """Say it, where this process is the one that talks."""
    if talks():
        say(text)


def _say_score(run: TrainedRun) -> None:
    from lemniscate.api.results import FINAL_EPISODES, final_return

    if talks():
        say(f"Final return {final_return(run):.1f} over {FINAL_EPISODES} episodes.")


def _options(given: argparse.Namespace) -> RunOptions:
    return RunOptions(processes=number(given.processes), storage=given.storage, **_of_several(given))


def _of_several(given: argparse.Namespace) -> dict[str, Any]:
    """The options that the runs of a sweep have too."""
    callbacks = [name for word in given.callbacks or () for name in word.split(",")]
    shared = {"track": given.track, "callbacks": callbacks, "report": given.report, "progress": not given.quiet}
    return {**shared, **_cluster(given)}


def _cluster(given: argparse.Namespace) -> dict[str, Any]:
    return {"cluster": given.cluster, "workers": given.workers and number(given.workers)}


def _episodes(given: argparse.Namespace) -> dict[str, Any]:
    """The episodes that are to be played."""
    numbers = {"episodes": number(given.episodes), "seed": number(given.seed)}
    return {**numbers, "env_kwargs": _env_args(given)}


def _policy(given: argparse.Namespace) -> dict[str, Any]:
    """The options that choose a policy of a run or an address."""
    return {"checkpoint": given.checkpoint and number(given.checkpoint), "trust": given.trust}


def _own(given: argparse.Namespace) -> dict[str, Any]:
    """The options of a policy that was not trained here."""
    return {"agent": given.agent, "normalized_actions": given.normalized_actions}


def _env_args(given: argparse.Namespace) -> dict[str, Any] | None:
    return None if given.env_args is None else read_json("--env-args", given.env_args)
