"""The whole pre-flight of a run: record, picture, sentences, the exported C, and what is refused."""

import json
import shutil
from functools import partial

import pytest
import torch

import environments  # noqa: F401  (registers the environments)
import lemniscate as lem
from conftest import tiny_fields
from lemniscate.cli import main
from lemniscate.envs.vec_env import VecEnv
from lemniscate.exporting import export as exporting
from lemniscate.exporting.compiled import host_compiler
from lemniscate.margins import preflight as preflights
from lemniscate.margins.preflight import preflight
from lemniscate.system.files import read_json, write_json


def train(path, env="CartPole-v1"):
    lem.train("ppo", env=env, run=path, progress=False, **tiny_fields("CartPole-v1"))
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return train(tmp_path_factory.mktemp("preflight") / "run")


@pytest.fixture
def copy(run, tmp_path):
    """The run in a folder of its own, without what a pre-flight writes."""
    return shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("preflight*", "export"))


def is_untouched(run):
    return not (run / "preflight.json").exists() and not (run / "plots" / "preflight.png").exists()


def test_it_leaves_a_record_a_picture_a_table_and_sentences(copy, capsys):
    assert main(["preflight", str(copy), "--episodes", "8", "--seed", "1"]) == 0
    out, said = capsys.readouterr()
    assert out == ""
    record = read_json(copy / "preflight.json")
    assert set(record["axes"]) == {"action_delay", "observation_noise", "lost_actions"}
    for axis in record["axes"].values():
        assert len(axis["values"]) == len(axis["alive"]) == len(axis["mean_return"])
        assert set(axis["margin"]) == {"above"}
        assert axis["alive"][0] >= 0.95
        assert axis["mean_return"][0] == record["nominal_return"]
    assert (record["episodes"], record["seed"], record["step"], record["compiled"]) == (8, 1, 256, False)
    assert record["lemniscate"] == lem.__version__
    assert record["alive_means"].startswith("a return of at least ")
    assert (copy / "plots" / "preflight.png").stat().st_size > 10_000
    assert all(sentence in said for sentence in record["sentences"])
    assert "within margins" in said
    assert said.endswith(f"{copy / 'plots' / 'preflight.png'}\n")
    assert "safe" not in said.lower()


def test_in_python_it_is_the_same_again_and_the_threads_of_torch_are_as_before(copy):
    torch.set_num_threads(2)
    first, second = (lem.preflight(copy, episodes=4, seed=2) for _ in range(2))
    assert torch.get_num_threads() == 2
    assert isinstance(first, lem.Preflight)
    assert first == second
    assert first.to_json() == second.to_json()
    assert lem.preflight(copy, episodes=4, seed=3) != first


@pytest.mark.skipif(not host_compiler(), reason="there is no C compiler")
def test_the_exported_c_acts_as_the_policy_does(copy, monkeypatch):
    monkeypatch.setattr(exporting, "fly", partial(exporting.fly, rows=200))
    lem.export(copy)
    acted = []
    original = preflights.for_policy
    monkeypatch.setattr(preflights, "for_policy", lambda rows, kind: acted.append(1) or original(rows, kind))
    plain, exported = (preflight(copy, compiled=c, episodes=4) for c in (False, True))
    assert acted
    assert exported.compiled
    assert exported.axes == plain.axes
    record = read_json(copy / "export" / "manifest.json")
    write_json(copy / "export" / "manifest.json", {**record, "step": 128})
    with pytest.raises(lem.UserError, match="is of step 128, the policy of step 256: lemniscate export"):
        preflight(copy, compiled=True)
    write_json(copy / "export" / "manifest.json", record)
    text = (copy / "export" / "policy.c").read_text()
    (copy / "export" / "policy.c").write_text(text + "\n")
    with pytest.raises(lem.UserError, match="has been changed since it was written: lemniscate export"):
        preflight(copy, compiled=True)
    (copy / "export" / "policy.c").write_text(text)
    policy = lem.load(copy)
    with torch.no_grad():
        policy.module.net[-1].bias += torch.arange(2) * 100.0
    with pytest.raises(lem.UserError, match="is of another policy: lemniscate export"):
        preflight(policy, compiled=True)
    (copy / "export" / "policy.c").write_bytes("of another kind: ü".encode("latin-1"))
    with pytest.raises(lem.UserError, match=r"There is no whole export of .*: lemniscate export "):
        preflight(copy, compiled=True)
    (copy / "export" / "policy.c").unlink()
    with pytest.raises(lem.UserError, match=r"There is no whole export of .*: lemniscate export "):
        preflight(copy, compiled=True)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--episodes", "3"], "episodes must be a whole number from 4 to 1,000, not 3."),
        (["--episodes", "x"], "episodes must be a whole number"),
        (["--seed", "-1"], "seed must be a whole number at least 0, not -1."),
        (["--env-args", "[1]"], "--env-args must be a JSON object"),
        (["--env-args", '{"mass": 1}'], "CartPole-v1 cannot be made with mass=1"),
        (["--compiled"], "There is no whole export of"),
        (["--episods", "3"], "There is no option '--episods': did you mean --episodes?"),
    ],
)
def test_a_mistake_is_one_sentence_and_nothing_is_written(copy, capsys, arguments, said):
    assert main(["preflight", str(copy), *arguments]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert is_untouched(copy)


def test_a_missing_compiler_has_its_sentence(copy, monkeypatch):
    monkeypatch.setattr(preflights, "host_compiler", lambda: None)
    with pytest.raises(lem.UserError, match="There is no C compiler here"):
        preflight(copy, compiled=True)


def test_only_runs_are_flown(copy, tmp_path):
    for wrong in (tmp_path / "nowhere", copy / "checkpoints" / "step-256"):
        with pytest.raises(lem.UserError, match=r"is not a run directory|is a checkpoint: name its run"):
            preflight(wrong)
    with pytest.raises(lem.UserError, match="A run is a directory"):
        preflight(3)
    with pytest.raises(lem.UserError, match="is on the Hub"):
        preflight("hf://user/name")


def test_an_environment_without_any_axis_is_refused_and_closed(tmp_path, monkeypatch):
    run, closed = train(tmp_path / "masked", env="Copy-masked-v0"), []
    close = VecEnv.close
    monkeypatch.setattr(VecEnv, "close", lambda env: closed.append(env) or close(env))
    with pytest.raises(lem.UserError, match="Copy-masked-v0 has nothing that could be changed"):
        preflight(run)
    assert len(closed) == 1
    assert is_untouched(run)


def test_a_folder_that_cannot_be_written_is_a_sentence(copy):
    shutil.rmtree(copy / "plots", ignore_errors=True)
    (copy / "plots").touch()
    with pytest.raises(lem.UserError, match="cannot be written"):
        preflight(copy, episodes=4)
    assert is_untouched(copy)


@pytest.mark.long
def test_a_drone_is_flown_along_every_condition_and_through_all_dynamics(tmp_path):
    pytest.importorskip("crazyflow")
    fields = {"num_envs": 4, "num_steps": 8, "total_steps": 64, "minibatch_size": 32, "evaluate_episodes": 4}
    kwargs = {"dynamics": ["so_rpy_rotor", "so_rpy"], "history": 2, "mass": [0.9, 1.1], "max_episode_time": 0.5}
    path = tmp_path / "run"
    lem.train("ppo", env="DroneFigureEightTrajectory-v0", env_kwargs=kwargs, run=path, progress=False, **fields)
    found = preflight(path, episodes=4)
    assert found.smoothness
    assert {one.axis.name for one in found.axes} >= {"mass", "motor_time", "wind", "dynamics", "jitter"}
    assert json.loads((path / "preflight.json").read_text())["axes"]["dynamics"]["nominal"] == "so_rpy_rotor"
