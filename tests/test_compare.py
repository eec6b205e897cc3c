"""Runs side by side: grouping, the table, the refusal to rank on one seed, the pictures."""

import dataclasses
import json

import numpy as np
import pytest

import lemniscate as lem
from lemniscate.report import compare, curves
from lemniscate.report.curves import training_minutes
from lemniscate.report.seeds import group, interval, iqm, probability_of_improvement
from lemniscate.run import checkpoint
from lemniscate.run.metrics import to_line
from lemniscate.system.files import write_json


@dataclasses.dataclass
class Weightless:
    """A training state without networks."""

    step: int = 0

    def saved(self):
        return {"step": self.step}


def write_run(path, algorithm="ppo", env="CartPole-v1", seed=1, score=100.0, *, taken=None, rate=100.0, **fields):
    """A run directory as training leaves it, of 1,000 steps in ten lines, without the weights."""
    config = lem.config_for(algorithm, env, seed=seed, **{"total_steps": 10_000, **fields}).to_json()
    path.mkdir(parents=True)
    write_json(path / "config.json", {"algorithm": algorithm, "config": config})
    last = 10_000 if taken is None else taken
    with (path / "metrics.jsonl").open("wb") as file:
        for step in range(1_000, last + 1, 1_000):
            returns = [score * step / 10_000] * 3
            file.write(to_line({"step": step, "time/steps_per_second": rate, "episode/returns": returns}))
    checkpoint.write(path / "checkpoints", Weightless().saved(), last, {"planned": True}, keep=1)
    write_json(path / "final.json", {"step": last, "mean_return": score})
    return path


def write_runs(folder, seeds=(1, 2, 3), **fields):
    return [write_run(folder / f"{seed}", seed=seed, score=100.0 + seed, **fields) for seed in seeds]


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def labels(runs):
    return [one.label for one in group(runs)]


def test_runs_that_differ_in_their_seed_alone_are_one_group(tmp_path):
    ppo, sac = write_runs(tmp_path / "a"), write_runs(tmp_path / "b", algorithm="sac", env="Pendulum-v1")
    groups = group([ppo[0], sac[0], *ppo[1:], *sac[1:]])
    assert [one.runs for one in groups] == [ppo, sac]
    assert [one.label for one in groups] == ["PPO", "SAC"]
    assert [one.env for one in groups] == ["CartPole-v1", "Pendulum-v1"]


def test_groups_of_one_algorithm_are_told_apart_by_the_fields_that_differ(tmp_path):
    a = write_runs(tmp_path / "a", gamma=0.9)
    b = write_runs(tmp_path / "b", gamma=0.98, hidden=(32, 32))
    other = write_runs(tmp_path / "c", env="Acrobot-v1", gamma=0.5)
    assert labels([*a, *b, *other]) == ["PPO, gamma 0.9, hidden 64×64", "PPO, gamma 0.98, hidden 32×32", "PPO"]


def test_of_many_fields_a_label_names_the_first_if_they_tell_the_groups_apart(tmp_path):
    many = {"num_envs": 4, "num_steps": 48, "epochs": 3, "gamma": 0.5, "clip": 0.3}
    runs = [write_run(tmp_path / "a"), write_run(tmp_path / "b", **many)]
    assert labels(runs)[1] == "PPO, num_envs 4, num_steps 48, gamma 0.5, and 2 more"
    runs.append(write_run(tmp_path / "c", **(many | {"clip": 0.4})))
    assert labels(runs)[1:] == [
        f"PPO, num_envs 4, num_steps 48, gamma 0.5, epochs 3, clip {clip}" for clip in (0.3, 0.4)
    ]


def test_runs_alike_even_in_their_seed_are_told_apart_by_where_they_are(tmp_path):
    """As when the code has changed in between."""
    config = json.loads((write_run(tmp_path / "old" / "ppo-1") / "config.json").read_text())["config"]
    runs = [tmp_path / "old" / "ppo-1", write_run(tmp_path / "old" / "ppo-2", seed=2), write_run(tmp_path / "ppo")]
    (tmp_path / "old" / "sweep.json").write_text(json.dumps({"seeds": [1, 2], "configs": {"ppo": config}}))
    groups = group(runs)
    assert [one.label for one in groups] == [f"PPO, directory {tmp_path / name}" for name in ("old", "ppo")]
    assert [len(one.runs) for one in groups] == [2, 1]


def test_the_time_of_training_is_added_up_from_its_speed(tmp_path):
    run = write_run(tmp_path / "r")
    lines = [
        {"step": 100, "time/steps_per_second": 10.0},
        {"step": 100, "evaluation/return": 1.0},
        {"step": 400, "time/steps_per_second": 5.0},
    ]
    (run / "metrics.jsonl").write_bytes(b"".join(map(to_line, lines)))
    steps, minutes = training_minutes(run)
    assert steps.tolist() == [0, 100, 400]
    assert (60 * minutes).tolist() == pytest.approx([0, 10, 70])


def test_the_table_says_what_the_seeds_say_together(tmp_path):
    a = write_runs(tmp_path / "a", seeds=(1, 2, 3, 4), rate=100.0)
    b = [write_run(tmp_path / "b", algorithm="sac", env="Pendulum-v1")]
    groups = group([*a, *b])
    head, ppo, sac = compare.table(
        compare.rows(groups, {**{run: 1000.0 * (i + 1) for i, run in enumerate(a)}, b[0]: -7.0})
    )
    assert head.split() == ["seeds", "final", "return", "IQM", "[95", "%]", "worst", "seed", "minutes"]
    assert ppo.split() == ["PPO", "4", "2,500", "±", "1,118", "2,500", "[1,000,", "4,000]", "1,000", "1.7"]
    assert sac.split() == ["SAC", "1", "-7", "–", "-7", "1.7"]
    assert len({len(line) for line in (head, ppo, sac)}) == 1


@pytest.mark.parametrize(
    ("ppo", "sac", "share"),
    [
        ([1.0, 2.0], [4.0, 3.0], "SAC is better than PPO in 100% [95 %: 100% to 100%] of"),
        ([1.0, 4.0, 5.0, 6.0, 7.0], [0.0, 2.0, 3.0, 3.0, 3.0], "PPO is better than SAC in 84% [95 %: "),
    ],
)
def test_it_is_said_which_is_better_and_how_certain_that_is(tmp_path, ppo, sac, share):
    runs = [
        write_run(tmp_path / f"{name}-{seed}", algorithm=name, env="Pendulum-v1", seed=seed)
        for name in ("ppo", "sac")
        for seed in range(len(ppo))
    ]
    said = compare.remarks(group(runs), dict(zip(runs, [*ppo, *sac], strict=True)))
    (sentence,) = [line for line in said if "is better than" in line]
    assert sentence.startswith(share)
    assert (compare.FEW_SEEDS in said) == (len(ppo) < 5)


def without_layout(monkeypatch):
    """The figures that are saved from here on, by file name; files are written, but nothing is laid out: it is slow."""
    figures = {}

    def keep(figure, file):
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"a picture")
        figures[file.name] = figure
        return file

    for module in (compare, curves):
        monkeypatch.setattr(module, "save", keep)
    return figures


def drawn(monkeypatch, *runs):
    """The figures of the comparison that `lem.plot` draws."""
    figures = without_layout(monkeypatch)
    lem.plot(*runs)
    return {name: figure for name, figure in figures.items() if name.startswith("comparison")}


def test_one_seed_ranks_nothing_and_that_is_said(tmp_path, monkeypatch, capsys):
    runs = [*write_runs(tmp_path / "a"), write_run(tmp_path / "b", gamma=0.5)]
    (figure,) = drawn(monkeypatch, *runs).values()
    *curves, below = figure.axes
    assert [text.get_text() for text in below.texts] == [compare.ONE_SEED]
    assert [axes.get_xlabel() for axes in curves] == ["environment steps", "minutes of training"]
    said = capsys.readouterr().err
    assert compare.ONE_SEED in said
    assert "train more with --seeds 1-5." in said


def test_seeds_enough_are_ranked(tmp_path, monkeypatch, capsys):
    runs = [*write_runs(tmp_path / "a", gamma=0.9), *write_runs(tmp_path / "b", gamma=0.8, seeds=(4, 5))]
    (figure,) = drawn(monkeypatch, *runs).values()
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles[2:] == [
        "final return: each seed; IQM and its 95 %",
        "probability that the left one is better than the right one",
    ]
    (better,) = figure.axes[3].lines[-1].get_xdata()
    assert better == 0  # 101 to 103 against 104 and 105
    finals = [np.array([101.0, 102.0, 103.0]), np.array([104.0, 105.0])]
    for i, (seeds, ends, middle) in enumerate(zip(*[iter(figure.axes[2].lines)] * 3, strict=True)):
        assert list(seeds.get_xdata()) == pytest.approx(list(finals[i]))
        assert list(ends.get_xdata()) == pytest.approx(interval(iqm, finals[i]))
        assert list(middle.get_xdata()) == pytest.approx([iqm(finals[i])])
    assert list(figure.axes[3].lines[1].get_xdata()) == pytest.approx(interval(probability_of_improvement, *finals))
    assert [len(axes.collections) for axes in figure.axes[:2]] == [2, 2]  # a band for each group
    assert compare.ONE_SEED not in capsys.readouterr().err


def test_one_group_is_ranked_against_nobody(tmp_path, monkeypatch):
    (figure,) = drawn(monkeypatch, *write_runs(tmp_path / "a")).values()
    assert len(figure.axes) == 3


def test_the_curve_of_a_group_is_the_mean_of_its_seeds_as_far_as_all_go(tmp_path, monkeypatch):
    runs = [
        write_run(tmp_path / "a", score=100.0, rate=100.0),
        write_run(tmp_path / "b", seed=2, score=300.0, rate=50.0),
    ]
    (figure,) = drawn(monkeypatch, *runs).values()
    by_step, by_minute = ([line for line in axes.lines if len(line.get_xdata()) > 2] for axes in figure.axes[:2])
    (mean,), (timed,) = by_step, by_minute
    assert mean.get_xdata()[-1] == 10_000
    assert mean.get_ydata()[-1] == pytest.approx((figure_end(100) + figure_end(300)) / 2)
    assert timed.get_xdata()[-1] == pytest.approx(100 / 60)  # there the faster one has ended


def figure_end(score):
    """The mean of the last 20 episodes of a run of thirty, three at each tenth."""
    return np.mean(np.repeat(score * np.arange(1, 11) / 10, 3)[-20:])


def test_what_is_not_finished_is_in_the_curves_alone(tmp_path, monkeypatch, capsys):
    runs = [*write_runs(tmp_path / "a"), write_run(tmp_path / "b", seed=9, score=1.0, taken=4_000)]
    (figure,) = drawn(monkeypatch, *runs).values()
    ends = sorted(line.get_xdata()[-1] for line in figure.axes[0].lines if len(line.get_xdata()) > 2)
    assert ends == [4_000, 10_000]
    said = capsys.readouterr().err
    assert f"Not finished, and so only in the curves: {runs[-1]}." in said
    assert "3 of 4" in said
    assert "101.0" in said


def test_before_anything_is_finished_there_are_curves(tmp_path, monkeypatch, capsys):
    runs = [write_run(tmp_path / f"{seed}", seed=seed, taken=3_000) for seed in (1, 2)]
    (figure,) = drawn(monkeypatch, *runs).values()
    assert "PPO (2 seeds)" in [text.get_text() for text in figure.legends[0].texts]
    said = capsys.readouterr().err
    assert "Nothing is ranked before two seeds of each are finished" in said
    assert compare.ONE_SEED not in said


def test_runs_of_unequal_length_are_named(tmp_path, monkeypatch, capsys):
    runs = [*write_runs(tmp_path / "a"), *write_runs(tmp_path / "b", total_steps=20_000, taken=20_000)]
    drawn(monkeypatch, *runs)
    assert "They have not taken the same number of steps: PPO" in capsys.readouterr().err


def test_each_environment_has_its_own_picture_and_table(tmp_path, monkeypatch, capsys):
    runs = [*write_runs(tmp_path / "a"), *write_runs(tmp_path / "b", env="Acrobot-v1")]
    assert set(drawn(monkeypatch, *runs)) == {"comparison-CartPole-v1.png", "comparison-Acrobot-v1.png"}
    assert (tmp_path / "plots" / "learning_curve-Acrobot-v1.png").exists()
    said = capsys.readouterr().err
    assert "CartPole-v1:\n" in said
    assert "Acrobot-v1:\n" in said


def test_long_labels_stand_in_the_legend_and_numbers_beside_the_rows(tmp_path, monkeypatch):
    runs = [
        run for gamma in (0.9, 0.8) for run in write_runs(tmp_path / f"{gamma}", gamma=gamma, learning_rate=gamma / 90)
    ]
    (figure,) = drawn(monkeypatch, *runs).values()
    assert [label.get_text() for label in figure.axes[2].get_yticklabels()] == ["1", "2"]
    assert figure.legends[0].texts[0].get_text() == "1: PPO, gamma 0.9, learning_rate 0.01 (3 seeds)"
