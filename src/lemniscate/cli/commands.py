"""The work of each command: each takes what `parse` understood, and imports what it alone needs."""

import json as notation
from collections.abc import Collection, Mapping
from itertools import groupby
from pathlib import Path
from shutil import get_terminal_size
from typing import Any

from lemniscate.algos import ALGORITHMS
from lemniscate.api import training
from lemniscate.api.policy import TrainedRun
from lemniscate.envs import registry
from lemniscate.errors import UserError, is_installed, missing_extra, unknown_name
from lemniscate.run.directory import SWEEP, TUNE
from lemniscate.run.fields import flag
from lemniscate.system.console import say, talks
from lemniscate.system.watchdog import end_with_owner

OF_SWEEPS = ("track", "callbacks", "report", "progress", "cluster", "workers")
OF_SEARCHES = ("progress", "cluster", "workers")
"""options that sets of runs have too"""


def train(
    algorithm: str,
    env: str | None,
    preset: str | None,
    run: Path | None,
    fields: dict[str, Any],
    seeds: str | None,
    score: bool,
    **options: Any,
) -> None:
    """Train one policy, or with --seeds one for each algorithm and seed, and compare them."""
    if seeds is None and "," not in algorithm:
        others = {name: value for name, value in fields.items() if name != "env_kwargs"}
        usual = training.choose_config(algorithm, env, preset, others)[2].env_kwargs if others != fields else {}
        name, preset, config = training.choose_config(algorithm, env, preset, fields)
        registry.backend_class(str(config.backend))  # refuses one that is not there
        what = f"{name} on {config.num_envs} × {config.env}, backend {config.backend}"
        tell(f"{what}: preset {preset}, seed {config.seed}, {'compiled' if config.is_compiled else 'not compiled'}")
        if left := {name: value for name, value in usual.items() if name not in config.env_kwargs}:
            tell(f"--env-args takes the place of the preset's, of which {notation.dumps(left)} is left out.")
        trained = training.begin(name, config, run, options)
        if score:
            _say_score(trained)
        tell(f"Trained in {trained.seconds:.1f} s. Everything is in {trained.path}")
        return
    from lemniscate.sweeps.sweep import train_sweep

    if "seed" in fields:
        raise UserError("Several runs have several seeds: --seeds 1-5, not --seed.")
    if seeds is None:
        raise UserError("Algorithms are compared over several seeds: add --seeds 1-5.")
    shared = _only(OF_SWEEPS, options, "a sweep")
    tell(f"Everything is in {train_sweep(algorithm, env, seeds, run=run, preset=preset, **fields, **shared).path}")


def tune(algorithm: str, env: str | None, search: str | None, fields: dict[str, Any], **options: Any) -> None:
    """Search for the best settings."""
    from lemniscate.sweeps.tuner import tune

    if search is None:
        raise UserError("Search what? Name fields with their ranges: --search 'learning_rate=log:1e-4:1e-2'.")
    shared = _only(options.keys() - {"storage"}, options, "a search")
    tell(f"Everything is in {tune(algorithm, env, search=search, **shared, **fields).path}")


def resume(run: Path, total_steps: float | None, score: bool, **options: Any) -> None:
    """Continue an interrupted run, sweep or search. The runs of the latter two are begun by this command, too."""
    owned = end_with_owner()
    if total_steps is not None and ((run / TUNE).exists() or (run / SWEEP).exists()):
        raise UserError(f"--total-steps is for one run, and {run} is a set of them: name one of its runs.")
    if (run / TUNE).exists():
        from lemniscate.sweeps.tuner import resume_tuning

        resume_tuning(run, **_only(OF_SEARCHES, {**options, "score": score}, "a search"))
    elif (run / SWEEP).exists():
        from lemniscate.sweeps.sweep import resume_sweep

        resume_sweep(run, **_only(OF_SWEEPS, options, "a sweep"))
    else:
        changes = {} if total_steps is None else {"total_steps": total_steps}
        trained = training.resume_run(run, options, changes)
        if score:
            _say_score(trained)
        if not trained.seconds:  # it was finished, which has been said
            return
    if not owned:
        tell(f"Done. Everything is in {run}")


def evaluate(json: bool, **options: Any) -> None:
    """Play whole episodes: scores as JSON on standard output, or as a sentence."""
    from lemniscate.api import results
    from lemniscate.report import pages

    scores = results.evaluate(**options).to_json()
    if json:
        print(notation.dumps(scores, allow_nan=False))
    else:
        say(pages.sentence(scores))


def watch(policy: Path | None, env: str | None, random: bool, **options: Any) -> None:
    """Show episodes in a window, or record them."""
    from lemniscate.api import results

    if not policy and not (random and env):
        raise UserError("Watch what? lemniscate watch RUN; before training, lemniscate watch --random --env ID.")
    results.watch(policy, env, random=random, **options)


def export(run: Path, **options: Any) -> None:
    """Write a policy as C and ONNX, and say how far these are from it."""
    from lemniscate.exporting.export import export

    say(f"Everything is in {export(run, **options)}")


def preflight(run: Path, **options: Any) -> None:
    """Measure the margins of a policy, and name the files."""
    from lemniscate.margins.preflight import preflight

    preflight(run, **options)
    say(f"Everything is in {run / 'preflight.json'} and {run / 'plots' / 'preflight.png'}")


def plot(runs: list[Path], by: str) -> None:
    """Draw the curves of one run, or compare several, grouped by all but the seed."""
    from lemniscate.api.plots import plot

    for file in plot(*runs, by=by):
        say(file)


def push(run: Path, name: str, **options: Any) -> None:
    """Upload the policy of a run to the Hub."""
    from lemniscate.api.results import push

    say(f"Uploaded: {push(run, name, **options)}. It is loaded from hf://{name}.")


def envs(filter: str) -> None:
    """List the families of environments; those of one, each with its backend and the presets that fit."""
    from lemniscate.presets import best

    ids, wanted = registry.known_ids(), filter.lower()
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
        raise registry.unknown_env(filter)
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


def doctor(what: str, json: bool, **options: Any) -> None:
    """Say what was found about an environment, or a run and its files, as a list; what is bad there is an error."""
    from lemniscate.api.results import diagnose, each_finding, runs_in, spread_of, verdict
    from lemniscate.envs.check import BAD

    found = []
    width = max(20, min(get_terminal_size((112, 24)).columns, 120))
    for finding in each_finding(what, **options):
        found.append(finding)
        say(finding.listed(width))
    damaged = any(finding.grade == BAD for finding in found)
    if not damaged:
        say(verdict(what, found))
    diagnoses = {str(run): diagnose(run) for run in ([] if damaged else runs_in(what))}
    for run, of_run in diagnoses.items():
        names = ", ".join(one.name for one in of_run if one.sure != "hint")
        say(f"{run}: {names or 'no rule finds a fault'}.")
        for one in of_run:
            say(one.listed(width))
    if diagnoses and (spread := spread_of(what)):
        say(spread)
    if json:
        runs = {run: [vars(one) for one in of_run] for run, of_run in diagnoses.items()}
        print(notation.dumps({"checked": [vars(one) for one in found], "runs": runs}))
    if damaged:
        raise UserError(verdict(what, found))


def course(action: str, folder: Path, solutions: bool) -> None:
    """Lay out the course, and name the page to begin with."""
    from lemniscate.course import start

    if action != "start":
        raise unknown_name("word after `course`", action, ("start",))
    say(f"Begin with {start(folder, solutions=solutions)}")


def grade(json: bool, csv: bool, **options: Any) -> None:
    """Judge hand-ins: a table, and on standard output what a program reads."""
    from lemniscate.course.grading import as_csv, grade

    if json and csv:
        raise UserError("--json and --csv print to one place: choose one of them.")
    grades = grade(**options)
    if json:
        print(notation.dumps(grades))
    if csv:
        print(as_csv(grades), end="")


def completion(shell: str) -> None:
    """Print the script with which a shell completes."""
    from lemniscate.cli.completion import script

    print(script(shell), end="")


def _only(names: Collection[str], options: Mapping[str, Any], what: str) -> dict[str, Any]:
    """The options of these names. Raises `UserError` where another one is given: its runs do not have it."""
    for name, value in options.items():
        if name not in names and value and (name, value) != ("processes", 1):
            raise UserError(f"{flag(name)} is for one run, and not for {what}; leave it out.")
    return {name: options[name] for name in names}


def tell(text: str) -> None:
    """Say it, where this process is the one that talks."""
    if talks():
        say(text)


def _say_score(run: TrainedRun) -> None:
    from lemniscate.api.results import FINAL_EPISODES, final_return

    if talks():
        say(f"Final return {final_return(run):.1f} over {FINAL_EPISODES} episodes.")
