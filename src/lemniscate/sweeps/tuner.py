"""The verbs of a search: Optuna proposes settings, several seeds try each of them, and the worse ones end early.

The settings are proposed by a tree-structured Parzen estimator (Bergstra et al. 2011), and trials end by asynchronous
successive halving (Li et al. 2020, arXiv:1810.05934): at a ninth and at a third of a run, a trial goes on if it is
among the best third of all that have come so far. The score of a trial is the interquartile mean over its seeds.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

from lemniscate.algos import name_of
from lemniscate.api import training
from lemniscate.api.policy import path_of
from lemniscate.cluster.connection import Cluster, find_cluster
from lemniscate.errors import SweepError, UserError
from lemniscate.report import curves
from lemniscate.report.seeds import iqm
from lemniscate.run.config import Range, checked
from lemniscate.run.directory import is_finished, locked
from lemniscate.run.metrics import progress_of, read_metrics
from lemniscate.run.places import LOG, Sweep, failure_of, is_sweep
from lemniscate.sweeps.search import (
    JOURNAL,
    NINTHS,
    PRESET,
    RUNGS,
    TRIALS,
    Search,
    Tuned,
    draw,
    import_optuna,
    mend,
    read_search,
    read_space,
    read_texts,
    score_at,
)
from lemniscate.sweeps.sweep import SetOfRuns, require_trainable, seeds_of
from lemniscate.system.console import say

if TYPE_CHECKING:
    import optuna

SEEDS = "101-103"
"""of a search, none of which any result of this project was evaluated with"""
EPISODES = 50
"""that the final policy of each seed plays"""


def tune(
    algorithm: str,
    env: str | None = None,
    *,
    search: str | Mapping[str, str],
    trials: int = 40,
    seeds: str | int | Iterable[int] = SEEDS,
    prune: bool = True,
    run: str | Path | None = None,
    preset: str | None = None,
    progress: bool = True,
    cluster: str | None = None,
    workers: int | None = None,
    **fields: object,
) -> Tuned:
    """Search for the settings with which an algorithm learns an environment best.

    The first trial has the settings of the preset as they are, as far as they lie in the ranges. The result is a preset
    in `preset.json`, with its provenance: `train(algorithm, preset="…/preset.json")`.

    Args:
        algorithm: a name.
        env: an id; None if the preset has one of its own.
        search: "learning_rate=log:1e-4:1e-2, gamma=.9:.999, hidden=64 64|256 256", or a dictionary of such texts.
        trials: number of settings that are tried.
        seeds: of every trial; its score is the interquartile mean over them. Evaluate the result with other ones.
        prune: end a trial after a ninth or a third of its steps if it is not among the best third.
        run: the search's directory; by default a new one under `runs/`.
        preset: the settings that are not searched; the best known for the environment unless given.
        progress: a line on standard error for each trial.
        cluster: "ray" or "ray=ADDRESS": train the trials' runs as Ray tasks, wherever there is room.
        workers: the most runs at a time there; by default as many as the cores serve.
        **fields: any other fields of the algorithm's Config, the same for all trials.

    Raises:
        UserError: what cannot be searched or trained; Optuna is not installed.
        Stopped: Ctrl-C or SIGTERM, when every run has saved itself; go on with `resume_tuning`.
        SweepError: no trial has come to its end.
    """
    import_optuna()
    if "seed" in fields:
        raise UserError("A search has several seeds: they are given as seeds, not as seed.")
    for name in sorted({"checkpoint_every", "evaluate_every"} & set(fields)):
        raise UserError(f"{name} is set by the search, which compares trials after a ninth and a third of a run.")
    algorithm = name_of(algorithm)
    config = training.config_for(algorithm, env, preset, **fields)
    trials, prune = checked("trials", trials, Annotated[int, Range(1, 10_000)]), checked("prune", prune, bool)
    config = config.replace(
        checkpoint_every=-(-config.total_steps // NINTHS),
        evaluate_every=config.total_steps,
        evaluate_episodes=fields.get("evaluate_episodes") or EPISODES,
    )
    there, texts, numbers = find_cluster(cluster, workers), read_texts(search), seeds_of(seeds)
    for name, values in read_space(texts, config).items():
        if name in fields and values.key_of(getattr(config, name)) is None:
            raise UserError(f"{name} is {fields[name]!r}, and is searched elsewhere: {name}={texts[name]}.")
    require_trainable({algorithm: config}, numbers)
    path = path_of(run) if run is not None else training.fresh_directory(config.env, f"{algorithm}-tune")
    what = Search(path, algorithm, config, texts, numbers, trials, prune)
    what.create()
    with locked(path):
        return _Tuner(what, progress, there).tune()


def resume_tuning(
    path: str | Path | Tuned,
    *,
    progress: bool = True,
    cluster: str | None = None,
    workers: int | None = None,
) -> Tuned:
    """Go on with an interrupted search. Each run of each trial ends in the same bits as if it had not been stopped."""
    search, there = read_search(path_of(path)), find_cluster(cluster, workers)
    with locked(search.path):
        mend(search.path / JOURNAL)
        if (search.path / TRIALS).exists() and not (search.path / JOURNAL).stat().st_size:
            raise UserError(f"{search.path} has lost its {JOURNAL}, which says what was tried: begin a new search.")
        return _Tuner(search, progress, there).tune()


@dataclass
class _Trial:
    """A trial that has not ended: its sweep, and which of its runs are to go on to the next rung."""

    asked: "optuna.Trial"
    sweep: Sweep
    rung: int
    """how many it has passed"""
    waiting: list[Path] = field(default_factory=list)
    training: set[Path] = field(default_factory=set)
    failure: str = ""


class _Tuner(SetOfRuns):
    """The trials of a search, and the places at which their runs are trained."""

    def __init__(self, search: Search, progress: bool, cluster: Cluster | None) -> None:
        super().__init__(search.path, [search.config.to_json()], cluster)
        self._search, self._say = search, say if progress else lambda _text: None
        self._space, self._study = search.space, search.study()
        self._trials: list[_Trial] = []

    def tune(self) -> Tuned:
        """Take up what was interrupted, and try everything that is left to try. Raises `Stopped` after a signal."""
        optuna, known = import_optuna(), self._study.trials
        if not known:  # of a new search, the first trial has the settings as they are
            values = {name: getattr(self._search.config, name) for name in self._space}
            keys = {name: self._space[name].key_of(value) for name, value in values.items()}
            self._study.enqueue_trial({name: key for name, key in keys.items() if key is not None})
        for frozen in known:
            if frozen.state.name == "RUNNING":
                asked = optuna.trial.Trial(self._study, frozen._trial_id)
                if frozen.intermediate_values and asked.should_prune():  # the process was killed before it was told
                    self._end(asked, "ended, since its return was low", state="PRUNED")
                else:
                    self._take_up(asked, rung=len(frozen.intermediate_values))
        self._say(
            f"{self._search.path}: {len(self._trials) + self._missing} of {self._search.trials} trials to run, with"
            f" {len(self._search.seeds)} seeds each, {self._places.count} runs at a time: {self._search.what}"
        )
        self._train_all()
        return self._result()

    @property
    def _missing(self) -> int:
        """The number of trials that have not begun."""
        return self._search.trials - sum(trial.state.name != "WAITING" for trial in self._study.trials)

    def _take_up(self, asked: "optuna.Trial", rung: int = 0) -> None:
        """Let the runs of a trial, which begins or was interrupted, wait for places.

        It fails where its values, each in its range, do not go together.
        """
        try:
            trial = _Trial(asked, self._search.sweep(f"{asked.number:03d}", draw(self._space, asked)), rung)
        except UserError as error:
            self._end(asked, f"failed, {str(error).rstrip('.')}", state="FAIL")
            return
        if not is_sweep(trial.sweep.path):
            trial.sweep.create()
        trial.sweep.create_runs()
        self._trials.append(trial)
        self._queue(trial)

    def _queue(self, trial: _Trial) -> None:
        """Let the runs of a trial wait for a place, in which they go on to its next rung, or to their end."""
        until = self._search.rungs[trial.rung]
        has_come = is_finished if until is None else lambda run: progress_of(run)[0] >= until
        trial.waiting = [run for run in trial.sweep.runs if not has_come(run)]

    def _begin_runs(self) -> bool:
        """Compare the trials that have come to a rung, then start runs: those of the trials that are furthest first."""
        for trial in [trial for trial in self._trials if not (trial.waiting or trial.training)]:
            self._compare(trial)
        while self._has_room:
            trial = max((t for t in self._trials if t.waiting), key=lambda t: (t.rung, -t.asked.number), default=None)
            if trial is None:
                if not self._missing:
                    break
                self._take_up(self._search.ask(self._study))
                continue
            until = self._search.rungs[trial.rung]
            options = ["--callbacks", f"lemniscate.api.callbacks:StopAt(steps={until})"] if until else []
            run = trial.waiting.pop(0)
            trial.training.add(run)
            self._start(run, options)
        return not self._is_finished()

    def _is_finished(self) -> bool:
        return not (self._trials or self._missing)

    def _run_ended(self, run: Path, code: int) -> None:
        trial = next(trial for trial in self._trials if run in trial.training)
        trial.training.remove(run)
        if code and not trial.failure and not self._stop_signal:
            trial.failure = f"{run.name}: {failure_of(run, code)} ({run / LOG} says more)"
            trial.waiting.clear()
            self._places.stop(list(trial.training))

    def _compare(self, trial: _Trial) -> None:
        """Decide whether a trial whose runs have all come to a rung goes on, or take its score at its end."""
        until = self._search.rungs[trial.rung]
        if trial.failure:
            self._end(trial.asked, f"failed, {trial.failure}", state="FAIL")
        elif until is None:
            lasts = {run: line for run in trial.sweep.runs for line in read_metrics(run)[-1:]}
            if lacking := [run for run in trial.sweep.runs if "evaluation/return" not in lasts.get(run, {})]:
                said = f"failed, {lacking[0].name} has no evaluation at its end ({lacking[0] / LOG} says more)"
                self._end(trial.asked, said, state="FAIL")
                return
            score = float(iqm([line["evaluation/return"] for line in lasts.values()]))
            self._end(trial.asked, f"score {score:,.1f}", score)
            if self._study.best_trial.number == trial.asked.number:
                self._search.write_preset(self._study.best_trial)
        else:
            score, ninths = score_at(trial.sweep.runs, until), RUNGS[trial.rung]
            trial.rung += 1
            if score is not None:
                trial.asked.report(score, ninths)
            if score is not None and trial.asked.should_prune():
                sentence = f"ended after {ninths} of {NINTHS} parts, where its return was {score:,.1f}"
                self._end(trial.asked, sentence, state="PRUNED")
            else:
                self._queue(trial)

    def _end(self, asked: "optuna.Trial", sentence: str, score: float | None = None, state: str = "") -> None:
        self._study.tell(asked, score, import_optuna().trial.TrialState[state] if state else None)
        self._trials = [trial for trial in self._trials if trial.asked is not asked]
        shown = {name: f"{x:.3g}" if isinstance(x, float) else x for name, x in asked.params.items()}
        self._say(f"trial {asked.number}: {sentence}; {', '.join(f'{name} {x}' for name, x in shown.items())}")

    def _result(self) -> Tuned:
        """The best trial, and pictures of all."""
        trials, path = self._study.trials, self._search.path
        if all(trial.state.name != "COMPLETE" for trial in trials):
            raise SweepError(f"None of the {self._search.trials} trials has come to its end; their logs say why.")
        best = self._study.best_trial
        preset = self._search.write_preset(best)
        assert best.value is not None
        self._say(f"Best of {len(trials)} trials: number {best.number}, score {best.value:,.1f}.")
        self._say(preset.to_toml())
        for picture in curves.draw_study(self._study, list(self._space), path / "plots"):
            self._say(str(picture))
        self._say(
            f"Evaluate it with seeds that the search has not seen: lemniscate train {self._search.algorithm} --preset"
            f" {quote(str(path / PRESET))} --seeds 1-10"
        )
        records = [{"number": t.number, "state": t.state.name, "score": t.value, **t.params} for t in trials]
        return Tuned(path, preset, best.value, records)
