"""The examples run: as programs, and by their names on the command line."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
LEMNISCATE = [sys.executable, "-m", "lemniscate.cli"]


def run(command, folder=EXAMPLES):
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.py") if path.name != "own_logger.py"))
def test_a_program_runs(name, tmp_path):
    assert run([sys.executable, EXAMPLES / name], tmp_path).stdout.strip()


def test_an_algorithm_of_ones_own_has_the_command_line_and_its_presets(tmp_path):
    steps = ["--total-steps", "4_096", "--run", tmp_path / "run"]
    done = run([*LEMNISCATE, "train", "own_algorithm", "--env", "CartPole-v1", *steps])
    assert "preset careful" in done.stderr
    assert "episodes of CartPole-v1" in run([*LEMNISCATE, "evaluate", tmp_path / "run", "--episodes", "2"]).stderr
    assert "--beta" in run([*LEMNISCATE, "train", "own_algorithm", "--help"]).stdout


def test_a_network_and_a_logger_of_ones_own(tmp_path):
    own = ["--network", "own_network:Fourier", "--track", "own_logger:Csv"]
    steps = ["--total-steps", "4_096", "--run", tmp_path / "run"]
    run([*LEMNISCATE, "train", "ppo", "--env", "CartPole-v1", *own, *steps])
    assert (tmp_path / "run" / "metrics.csv").read_text().count("losses/policy") == 8
    run([*LEMNISCATE, "evaluate", tmp_path / "run", "--episodes", "2"])


def test_an_environment_of_ones_own_with_arguments_and_a_wrapper(tmp_path):
    own = ["--env", "own_environment:Balance", "--env-args", '{"wind": 0.5}']
    own += ["--wrappers", "own_environment:scaled(factor=0.1)"]
    steps = ["--total-steps", "700", "--learning-starts", "500", "--run", tmp_path / "run"]
    run([*LEMNISCATE, "train", "sac", *own, *steps])
    run([*LEMNISCATE, "evaluate", tmp_path / "run", "--episodes", "2", "--env-args", '{"wind": 0}'])
    assert run([*LEMNISCATE, "check", "own_environment:Balance"]).stderr


def test_the_contract_holds_for_the_algorithm_of_ones_own(tmp_path, monkeypatch):
    from lemniscate.testing import ALGORITHM_CONTRACT

    monkeypatch.syspath_prepend(str(EXAMPLES))
    for check in ALGORITHM_CONTRACT:
        check("own_algorithm", tmp_path / check.__name__, env="CartPole-v1", num_envs=4, num_steps=32, total_steps=1280)
