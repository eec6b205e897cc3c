"""The commands, as a person types them."""

import json

import pytest

from conftest import tiny_fields
from lemniscate.cli import main
from lemniscate.errors import NonFiniteError

TINY = [
    str(part)
    for name, value in tiny_fields("CartPole-v1").items()
    if name in {"num_envs", "num_steps", "total_steps", "epochs", "minibatch_size", "evaluate_episodes"}
    for part in (f"--{name.replace('_', '-')}", value)
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("cli") / "run"
    assert main(["train", "ppo", "--env", "CartPole-v1", "--run", str(path), *TINY]) == 0
    return path


def test_evaluate_prints_one_json_object_on_standard_output(run, capsys):
    assert main(["evaluate", str(run), "--episodes", "3", "--seed", "5", "--json"]) == 0
    out, _ = capsys.readouterr()
    scores = json.loads(out)
    assert {"env_id", "episodes", "mean_return", "std_return", "returns", "lengths"} <= set(scores)
    assert scores["env_id"] == "CartPole-v1"
    assert len(scores["returns"]) == 3


def test_what_a_person_reads_goes_to_standard_error(run, capsys):
    assert main(["evaluate", str(run), "--episodes", "3"]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "over 3 episodes" in err


def test_fields_reach_the_config(run):
    config = json.loads((run / "config.json").read_text())["config"]
    assert config["num_envs"] == 4
    assert config["total_steps"] == 256


def test_train_with_a_report_leaves_pictures(tmp_path, capsys):
    path = tmp_path / "r"
    assert main(["train", "ppo", "--env", "CartPole-v1", "--run", str(path), "--report", *TINY]) == 0
    assert (path / "plots" / "learning_curve.png").stat().st_size > 5000
    assert "over 4 episodes" in capsys.readouterr().err


def test_plot_of_several_runs(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["plot", str(run), str(run)]) == 0
    assert (tmp_path / "plots" / "learning_curve.png").exists()


def test_envs_lists_backend_and_preset(capsys):
    assert main(["envs", "figure"]) == 0
    err = capsys.readouterr().err
    assert "DroneFigureEightTrajectory-v0" in err
    assert "crazyflow" in err
    assert "figure-eight" in err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "pp", "--env", "CartPole-v1"], "There is no algorithm 'pp': did you mean ppo?"),
        (["train", "ppo", "--env", "CartPol-v1"], "There is no environment 'CartPol-v1': did you mean CartPole-v1"),
        (
            ["train", "ppo", "--env", "CartPole-v1", "--preset", "corse"],
            "There is no preset 'corse': did you mean course",
        ),
        (["train", "ppo", "--env", "CartPole-v1", "--gama", "1"], "There is no field '--gama': did you mean --gamma"),
        (["train", "ppo", "--env", "CartPole-v1", "--gamma", "x"], "Error parsing --gamma: could not convert"),
        (["train", "ppo", "--env", "CartPole-v1", "--gamma", "3"], "gamma must be a number from 0 to 1, not 3.0."),
        (
            ["train", "ppo", "--env", "CartPole-v1", "--minibatch-size", "1"],
            "normalize_advantage needs batches of 2",
        ),
        (["train", "ppo", "--env", "CartPole-v1", "--activation", "x"], "Expected one of"),
        (["evaluate", "nowhere"], "nowhere is not a run directory"),
        (["evaluate", "nowhere", "--episods", "3"], "--episods is not understood here"),
        (["resume", "nowhere"], "nowhere is not a run directory"),
        (["train", "--seed", "3", "ppo"], "The algorithm comes first, then its fields: lemniscate train ppo"),
        (["train", "ppo", "--env", "CartPole-v1", "--backend", "envpol"], "There is no backend 'envpol'"),
        (["train", "ppo", "--env", "test_cli:Nothing"], "test_cli has no Nothing"),
        (["check", "CartPole-v1", "--backend", "foo"], "There is no backend 'foo'"),
        (["watch"], "The following arguments are required"),
        (["evaluat"], "Invalid choice: 'evaluat'"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(capsys, arguments, said):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err or said.lower() in err.lower()
    assert len(err.strip().splitlines()) == 1


def test_an_episode_is_filmed(run, capsys):
    film = run / "videos" / "episode.gif"
    assert main(["watch", str(run), "--video", str(film)]) == 0
    assert film.stat().st_size > 5000


@pytest.mark.parametrize(
    ("command", "ending"), [("train", " Training stopped; the last checkpoint is as it was."), ("evaluate", "")]
)
def test_a_nan_is_told_with_what_it_means_for_the_run(run, capsys, monkeypatch, command, ending):
    def breaks(*_, **__):
        raise NonFiniteError("The reward of environment 0 is nan.")

    monkeypatch.setattr(f"lemniscate.cli.front.{command}", breaks)
    assert main(["train", "ppo", "--env", "CartPole-v1"] if command == "train" else [command, str(run)]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == f"The reward of environment 0 is nan.{ending}"


def test_a_seed_below_zero_is_a_sentence(run, capsys):
    for command in ("watch", "evaluate"):
        assert main([command, str(run), "--seed", "-1"]) == 2
        assert "seed must be a whole number at least 0, not -1." in capsys.readouterr().err


def test_a_film_that_cannot_be_written_is_a_sentence(run, capsys):
    assert main(["watch", str(run), "--video", str(run / "film.avi")]) == 2
    assert "must end in .gif, .webp or .mp4" in capsys.readouterr().err
