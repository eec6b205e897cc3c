"""Warm start: the networks of another run are the beginning of this one, where they fit."""

import shutil

import pytest
import torch
from test_run import final_hashes, history

import lemniscate as lem
from conftest import tiny_fields, tiny_off_policy
from lemniscate.run import checkpoint


def train(path, algorithm="ppo", env="CartPole-v1", **fields):
    small = {"num_envs": 4, "num_steps": 8, "total_steps": 256, "hidden": (16,), "evaluate_episodes": 4}
    if algorithm in ("ddpg", "td3", "sac"):
        small = tiny_off_policy()
    if algorithm == "ppo":
        small = tiny_fields(env)
    if algorithm == "trpo":
        small |= {"critic_minibatch_size": 32}
    return lem.train(algorithm, env, run=path, progress=False, **{**small, **fields})


def networks_at(path, step=None):
    steps = checkpoint.list_steps(path / "checkpoints")
    found = checkpoint.read(path / "checkpoints" / f"step-{steps[-1] if step is None else step}")
    return found.tensors_of("networks")


def first_networks(path, **fields):
    """The networks that a run begins with, from its checkpoint at step 0."""
    train(path, checkpoint_every=1 << 20, **fields)
    return networks_at(path, 0)


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("warm") / "source"
    train(path, normalize_observations=True)
    return path


@pytest.mark.parametrize("algorithm", ["ppo", "a2c", "trpo"])
def test_networks_of_the_same_kind_are_taken_over_whole(source, tmp_path, algorithm, capsys):
    fields = {"algorithm": algorithm, "normalize_observations": True, "warm_start": str(source)}
    begun = first_networks(tmp_path / "r", **fields)
    assert same(begun, networks_at(source))
    assert float(begun["policy.normalizer.count"]) > 0
    assert lem.load(tmp_path / "r").config.warm_start == str(source)


def test_what_was_taken_over_is_told(source, tmp_path, capsys):
    fields = {**tiny_fields("CartPole-v1", normalize_observations=True), "warm_start": str(source)}
    lem.train("ppo", "CartPole-v1", run=tmp_path / "r", **fields)
    assert f"Warm start: all networks of {source} at step 256." in capsys.readouterr().err


def test_of_another_algorithms_networks_the_policy_is_taken_over(tmp_path):
    train(tmp_path / "ddpg", "ddpg", "Pendulum-v1")
    fields = {"algorithm": "td3", "env": "Pendulum-v1", "warm_start": str(tmp_path / "ddpg")}
    begun, theirs = first_networks(tmp_path / "td3", **fields), networks_at(tmp_path / "ddpg")
    policy = [name for name in begun if name.startswith("policy.")]
    assert policy
    assert all(torch.equal(begun[name], theirs[name]) for name in policy)
    assert not torch.equal(begun["policy.net.0.weight"], networks_at(tmp_path / "td3")["policy.net.0.weight"])


@pytest.mark.parametrize(("value_range", "whole"), [(5.0, True), (10.0, False)])
def test_a_q_over_other_bins_is_not_taken_over(tmp_path, value_range, whole):
    """Its shapes are the same, and its values would be others."""
    train(tmp_path / "source", "sac", "Pendulum-v1", value_range=5.0)
    fields = {"algorithm": "sac", "env": "Pendulum-v1", "value_range": value_range}
    begun = first_networks(tmp_path / "r", warm_start=str(tmp_path / "source"), **fields)
    theirs = networks_at(tmp_path / "source")
    assert all(torch.equal(begun[name], theirs[name]) for name in begun if name.startswith("policy."))
    assert same(begun, theirs) == whole


def test_a_checkpoint_can_be_named_too(source, tmp_path):
    checkpoints = sorted((source / "checkpoints").iterdir())
    begun = first_networks(tmp_path / "r", normalize_observations=True, warm_start=str(checkpoints[0]))
    step = int(checkpoints[0].name.removeprefix("step-"))
    assert same(begun, networks_at(source, step))


def test_optimizers_counters_and_generators_are_fresh(source, tmp_path):
    train(tmp_path / "cold", normalize_observations=True)
    first_networks(tmp_path / "warm", normalize_observations=True, warm_start=str(source))
    begun = checkpoint.read(tmp_path / "warm" / "checkpoints" / "step-0")
    assert begun.numbers["step"] == 0
    fresh = lem.algos.ppo.init(lem.load(tmp_path / "cold").config, lem.load(source).spec, torch.device("cpu"))
    for name, value in fresh.saved().items():
        if name != "networks" and hasattr(value, "state_dict"):
            assert same(begun.tensors_of(name), dict(value.state_dict()))


def test_the_run_no_longer_depends_on_its_source_once_it_has_begun(source, tmp_path):
    """Killed before its first planned checkpoint, with the source gone, it ends in the same bits."""
    copy = shutil.copytree(source, tmp_path / "source")
    fields = {"normalize_observations": True, "warm_start": str(copy), "checkpoint_every": 128, "keep_checkpoints": 10}
    train(tmp_path / "whole", **fields)
    killed = shutil.copytree(tmp_path / "whole", tmp_path / "killed")
    for step in checkpoint.list_steps(killed / "checkpoints")[1:]:
        shutil.rmtree(killed / "checkpoints" / f"step-{step}")
    assert checkpoint.list_steps(killed / "checkpoints") == [0]
    shutil.rmtree(copy)
    lem.resume(killed, progress=False)
    assert final_hashes(killed) == final_hashes(tmp_path / "whole")
    assert history(killed) == history(tmp_path / "whole")


def test_a_run_killed_before_its_checkpoint_at_step_0_begins_warm_all_the_same(source, tmp_path):
    fields = {"normalize_observations": True, "warm_start": str(source)}
    train(tmp_path / "whole", **fields)
    killed = shutil.copytree(tmp_path / "whole", tmp_path / "killed")
    shutil.rmtree(killed / "checkpoints")
    lem.resume(killed, progress=False)
    assert final_hashes(killed) == final_hashes(tmp_path / "whole")


def test_the_state_is_told_of_a_warm_start_and_of_nothing_else(source, tmp_path, monkeypatch):
    from lemniscate.algos import ppo

    told = []
    monkeypatch.setattr(
        ppo.State, "on_warm_start", lambda state: told.append(state.networks.state_dict()), raising=False
    )
    train(tmp_path / "cold", normalize_observations=True)
    assert not told
    train(tmp_path / "warm", normalize_observations=True, warm_start=str(source))
    lem.resume(tmp_path / "warm", progress=False)
    assert len(told) == 1


@pytest.mark.parametrize("algorithm", ["ddpg", "td3", "sac"])
def test_target_networks_begin_as_copies_of_the_loaded_ones(tmp_path, algorithm):
    train(tmp_path / "source", algorithm, "Pendulum-v1")
    path = tmp_path / "warm"
    begun = first_networks(path, algorithm=algorithm, env="Pendulum-v1", warm_start=str(tmp_path / "source"))
    targets = checkpoint.read(path / "checkpoints" / "step-0").tensors_of("targets")
    assert targets
    for name, tensor in targets.items():
        own = begun.get(name, begun.get(f"critics.{name}"))
        assert own is not None
        assert torch.equal(tensor, own), name


@pytest.mark.parametrize(
    ("algorithm", "env", "fields", "said"),
    [
        ("ppo", "CartPole-v1", {"hidden": (32,)}, r"hidden is \[16\] there and \[32\] here"),
        (
            "ppo",
            "CartPole-v1",
            {"normalize_observations": False},
            "normalize_observations is True there and False here",
        ),
        ("ppo", "CartPole-v1", {"activation": "relu"}, "activation is 'tanh' there and 'relu' here"),
        (
            "ppo",
            "Acrobot-v1",
            {},
            r"no layer of the policy of .* fits: .* is .* here; it was trained on CartPole-v1, with other spaces",
        ),
        ("ppo", "CartPole-v1", {"warm_start": "no/such/run"}, "no/such/run is not a run directory"),
    ],
)
def test_what_does_not_fit_is_one_sentence_and_leaves_nothing_behind(source, tmp_path, algorithm, env, fields, said):
    path = tmp_path / "r"
    with pytest.raises(lem.UserError, match=said):
        train(path, algorithm, env, **{"normalize_observations": True, "warm_start": str(source), **fields})
    assert not path.exists()


def begun_from(source, path, capsys, algorithm="ppo", env="Pendulum-v1", **fields):
    """The tensors of `source`, those that a run begins with from it, and what was said."""
    given = {**tiny_fields(env), **fields} if algorithm == "ppo" else {**tiny_off_policy(), **fields}
    lem.train(algorithm, env, run=path, **{**given, "checkpoint_every": 1 << 20, "warm_start": str(source)})
    return networks_at(source), networks_at(path, 0), capsys.readouterr().err


@pytest.fixture(scope="module")
def deep(tmp_path_factory):
    path = tmp_path_factory.mktemp("deep") / "r"
    train(path, hidden=(16, 16), normalize_observations=True)
    return path


def test_what_fits_is_taken_over_and_what_does_not_begins_anew(deep, tmp_path, capsys):
    """Other actions: the last layer of the policy and its σ are new; the other layers and the normalizer are not."""
    fields = {"env": "helpers:FourNumbers", "hidden": (16, 16), "normalize_observations": True}
    theirs, begun, said = begun_from(deep, tmp_path / "r", capsys, **fields)
    new = {name for name in begun if name not in theirs or not torch.equal(begun[name], theirs[name])}
    assert new == {"policy.log_std", "policy.net.4.weight", "policy.net.4.bias"}
    assert "3 begin anew, policy.log_std, policy.net.4.weight, policy.net.4.bias; it was trained on Cart" in said


def test_what_begins_anew_cannot_be_frozen(deep, tmp_path):
    fields = {"env": "helpers:FourNumbers", "hidden": (16, 16), "normalize_observations": True}
    with pytest.raises(lem.UserError, match=r"freeze keeps policy.net.4.weight, which warm_start cannot take from"):
        train(tmp_path / "r", warm_start=str(deep), freeze=("policy.net.0", "policy.net.4"), **fields)


def test_a_normalizer_of_another_size_begins_anew_with_its_count(deep, tmp_path, capsys):
    fields = {"env": "Acrobot-v1", "hidden": (16, 16), "normalize_observations": True}
    theirs, begun, _ = begun_from(deep, tmp_path / "r", capsys, **fields)
    assert torch.equal(theirs["policy.net.2.weight"], begun["policy.net.2.weight"])
    assert float(theirs["policy.normalizer.count"]) > 0 == float(begun["policy.normalizer.count"])


def test_of_another_kind_of_policy_the_layers_are_taken_over(tmp_path, capsys):
    train(tmp_path / "ppo", "ppo", "Pendulum-v1", activation="relu", normalize_observations=False)
    theirs, begun, said = begun_from(tmp_path / "ppo", tmp_path / "ddpg", capsys, "ddpg", network="mlp")
    policy = [name for name in begun if name.startswith("policy.")]
    assert all(torch.equal(begun[name], theirs[name]) for name in policy)
    assert f"{len(policy)} tensors of" in said


def test_a_sweep_says_so_before_it_starts(source, tmp_path):
    fields = {"warm_start": str(source), "hidden": (8,), "normalize_observations": True}
    with pytest.raises(lem.UserError, match="ppo: warm_start: no layer of the policy of"):
        lem.train_sweep("ppo", "CartPole-v1", "1-2", run=tmp_path / "s", **fields)
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("algorithm", ["ppo", "trpo", "td3"])
def test_what_is_frozen_keeps_its_values_also_in_a_run_that_goes_on(tmp_path, algorithm):
    freeze = ("policy.net.0", "critics.members.0" if algorithm == "td3" else "value.net.2")
    fields = {"freeze": freeze, "checkpoint_every": 64, "keep_checkpoints": 10}
    train(tmp_path / "whole", algorithm, "Pendulum-v1", **fields)
    steps = checkpoint.list_steps(tmp_path / "whole" / "checkpoints")
    first, last = (networks_at(tmp_path / "whole", step) for step in (steps[0], steps[-1]))
    parameters = [name for name in first if "net" in name]
    kept = {name for name in parameters if torch.equal(first[name], last[name])}
    assert kept == {name for name in parameters if name.startswith(freeze)}
    cut = shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    shutil.rmtree(cut / "checkpoints" / f"step-{steps[-1]}")
    lem.resume(cut, progress=False)
    assert final_hashes(cut) == final_hashes(tmp_path / "whole")


@pytest.mark.parametrize(
    ("freeze", "said"),
    [
        (("policy.net.9",), "There is no parameter to freeze 'policy.net.9': did you mean policy.net"),
        (("policy.ne",), "There is no parameter to freeze 'policy.ne'"),
        (("policy", "value"), "There is nothing to learn: of one of the networks every parameter is frozen"),
    ],
)
def test_what_cannot_be_frozen_is_one_sentence(tmp_path, freeze, said):
    with pytest.raises(lem.UserError, match=said):
        train(tmp_path / "r", freeze=freeze)
    assert not (tmp_path / "r").exists()
