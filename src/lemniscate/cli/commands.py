"""The commands' work: each takes what `parse` understood."""

import argparse
import json
from shutil import get_terminal_size
from typing import Any

from lemniscate import api, plots, results, resumed, sweep
from lemniscate.algos import ALGORITHMS
from lemniscate.checks import each_finding, verdict
from lemniscate.cli.completion import completion as completion
from lemniscate.console import say, talks
from lemniscate.envs import registry
from lemniscate.envs.findings import BAD
from lemniscate.errors import UserError, unknown_name
from lemniscate.owner import end_with_owner
from lemniscate.presets import best, choose
from lemniscate.report import pictures
from lemniscate.run.run import is_compiled
from lemniscate.run.sweep_file import is_search, is_sweep
from lemniscate.run.texts import number, read, read_json
from lemniscate.stored import TrainedRun


def train(given: argparse.Namespace) -> None:
    """Train one policy, or with --seeds one for each algorithm and seed."""
    shared = {"run": given.run, "preset": given.preset, "track": given.track, "report": given.report, **given.fields}
    shared["progress"] = not given.quiet
    if given.seeds is not None or "," in given.algorithm:
        if "seed" in given.fields:
            raise UserError("Several runs have several seeds: --seeds 1-5, not --seed.")
        if given.seeds is None:
            raise UserError("Algorithms are compared over several seeds: add --seeds 1-5.")
        runs = sweep.train_sweep(given.algorithm, given.env, given.seeds, **shared, **_callbacks(given))
        tell(f"Everything is in {runs.path}")
        return
    config = api.config_for(given.algorithm, given.env, given.preset, **given.fields)
    if config.backend:
        registry.require_backend(config.backend)
    preset, _ = choose(given.algorithm, config.env, given.preset)
    what = f"{given.algorithm} on {config.num_envs} × {config.env}, backend {config.backend}"
    tell(f"{what}: preset {preset}, seed {config.seed}, {'compiled' if is_compiled(config) else 'not compiled'}")
    processes = number(given.processes)
    run = api.train(given.algorithm, config.env, processes=processes, **shared, **_callbacks(given))
    if given.score:
        _say_score(run)
    tell(f"Trained in {run.seconds:.1f} s. Everything is in {run.path}")


def tune(given: argparse.Namespace) -> None:
    """Search for the best settings."""
    from lemniscate.tuning.tuner import tune

    if given.search is None:
        raise UserError("Search what? Name fields with their ranges: --search 'learning_rate=log:1e-4:1e-2'.")
    fields = {"run": given.run, "preset": given.preset, "seeds": given.seeds, "prune": given.prune, **given.fields}
    tuned = tune(
        given.algorithm,
        given.env,
        search=given.search,
        trials=number(given.trials),
        progress=not given.quiet,
        **fields,
    )
    tell(f"Everything is in {tuned.path}")


def resume(given: argparse.Namespace) -> None:
    """Continue an interrupted run, sweep or search. The runs of the latter two are begun by this command, too."""
    owned = end_with_owner()
    options = {"track": given.track, "report": given.report, "trust": given.trust, **_callbacks(given)}
    options["progress"] = not given.quiet
    if is_search(given.run):
        from lemniscate.tuning.tuner import resume_tuning

        run = resume_tuning(given.run, progress=not given.quiet, trust=given.trust)
    elif is_sweep(given.run):
        run = sweep.resume_sweep(given.run, **options)
    else:
        run = resumed.resume(given.run, processes=number(given.processes), **options)
        if given.score:
            _say_score(run)
        if not run.seconds:  # it was finished, which has been said
            return
    if not owned:
        tell(f"Done. Everything is in {run.path}")


def evaluate(given: argparse.Namespace) -> None:
    """Play whole episodes: scores as JSON on standard output, or as a sentence."""
    own = {"env_kwargs": _env_args(given), "backend": given.backend, "video": given.video, "trust": given.trust}
    scores = results.evaluate(given.run, episodes=number(given.episodes), seed=number(given.seed), **own)
    if given.json:
        print(json.dumps(scores.to_json(), allow_nan=False))
    else:
        say(pictures.sentence(scores.to_json()))


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


def plot(given: argparse.Namespace) -> None:
    """Draw the curves of one run, or compare several, grouped by all but the seed."""
    for file in plots.plot(*given.runs, by=given.by, trust=given.trust):
        say(file)


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


def tell(text: str) -> None:
    """Say it, where this process is the one that talks."""
    if talks():
        say(text)


def _say_score(run: TrainedRun) -> None:
    if not talks():
        return
    score = results.final_return(run)
    say(f"Final return {score:.1f} over {results.FINAL_EPISODES} episodes.")


def _env_args(given: argparse.Namespace) -> dict[str, Any] | None:
    return None if given.env_args is None else read_json("--env-args", given.env_args)


def _callbacks(given: argparse.Namespace) -> dict[str, Any]:
    names = [name for word in given.callbacks or () for name in word.split(",")]
    return {"callbacks": names} if names else {}
