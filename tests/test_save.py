"""A policy stored with `lem.save`, and read again."""

import pytest
import torch

import lemniscate as lem
from conftest import tiny_fields


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
    with pytest.raises(lem.UserError, match="exists already, and is not a stored policy"):
        lem.save(policy, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(lem.UserError, match="cannot be written"):
        lem.save(policy, tmp_path / "file" / "best")
    with pytest.raises(lem.UserError, match="not a dict"):
        lem.save({}, tmp_path / "other")


def test_a_run_begins_with_a_stored_policy(run, tmp_path):
    path = lem.save(run, tmp_path / "best")
    fields = tiny_fields("CartPole-v1", warm_start=str(path))
    again = lem.train("ppo", env="CartPole-v1", run=tmp_path / "again", progress=False, **fields)
    assert again.policy.step == 256
