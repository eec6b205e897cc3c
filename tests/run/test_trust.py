"""What is on a user's own disk is the user's: its code is imported unasked. What it names stays inside its folder."""

import sys

import pytest

import lemniscate as lem
from conftest import tiny_fields
from lemniscate.system.files import read_json, write_json

OWN = """
import gymnasium


class Env(gymnasium.Env):
    observation_space, action_space = gymnasium.spaces.Box(-1, 1, (1,)), gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return self.observation_space.low.copy(), {}

    def step(self, action):
        return self.observation_space.low.copy(), 0.0, True, False, {}
"""


def test_a_run_in_an_environment_of_ones_own_is_resumed_and_evaluated_unasked(tmp_path, monkeypatch):
    """Also where the run was copied from another machine, and by a process that was not passed the class."""
    (tmp_path / "own_world.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    stops = [lambda step, *_: step >= 128]
    run = lem.train("ppo", "own_world:Env", run="r", progress=False, callbacks=stops, **tiny_fields())
    del sys.modules["own_world"]
    assert lem.load(run.path).step == 128
    assert lem.resume(run.path, progress=False).policy.step == 256
    assert lem.evaluate(run.path, episodes=2).mean_return == 0
    assert set(read_json(run.path / "config.json")) == {"algorithm", "config"}


@pytest.mark.parametrize("name", ["../outside", "ABSOLUTE", "a/b", ".."])
def test_a_sweep_makes_no_directory_outside_itself(tmp_path, name):
    name = str(tmp_path / "outside") if name == "ABSOLUTE" else name
    (tmp_path / "s").mkdir()
    write_json(tmp_path / "s" / "sweep.json", {"seeds": [1], "configs": {name: {"env": "CartPole-v1"}}})
    with pytest.raises(lem.UserError, match="no name of an algorithm"):
        lem.resume_sweep(tmp_path / "s")
    assert read_json(tmp_path / "s" / "sweep.json")
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
