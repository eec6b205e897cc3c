"""The work of the commands that train: each takes what `parse` understood."""

import argparse
from typing import Any

from lemniscate.api import results, resumed, training
from lemniscate.api.stored import TrainedRun
from lemniscate.envs import registry
from lemniscate.errors import UserError
from lemniscate.presets import choose
from lemniscate.run.run import is_compiled
from lemniscate.run.sweep_file import is_search, is_sweep
from lemniscate.run.texts import number
from lemniscate.sweeps import sweep
from lemniscate.system.console import say, talks
from lemniscate.system.owner import end_with_owner


def train(given: argparse.Namespace) -> None:
    """Train one policy, or with --seeds one for each algorithm and seed."""
    shared = {"run": given.run, "preset": given.preset, "track": given.track, "report": given.report, **given.fields}
    shared["progress"] = not given.quiet
    if given.unnamed:
        why = "takes every kind of actions and, mostly, needs the fewest minutes"
        tell(f"No algorithm is named: {given.algorithm} {why}.")
    if given.seeds is not None or "," in given.algorithm:
        if "seed" in given.fields:
            raise UserError("Several runs have several seeds: --seeds 1-5, not --seed.")
        if given.seeds is None:
            raise UserError("Algorithms are compared over several seeds: add --seeds 1-5.")
        shared |= _cluster(given)
        runs = sweep.train_sweep(given.algorithm, given.env, given.seeds, **shared, **_callbacks(given))
        tell(f"Everything is in {runs.path}")
        return
    config = training.config_for(given.algorithm, given.env, given.preset, **given.fields)
    if config.backend:
        registry.backend_class(config.backend)  # refuses one that is not there
    preset, _ = choose(given.algorithm, config.env, given.preset)
    what = f"{given.algorithm} on {config.num_envs} × {config.env}, backend {config.backend}"
    tell(f"{what}: preset {preset}, seed {config.seed}, {'compiled' if is_compiled(config) else 'not compiled'}")
    run = training.train(given.algorithm, config.env, **_places(given), **shared, **_callbacks(given))
    if given.score:
        _say_score(run)
    tell(f"Trained in {run.seconds:.1f} s. Everything is in {run.path}")


def tune(given: argparse.Namespace) -> None:
    """Search for the best settings."""
    from lemniscate.sweeps.tuner import tune

    if given.search is None:
        raise UserError("Search what? Name fields with their ranges: --search 'learning_rate=log:1e-4:1e-2'.")
    fields = {"run": given.run, "preset": given.preset, "seeds": given.seeds, "prune": given.prune, **given.fields}
    fields |= {**_cluster(given), "trials": number(given.trials), "progress": not given.quiet}
    fields["population"] = given.population
    tuned = tune(given.algorithm, given.env, search=given.search, **fields)
    tell(f"Everything is in {tuned.path}")


def resume(given: argparse.Namespace) -> None:
    """Continue an interrupted run, sweep or search. The runs of the latter two are begun by this command, too."""
    owned = end_with_owner()
    options = {"track": given.track, "report": given.report, "trust": given.trust, **_callbacks(given)}
    options["progress"] = not given.quiet
    if is_search(given.run):
        from lemniscate.sweeps.tuner import resume_tuning

        run = resume_tuning(given.run, **_cluster(given), progress=not given.quiet, trust=given.trust)
    elif is_sweep(given.run):
        run = sweep.resume_sweep(given.run, **_cluster(given), **options)
    else:
        run = resumed.resume(given.run, **_places(given), **options)
        if given.score:
            _say_score(run)
        if not run.seconds:  # it was finished, which has been said
            return
    if not owned:
        tell(f"Done. Everything is in {run.path}")


def tell(text: str) -> None:
    """Say it, where this process is the one that talks."""
    if talks():
        say(text)


def _say_score(run: TrainedRun) -> None:
    if talks():
        say(f"Final return {results.final_return(run):.1f} over {results.FINAL_EPISODES} episodes.")


def _places(given: argparse.Namespace) -> dict[str, Any]:
    """The places of a run's processes and of its storage."""
    return {"processes": number(given.processes), **_cluster(given), "storage": given.storage}


def _cluster(given: argparse.Namespace) -> dict[str, Any]:
    return {"cluster": given.cluster, "workers": given.workers and number(given.workers)}


def _callbacks(given: argparse.Namespace) -> dict[str, Any]:
    names = [name for word in given.callbacks or () for name in word.split(",")]
    return {"callbacks": names} if names else {}
