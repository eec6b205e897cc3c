"""Code that a run from elsewhere names is imported only if the user says so."""

import json
import shutil
import sys

import pytest

import lemniscate as lem
from conftest import tiny_fields
from lemniscate.hub.trust import is_signed, signed
from lemniscate.system.files import read_json, write_json

EVIL = """
from pathlib import Path
import gymnasium
Path(__file__).with_name("imported").touch()


class Env(gymnasium.Env):
    observation_space, action_space = gymnasium.spaces.Box(-1, 1, (1,)), gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return self.observation_space.low.copy(), {}

    def step(self, action):
        return self.observation_space.low.copy(), 0.0, True, False, {}
"""


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A run in `evil:Env`, begun by another user; the module is in the working directory. `state` is this user's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "evil.py").write_text(EVIL)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "theirs"))
    stops = [lambda step, *_: step >= 128]
    lem.train("ppo", "evil:Env", run="r", progress=False, callbacks=stops, **tiny_fields(checkpoint_every=64))
    del sys.modules["evil"]
    (tmp_path / "imported").unlink()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "mine"))
    yield tmp_path / "r"
    sys.modules.pop("evil", None)


@pytest.mark.parametrize("verb", ["load", "evaluate", "watch", "resume"])
def test_nothing_is_imported_unasked(elsewhere, verb):
    with pytest.raises(lem.UserError, match=r"would execute code of its own: evil:Env\. .*trust=True"):
        getattr(lem, verb)(elsewhere)
    assert not (elsewhere.parent / "imported").exists()


def test_a_plot_is_drawn_without_what_is_not_trusted(elsewhere, capsys):
    assert elsewhere / "plots" / "learning_curve.png" in lem.plot(elsewhere)
    assert "drawn without an evaluation" in capsys.readouterr().err
    assert not (elsewhere.parent / "imported").exists()


def test_it_is_imported_where_the_user_says_so(elsewhere):
    run = lem.resume(elsewhere, trust=True, progress=False)
    assert (elsewhere.parent / "imported").exists()
    assert lem.evaluate(run, episodes=2).mean_return == 0
    assert lem.load(elsewhere, trust=True).step == 256
    assert is_signed(lem.run.directory.find_checkpoint(elsewhere).record)  # what was trained here is this user's


def test_whoever_began_a_run_goes_on_with_it(elsewhere, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(elsewhere.parent / "theirs"))
    assert lem.resume(elsewhere, progress=False).policy.step == 256


def test_a_signature_is_of_every_bit_and_of_this_user(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    record = signed({"algorithm": "ppo", "config": {"env": "a:B"}})
    assert is_signed(json.loads(json.dumps(record)))
    assert not is_signed(record | {"config": {"env": "a:C"}})
    assert not is_signed({name: value for name, value in record.items() if name != "signature"})
    assert not is_signed(record | {"signature": None})
    assert (tmp_path / "lemniscate" / "key").stat().st_mode & 0o777 == 0o600
    shutil.rmtree(tmp_path / "lemniscate")
    assert not is_signed(record)


def test_where_no_key_can_be_kept_nothing_is_signed(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    record = signed({"algorithm": "ppo", "config": {}})
    assert "signature" not in record
    assert not is_signed(record)


@pytest.mark.parametrize("name", ["../outside", "/tmp/outside", "a/b", ".."])
def test_a_sweep_makes_no_directory_outside_itself(tmp_path, name):
    (tmp_path / "s").mkdir()
    write_json(tmp_path / "s" / "sweep.json", {"seeds": [1], "configs": {name: {"env": "CartPole-v1"}}})
    with pytest.raises(lem.UserError, match="no name of an algorithm"):
        lem.resume_sweep(tmp_path / "s")
    assert read_json(tmp_path / "s" / "sweep.json")
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
