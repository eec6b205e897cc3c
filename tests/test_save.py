"""A policy stored with `lem.save`, and read again."""

import itertools
import os

import pytest
import torch

import lemniscate as lem
from conftest import tiny_fields
from lemniscate.run import checkpoint


class Own(torch.nn.Sequential):
    """A network of one's own, before or after its file is edited."""

    width = 8

    def __init__(self, inputs, outputs):
        super().__init__(torch.nn.Linear(inputs, self.width), torch.nn.Linear(self.width, outputs))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return lem.train("ppo", env="CartPole-v1", run=folder / "run", progress=False, **tiny_fields("CartPole-v1"))


def test_what_is_stored_is_loaded_again(run, tmp_path):
    path = lem.save(run, tmp_path / "best")
    policy = lem.load(path)
    assert (policy.spec, policy.config, policy.step) == (run.policy.spec, run.policy.config, run.policy.step)
    mine, theirs = policy.networks.state_dict(), run.policy.networks.state_dict()
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)
    assert {file.suffix for file in path.iterdir()} == {".json", ".safetensors"}
    obs = [0.1, 0.2, -0.1, 0.0]
    assert policy.act(obs) == run.policy.act(obs)


def test_a_stored_policy_is_replaced_and_nothing_else_is(run, tmp_path):
    policy, path = lem.load(run.path), tmp_path / "best"
    lem.save(policy, path)
    policy.step = 5
    lem.save(policy, path)
    assert lem.load(path).step == 5
    (tmp_path / "link").symlink_to(path)
    policy.step = 6
    lem.save(policy, tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert lem.load(path).step == 6
    with pytest.raises(lem.UserError, match="exists already, and is not a stored policy"):
        lem.save(policy, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(lem.UserError, match="cannot be written"):
        lem.save(policy, tmp_path / "file" / "best")
    with pytest.raises(lem.UserError, match="not a dict"):
        lem.save({}, tmp_path / "other")


def test_a_planned_checkpoint_is_not_replaced(run):
    planned = run.path / "checkpoints" / "step-256"
    before = {file: file.read_bytes() for file in planned.iterdir()}
    with pytest.raises(lem.UserError, match="exists already, and is not a stored policy"):
        lem.save(run, planned)
    assert {file: file.read_bytes() for file in planned.iterdir()} == before


def test_after_a_save_that_failed_half_way_the_next_one_succeeds(run, tmp_path):
    (tmp_path / "best.tmp").mkdir()
    (tmp_path / "best.tmp" / "state.json").write_text("{")
    assert lem.load(lem.save(run, tmp_path / "best")).step == 256
    assert [file.name for file in tmp_path.iterdir()] == ["best"]


@pytest.mark.parametrize("last", [1, 2])
def test_a_stored_policy_is_there_until_another_is_in_its_place(run, tmp_path, monkeypatch, last):
    """Two saves in a row fail, the first when it puts the new one into the place of the old, the second at once."""

    def refuse(name, after):
        call, calls = getattr(os, name), itertools.count(1)

        def refusing(*arguments, **options):
            if next(calls) > after:
                raise OSError(5, "Input/output error")
            return call(*arguments, **options)

        monkeypatch.setattr(os, name, refusing)

    path = lem.save(run, tmp_path / "best")
    for name, after in (("rename", last - 1), ("fsync", 0)):
        refuse(name, after)
        with pytest.raises(lem.UserError, match="cannot be written"):
            lem.save(run, path)
        monkeypatch.undo()
        assert any(map(checkpoint.is_whole, tmp_path.iterdir()))
    lem.save(run, path)
    assert [file.name for file in tmp_path.iterdir()] == ["best"]


def test_a_network_that_was_edited_since_is_named(tmp_path, monkeypatch):
    fields = tiny_fields("CartPole-v1") | {"network": Own}
    run = lem.train("ppo", env="CartPole-v1", run=tmp_path / "run", progress=False, **fields)
    assert lem.load(run.path).config.network == "test_save:Own"
    monkeypatch.setattr(Own, "width", 16)
    with pytest.raises(
        lem.UserError, match=r"run does not fit its networks: policy\..* is \[8, 4\] there and \[16, 4\]"
    ):
        lem.load(run.path)


def test_a_run_begins_with_a_stored_policy(run, tmp_path):
    path = lem.save(run, tmp_path / "best")
    fields = tiny_fields("CartPole-v1", warm_start=str(path))
    again = lem.train("ppo", env="CartPole-v1", run=tmp_path / "again", progress=False, **fields)
    assert again.policy.step == 256
