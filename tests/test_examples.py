"""The examples run: as programs, and by their names on the command line."""

from pathlib import Path

import pytest

from forks import command, forks

EXAMPLES = Path(__file__).parents[1] / "examples"
FEWER_STEPS = {"=30_000": "=4_096", "=60_000": "=4_096", "=3_000": "=700", ": int = 100_000": ": int = 1_024"}
"""those of the callback stay: it is there to end its run before them"""


def program(name, folder):
    """Run an example as a program, with fewer steps than it has; what it prints on standard output."""
    text = (EXAMPLES / name).read_text()
    for large, small in FEWER_STEPS.items():
        text = text.replace(f"total_steps{large}", f"total_steps{small}")
    (folder / name).write_text(text)
    code = f"import runpy, sys; sys.path.insert(0, {str(EXAMPLES)!r}); runpy.run_path({str(folder / name)!r}, run_name='__main__')"
    return done(forks().start(code, folder))[0]


def lemniscate(*words):
    """Run a command where the examples are; (standard output, standard error)."""
    return done(command(*words, cwd=EXAMPLES))


def done(process):
    said = process.communicate()
    assert process.returncode == 0, said
    return said


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.py") if path.name != "own_logger.py"))
@pytest.mark.one_in(2)
def test_a_program_runs(name, tmp_path):
    assert program(name, tmp_path).strip()


def test_an_algorithm_of_ones_own_has_the_command_line_and_its_presets(tmp_path):
    path = tmp_path / "run"
    steps = ["--total-steps", "4_096", "--run", path]
    assert "preset careful" in lemniscate("train", "own_algorithm", "--env", "CartPole-v1", *steps)[1]
    assert "episodes of CartPole-v1" in lemniscate("evaluate", path, "--episodes", "2")[1]
    assert "--beta" in lemniscate("train", "own_algorithm", "--help")[0]


@pytest.mark.long
def test_a_network_and_a_logger_of_ones_own(tmp_path):
    own = ["--network", "own_network:Fourier", "--track", "own_logger:Csv"]
    path = tmp_path / "run"
    lemniscate("train", "ppo", "--env", "CartPole-v1", *own, "--total-steps", "4_096", "--run", path)
    assert (path / "metrics.csv").read_text().count("losses/policy") == 8
    lemniscate("evaluate", path, "--episodes", "2")


def test_an_environment_of_ones_own_with_arguments_and_a_wrapper(tmp_path):
    own = ["--env", "own_environment:Balance", "--env-args", '{"wind": 0.5}']
    own += ["--wrappers", "own_environment:scaled(factor=0.1)"]
    steps = ["--total-steps", "700", "--learning-starts", "500", "--run", tmp_path / "run"]
    lemniscate("train", "sac", *own, *steps)
    lemniscate("evaluate", tmp_path / "run", "--episodes", "2", "--env-args", '{"wind": 0}')
    assert lemniscate("check", "own_environment:Balance")[1]


@pytest.mark.long
def test_the_contract_holds_for_the_algorithm_of_ones_own(tmp_path, monkeypatch):
    from lemniscate.testing import ALGORITHM_CONTRACT

    monkeypatch.syspath_prepend(str(EXAMPLES))
    for check in ALGORITHM_CONTRACT:
        check("own_algorithm", tmp_path / check.__name__, env="CartPole-v1", num_envs=4, num_steps=32, total_steps=1280)
