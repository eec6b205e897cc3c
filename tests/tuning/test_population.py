"""Population-based training: who is copied, what changes, and that a member is trained with its own settings."""

import contextlib
import io
import json
import math

import numpy as np
import pytest

import lemniscate as lem
from lemniscate.cli import main
from lemniscate.errors import SweepError
from lemniscate.presets.preset import read_preset
from lemniscate.report.seeds import iqm
from lemniscate.run.metrics import read_metrics
from lemniscate.sweeps.population import Population
from lemniscate.sweeps.space import read_space, sample, vary
from lemniscate.sweeps.study import TENTHS, Search
from lemniscate.system.files import read_json
from tuning.here import Here

ENV = "environments:Copy-box-v0"
FLAGS = ["--env", ENV, "--num-envs", "4", "--num-steps", "16", "--total-steps", "1_280", "--minibatch-size", "32"]
SEARCH = {"learning_rate": "log:1e-4:1e-2", "epochs": "2:9", "clip": "0.1|0.2"}
RANGES = ", ".join(f"{name}={text}" for name, text in SEARCH.items())
WORDS = ["tune", "ppo", *FLAGS, "--desired-kl", "none", "--search", RANGES, "--population", "--trials", "4"]
WORDS += ["--seeds", "101-102", "--run"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A population of four, and its lines on standard error."""
    path = tmp_path_factory.mktemp("populations") / "four"
    with contextlib.redirect_stderr(io.StringIO()) as said, pytest.MonkeyPatch.context() as patch:
        patch.setattr("lemniscate.sweeps.population.places_on", Here)
        code = main([*WORDS, str(path)])
    assert code == 0, said.getvalue()
    return path, said.getvalue()


def tenths_of(path):
    return read_json(path / "population.json")["tenths"]


def population(folder, members=8, search=SEARCH):
    """A population of which nothing has been trained."""
    config = lem.api.config_for("ppo", ENV, num_envs=4, num_steps=16, minibatch_size=32, desired_kl=None)
    what = Search(folder / "search", "ppo", config, search, [101], members, prune=True, population=True)
    what.create()
    made = Population(what, progress=False, cluster=None)
    made._append([{"settings": settings, "copy_of": None} for settings in made._first_settings()])
    return made


def test_the_first_member_has_the_settings_as_they_are_and_the_others_any(trained):
    first, *others = [member["settings"] for member in tenths_of(trained[0])[0]]
    config = lem.api.config_for("ppo", ENV)
    assert first == {name: getattr(config, name) for name in SEARCH}
    assert len({other["learning_rate"] for other in others}) == 3


def test_every_run_of_a_tenth_is_trained_with_the_settings_of_its_member(trained):
    path, _ = trained
    tenths, used = tenths_of(path), {}
    for folder in (path / "trials").iterdir():
        member, since = map(int, folder.name.split("-"))
        record = json.loads((folder / "ppo-101" / "config.json").read_text())["config"]
        used[member, since] = {name: record[name] for name in SEARCH}
    for (member, since), settings in used.items():
        assert tenths[since - 1][member]["settings"] == settings
    copies = [
        (member, i + 1) for i, tenth in enumerate(tenths) for member in range(4) if tenth[member]["copy_of"] is not None
    ]
    assert set(used) == {(member, 1) for member in range(4)} | set(copies)
    assert len(tenths) == TENTHS
    assert copies


def test_a_copy_goes_on_from_the_metrics_of_its_source_with_a_learning_rate_of_its_own(trained):
    path, _ = trained
    tenths = tenths_of(path)
    i, member = next((i, m) for i, t in enumerate(tenths) for m in range(4) if t[m]["copy_of"] is not None)
    source = tenths[i][member]["copy_of"]
    since = max(j for j in range(i) if j == 0 or tenths[j][source]["copy_of"] is not None)
    theirs = read_metrics(path / "trials" / f"{source:03d}-{since + 1:02d}" / "ppo-101")
    ours = read_metrics(path / "trials" / f"{member:03d}-{i + 1:02d}" / "ppo-101")
    step = i * 128
    assert [line for line in ours if line["step"] <= step] == [line for line in theirs if line["step"] <= step]
    after = next(line for line in ours if line["step"] > step)
    left = 1 - (after["step"] - 64) / 1_280
    assert after["learning_rate"] == pytest.approx(tenths[i][member]["settings"]["learning_rate"] * left, rel=0.2)


def test_the_best_member_is_the_preset_and_its_score_the_mean_over_seeds(trained):
    path, said = trained
    preset = read_preset(path / "preset.json", "ppo")
    scores = []
    for member in range(4):
        folder = max((path / "trials").glob(f"{member:03d}-*"))
        scores.append(iqm([read_metrics(run)[-1]["evaluation/return"] for run in sorted(folder.glob("ppo-*"))]))
    best = int(np.argmax(scores))
    settings = tenths_of(path)[-1][best]["settings"]
    assert {name: getattr(preset.config, name) for name in SEARCH} == settings
    assert f"member {best} in its last tenth" in preset.source
    assert f"Best of 4 members: number {best}, score {scores[best]:,.1f}." in said
    assert (path / "plots" / "population.png").stat().st_size > 10_000


def test_interrupted_at_any_point_it_ends_the_same(trained, tmp_path, monkeypatch):
    class Interrupted(Here):
        left = 7

        def start(self, run, options):
            Interrupted.left -= 1
            if Interrupted.left < 0:
                raise KeyboardInterrupt
            super().start(run, options)

    path = tmp_path / "search"
    monkeypatch.setattr("lemniscate.sweeps.population.places_on", Interrupted)
    assert main([*WORDS, str(path)]) != 0
    while not (path / "preset.json").exists():
        Interrupted.left = 23
        main(["resume", str(path)])
    assert tenths_of(path) == tenths_of(trained[0])
    mine, theirs = (read_json(folder / "preset.json") for folder in (path, trained[0]))
    assert mine["fields"] == theirs["fields"]


def test_the_worst_quarter_goes_on_as_copies_of_the_best(tmp_path):
    made = population(tmp_path)
    members = made._next([5.0, 8.0, 1.0, 3.0, 7.0, 2.0, 6.0, 4.0])
    copies = {i: member["copy_of"] for i, member in enumerate(members) if member["copy_of"] is not None}
    assert set(copies) == {2, 5}
    assert set(copies.values()) <= {1, 4}
    for i, member in enumerate(members):
        same = member["settings"] == made._tenths[0][i]["settings"]
        assert same == (i not in copies)
    again = population(tmp_path / "again")._next([5.0, 8.0, 1.0, 3.0, 7.0, 2.0, 6.0, 4.0])
    assert again == members


def test_a_member_that_failed_is_copied_over_and_one_without_an_episode_waits(tmp_path):
    made = population(tmp_path, 4)
    members = made._next([5.0, -math.inf, 6.0, 4.0])
    assert [member["copy_of"] for member in members] == [None, 2, None, None]
    members = made._next([5.0, math.nan, 6.0, 4.0])
    assert [member["copy_of"] for member in members] == [None] * 4
    with pytest.raises(SweepError, match="Every member of the population failed"):
        made._next([-math.inf] * 4)


def test_settings_vary_by_a_quarter_within_their_ranges():
    config = lem.api.config_for("ppo", ENV)
    space, rng = read_space(SEARCH, config), np.random.default_rng(1)
    drawn = [sample(space, rng) for _ in range(2_000)]
    rates = np.log10([settings["learning_rate"] for settings in drawn])
    assert rates.min() >= -4
    assert rates.max() <= -2
    assert abs(rates.mean() + 3) < 0.05
    assert {settings["epochs"] for settings in drawn} == set(range(2, 10))
    assert {settings["clip"] for settings in drawn} == {0.1, 0.2}
    near = [vary(space, {"learning_rate": 1e-3, "epochs": 5, "clip": 0.2}, rng) for _ in range(2_000)]
    stay = np.mean([settings["learning_rate"] in (8e-4, 1.25e-3) for settings in near])
    assert abs(stay - 0.75) < 0.05
    assert np.mean([settings["epochs"] in (4, 6) for settings in near]) > 0.7
    assert abs(np.mean([settings["clip"] == 0.2 for settings in near]) - 0.875) < 0.05
    edge = [vary(space, {"learning_rate": 1e-2, "epochs": 9, "clip": 0.1}, rng) for _ in range(200)]
    assert max(settings["learning_rate"] for settings in edge) == 1e-2
    assert max(settings["epochs"] for settings in edge) == 9


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--trials", "3"], "A population has 4 members or more: trials must not be 3."),
        (["--search", "learning_rate=1e-4:1e-3", "--desired-kl", "0.01"], "learning_rate follows desired_kl here"),
        (["--checkpoint-every", "100"], "checkpoint_every follows from the search"),
        (["--search", "hidden=16|32"], "hidden cannot change while a run is trained, as settings of a population do."),
    ],
)
def test_what_is_no_population_has_its_sentence(tmp_path, words, sentence, capsys):
    assert main([*WORDS, str(tmp_path / "search"), *words]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "search").exists()
