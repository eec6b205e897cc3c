"""Searches: real processes; every trial's runs end in the same bits as alone, whatever interrupts the search."""

import contextlib
import io
import json
import shutil
import signal
import subprocess
import sys
import time

import pytest

import lemniscate as lem
from forks import command
from lemniscate.api.training import config_for
from lemniscate.cli import main, parse
from lemniscate.presets import read_preset, read_toml
from lemniscate.report.seeds import iqm
from lemniscate.run import checkpoint
from lemniscate.run.metrics import read_metrics
from lemniscate.sweeps.search import read_search
from tuning.here import in_this_process

ENV = "environments:Copy-box-v0"
STEPS = 2_304
FLAGS = ["--env", ENV, "--num-envs", "4", "--num-steps", "16", "--total-steps", str(STEPS), "--minibatch-size", "32"]
FLAGS += ["--epochs", "2", "--evaluate-episodes", "5", "--compile", "off"]
SEARCH = ["--search", "learning_rate=log:1e-4:1e-2, hidden=16|32", "--seeds", "101-102"]


def final_hash(run):
    last = run / "checkpoints" / f"step-{checkpoint.list_steps(run / 'checkpoints')[-1]}"
    return json.loads((last / "manifest.json").read_text())["sha256"]


def trials_of(path):
    return {trial.number: trial for trial in read_search(path).study().trials}


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """A search of four trials, and its lines on standard error."""
    path = tmp_path_factory.mktemp("searches") / "both"
    with contextlib.redirect_stderr(io.StringIO()) as said, in_this_process():
        code = main(["tune", "ppo", *FLAGS, *SEARCH, "--trials", "4", "--run", str(path)])
    assert code == 0, said.getvalue()
    return path, said.getvalue()


def test_the_first_trial_has_the_settings_as_they_are(tuned):
    config = read_search(tuned[0]).sweep("000", {}).configs["ppo"]
    record = json.loads((tuned[0] / "trials" / "000" / "sweep.json").read_text())["configs"]["ppo"]
    assert record["learning_rate"] == config["learning_rate"]


def test_a_trial_that_ends_has_the_interquartile_mean_over_its_seeds(tuned):
    for number, trial in trials_of(tuned[0]).items():
        runs = sorted((tuned[0] / "trials" / f"{number:03d}").glob("ppo-*"))
        assert [run.name for run in runs] == ["ppo-101", "ppo-102"]
        if trial.state.name == "COMPLETE":
            assert trial.value == pytest.approx(iqm([read_metrics(run)[-1]["evaluation/return"] for run in runs]))


def test_the_worse_trials_end_early(tuned):
    states = {number: trial.state.name for number, trial in trials_of(tuned[0]).items()}
    assert set(states.values()) == {"COMPLETE", "PRUNED"}
    for number, state in states.items():
        for run in (tuned[0] / "trials" / f"{number:03d}").glob("ppo-*"):
            steps = checkpoint.list_steps(run / "checkpoints")[-1]
            assert (steps < STEPS) == (state == "PRUNED")
            if state == "PRUNED":
                assert steps in (STEPS // 9, STEPS // 3)


def test_the_best_trial_is_the_preset_with_its_provenance(tuned):
    path, said = tuned
    preset = read_preset(path / "preset.json", "ppo")
    complete = [trial for trial in trials_of(path).values() if trial.state.name == "COMPLETE"]
    best = max(complete, key=lambda trial: trial.value)
    record = json.loads((path / "trials" / f"{best.number:03d}" / "sweep.json").read_text())["configs"]["ppo"]
    assert preset.config.learning_rate == record["learning_rate"]
    assert list(preset.config.hidden) == record["hidden"]
    assert f"trial {best.number} of 4" in preset.source
    assert "seeds 101, 102" in preset.source
    assert preset.config.checkpoint_every == 0  # that of the search is its own
    assert f"Best of 4 trials: number {best.number}" in said
    assert "--seeds 1-10" in said


def test_the_preset_trains(tuned, tmp_path):
    run = lem.train("ppo", preset=str(tuned[0] / "preset.json"), total_steps=64, run=tmp_path / "run", progress=False)
    assert run.policy.config.learning_rate == read_preset(tuned[0] / "preset.json", "ppo").config.learning_rate
    with pytest.raises(lem.UserError, match="is a preset of ppo, not of sac"):
        lem.train("sac", preset=str(tuned[0] / "preset.json"))


def test_the_preset_is_ready_to_be_pasted(tuned):
    preset = read_preset(tuned[0] / "preset.json", "ppo")
    assert read_toml("ppo", preset.to_toml()) == [preset]


def test_each_run_of_a_trial_ends_in_the_bits_of_a_run_alone(tuned, tmp_path):
    path, _ = tuned
    number = next(n for n, trial in trials_of(path).items() if trial.state.name == "COMPLETE")
    record = json.loads((path / "trials" / f"{number:03d}" / "ppo-102" / "config.json").read_text())["config"]
    config = lem.algos.find("ppo").Config.from_json(record)
    alone = lem.train(config, run=tmp_path / "alone", progress=False)
    assert final_hash(alone.path) == final_hash(path / "trials" / f"{number:03d}" / "ppo-102")


@pytest.mark.long
def test_an_interrupted_search_goes_on_with_every_trial_exact(tuned, tmp_path):
    path = tmp_path / "search"
    words = ["tune", "ppo", *FLAGS, *SEARCH, "--seeds", "101", "--trials", "2", "--run", path]
    first = command(*words, "--no-prune")  # which of two trials ends early is a matter of speed
    while not list(path.glob("trials/000/*/checkpoints/step-*")) and first.poll() is None:
        time.sleep(0.05)
    first.send_signal(signal.SIGINT)
    assert first.wait() == 130, first.communicate()
    assert f"lemniscate resume {path}" in first.communicate()[1]
    second = command("resume", path)
    assert second.wait() == 0, second.communicate()
    assert len(trials_of(path)) == 2
    assert trials_of(path)[0].params == trials_of(tuned[0])[0].params
    run = "trials/000/ppo-101"
    assert final_hash(path / run) == final_hash(tuned[0] / run)


def test_what_needs_one_run_says_so_of_a_search(tuned, capsys):
    path, *_ = tuned
    for words in (["evaluate", str(path)], ["plot", str(path)], ["doctor", str(path)]):
        assert main(words) == 2, words
        said = capsys.readouterr().err
        assert said == f"{path} is a search: name one of its trials, such as {path / 'trials' / '000'}.\n"


def test_a_finished_search_is_resumed_in_no_time(tuned, monkeypatch, capsys):
    monkeypatch.setattr(subprocess, "Popen", None)
    assert main(["resume", str(tuned[0])]) == 0
    assert "0 of 4 trials to run" in capsys.readouterr().err


def test_what_is_proposed_after_an_interruption_is_new(tmp_path):
    search = read_search_of(tmp_path, trials=8)
    numbers = []
    for _ in range(6):  # as many processes, one trial each
        study = search.study()
        asked = search.ask(study)
        numbers.append(asked.suggest_float("learning_rate", 1e-4, 1e-2, log=True))
        study.tell(asked, 1.0)
    assert len(set(numbers)) == 6
    one = read_search_of(tmp_path / "one", trials=8)
    study = one.study()
    alone = []
    for _ in range(6):
        asked = one.ask(study)
        alone.append(asked.suggest_float("learning_rate", 1e-4, 1e-2, log=True))
        study.tell(asked, 1.0)
    assert alone == numbers


def read_search_of(folder, trials):
    from lemniscate.sweeps.search import Search

    config = config_for("ppo", ENV)
    folder.mkdir(exist_ok=True)
    search = Search(folder / "search", "ppo", config, {"learning_rate": "log:1e-4:1e-2"}, [101], trials, True)
    search.create()
    return search


def test_a_trial_that_fails_is_told_and_the_search_goes_on(tmp_path, capsys):
    path = tmp_path / "search"
    words = ["--search", "learning_rate=1e-3|1e30", "--trials", "3", "--seeds", "101", "--no-prune", "--run", str(path)]
    with in_this_process():
        assert main(["tune", "ppo", *FLAGS, *words, "--env", "Pendulum-v1", "--total-steps", "1_152"]) in (0, 1)
    states = [trial.state.name for trial in trials_of(path).values()]
    said = capsys.readouterr().err
    assert set(states) <= {"COMPLETE", "FAIL"}
    for number, state in enumerate(states):
        assert (f"trial {number}: failed, ppo-101: " in said) == (state == "FAIL")


def test_values_that_do_not_go_together_fail_alone(tmp_path, capsys):
    """Each is in its range, and rollouts of 16 steps of 4 environments are smaller than minibatches of 72."""
    path = tmp_path / "search"
    words = ["--search", "num_steps=16|20, minibatch_size=32|72", "--trials", "6", "--seeds", "101", "--run", str(path)]
    flags = [*FLAGS, "--total-steps", "640", "--num-steps", "20"]
    with in_this_process():
        assert main(["tune", "ppo", *flags, *words, "--no-prune"]) == 0
    said, trials = capsys.readouterr().err, trials_of(path).values()
    failed = [t.number for t in trials if t.params == {"num_steps": "16", "minibatch_size": "72"}]
    assert failed
    for number in failed:
        assert f"trial {number}: failed, minibatch_size 72 is above the 64 rows of a rollout" in said
    assert {t.state.name for t in trials if t.number not in failed} == {"COMPLETE"}
    assert main(["resume", str(path)]) == 0


def test_a_journal_that_was_cut_off_goes_on_and_one_that_is_lost_or_damaged_is_named(tuned, tmp_path, capsys):
    path = shutil.copytree(tuned[0], tmp_path / "search")
    journal, whole = path / "study.journal", (tuned[0] / "study.journal").read_bytes()
    lines = whole.splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:-1]) + lines[-1][:20])
    with in_this_process():
        assert main(["resume", str(path)]) == 0  # the last trial is told again
    assert all(map(json.loads, journal.read_text().splitlines()))
    assert {n: t.value for n, t in trials_of(path).items()} == {n: t.value for n, t in trials_of(tuned[0]).items()}
    journal.write_bytes(lines[0] + b"garbage\n" + lines[1])
    assert main(["resume", str(path)]) == 2
    journal.unlink()
    assert main(["resume", str(path)]) == 2
    said = capsys.readouterr().err
    assert f"{journal} cannot be read: JSONDecodeError" in said
    assert f"{path} has lost its study.journal, which says what was tried: begin a new search." in said


def test_a_field_that_is_given_lies_in_the_range_that_is_searched(tmp_path):
    with pytest.raises(lem.UserError, match=r"gamma is 0\.5, and is searched elsewhere: gamma=\.9:\.99\."):
        lem.tune("ppo", env="CartPole-v1", search="gamma=.9:.99", gamma=0.5, run=tmp_path / "t")
    assert not (tmp_path / "t").exists()


def test_the_pictures_show_history_importance_and_settings(tuned):
    assert (tuned[0] / "plots" / "history.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--search", "gamma=.9:.99", "--trials", "0"], "trials must be a whole number from 1 to 10,000, not 0."),
        (["--search", "gamma=.9:.99", "--trials", "many"], "trials must be a whole number"),
        (["--search", "gamma=.9:.99", "--seed", "3"], "several seeds"),
        (["--search", "gamma=.9:.99", "--seeds", "x"], "seeds"),
        (["--search", "gama=.9:.99"], "did you mean gamma"),
        (
            ["--search", "gamma=.9:.99", "--population"],
            "Population-based training has gone: `lemniscate tune` ends the",
        ),
        ([], "Search what?"),
        (["--search", "minibatch_size=64|100_000"], "minibatch_size 100,000 is above"),
    ],
)
def test_what_cannot_be_searched_has_its_sentence_and_leaves_nothing(tmp_path, words, sentence, capsys):
    path = tmp_path / "search"
    assert main(["tune", "ppo", *FLAGS, "--run", str(path), *words]) == 2
    assert sentence in capsys.readouterr().err
    assert not path.exists()


def test_whether_to_prune_is_true_or_false(tmp_path):
    with pytest.raises(lem.UserError, match=r"prune must be True or False, not 'no'\."):
        lem.tune("ppo", env="CartPole-v1", search="gamma=.9:.99", prune="no", run=tmp_path / "t")
    assert not (tmp_path / "t").exists()


def test_a_search_is_for_one_algorithm(capsys):
    assert main(["tune", "ppo,sac", "--search", "gamma=.9:.99"]) == 2
    assert "A search is for one algorithm: lemniscate tune ppo" in capsys.readouterr().err


def test_without_optuna_the_extra_is_named(tmp_path):
    without = "import sys; sys.modules['optuna'] = None\nfrom lemniscate.cli import main\nsys.exit(main(sys.argv[1:]))"
    words = ["tune", "ppo", "--env", ENV, "--search", "gamma=.9:.99", "--run", tmp_path / "search"]
    ended = subprocess.run([sys.executable, "-c", without, *map(str, words)], capture_output=True, text=True)
    assert ended.returncode == 2
    assert "it comes with the extra tune" in ended.stderr
    assert not (tmp_path / "search").exists()


def test_the_words_of_tune_are_understood():
    given = parse(["tune", "ppo", *FLAGS, *SEARCH, "--no-prune"])
    assert (given.command, given.algorithm, given.seeds, given.prune) == ("tune", "ppo", "101-102", False)
    assert given.fields["num_steps"] == 16


def test_a_trial_whose_last_evaluation_is_missing_fails_alone(tmp_path, monkeypatch, capsys):
    """As that of a policy whose episodes do not end."""
    path, trained = tmp_path / "search", lem.api.training._train

    def without_the_last_evaluation(world, run, *given):
        done = trained(world, run, *given)
        if "/000/" in str(run):
            file = run / "metrics.jsonl"
            file.write_text("".join(file.read_text().splitlines(keepends=True)[:-1]))
        return done

    monkeypatch.setattr(lem.api.training, "_train", without_the_last_evaluation)
    words = ["--search", "learning_rate=1e-3|3e-4", "--trials", "2", "--seeds", "101", "--no-prune", "--run", str(path)]
    with in_this_process():
        assert main(["tune", "ppo", *FLAGS, *words, "--total-steps", "1_152"]) == 0
    assert "trial 0: failed, ppo-101 has no evaluation at its end (" in capsys.readouterr().err
    assert [trial.state.name for trial in trials_of(path).values()] == ["FAIL", "COMPLETE"]
