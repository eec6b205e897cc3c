"""The final policy as the mean over the last part of a run."""

import shutil

import pytest
import torch

import lemniscate as lem
from conftest import tiny_fields, tiny_off_policy
from lemniscate.api.callbacks import StopAt
from lemniscate.nn.policies import Policy
from lemniscate.run import checkpoint
from lemniscate.run.state import PolicyMean


def parameters_of(path, step):
    tensors = checkpoint.read(path / "checkpoints" / f"step-{step}").tensors
    return {name: values for name, values in tensors.items() if name.startswith("networks.policy.")}


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "trpo"])
def test_the_final_policy_is_the_mean_of_the_policies_after_the_last_updates(tmp_path, algorithm):
    """Four updates of 32 steps lie in the last half; 0 leaves the last one."""
    fields = tiny_off_policy(log_every=16) if algorithm == "sac" else tiny_fields("Pendulum-v1")
    if algorithm == "trpo":
        fields = {name: fields[name] for name in ("num_envs", "num_steps", "total_steps", "hidden")}
        fields["critic_minibatch_size"] = 16
    fields |= {"checkpoint_every": 32, "keep_checkpoints": 20, "progress": False}
    plain = lem.train(algorithm, "Pendulum-v1", run=tmp_path / "plain", **fields).path
    mean = lem.train(algorithm, "Pendulum-v1", run=tmp_path / "mean", **{**fields, "average_last": 0.5}).path
    after = [parameters_of(plain, step) for step in (160, 192, 224, 256)]
    final = parameters_of(mean, 256)
    learned = dict(lem.load(mean).networks.named_parameters())
    assert learned
    for name, values in final.items():
        expected = [each[name] for each in after]
        is_learned = name.removeprefix("networks.") in learned
        wanted = torch.stack(expected).mean(0) if is_learned else expected[-1]
        torch.testing.assert_close(values, wanted, rtol=1e-5, atol=1e-6)
    assert any(not final[name].equal(after[-1][name]) for name in final)


def test_a_run_resumed_amid_the_mean_ends_in_the_same_bits(tmp_path):
    fields = tiny_fields("CartPole-v1", average_last=0.5, checkpoint_every=32, keep_checkpoints=20)
    whole = lem.train("ppo", "CartPole-v1", run=tmp_path / "whole", progress=False, **fields).path
    back = shutil.copytree(whole, tmp_path / "back")
    for step in (224, 256):
        (back / "checkpoints" / f"step-{step}" / "manifest.json").unlink()
    lem.resume(back, progress=False)
    ends = [checkpoint.read(path / "checkpoints" / "step-256").tensors for path in (whole, back)]
    assert all(ends[0][name].equal(ends[1][name]) for name in ends[0])


def test_the_mean_of_a_total_that_is_extended_begins_anew(tmp_path):
    fields = tiny_fields("CartPole-v1", average_last=0.5, checkpoint_every=32, keep_checkpoints=40)
    path = tmp_path / "r"
    lem.train("ppo", "CartPole-v1", run=path, progress=False, callbacks=[StopAt(192)], **fields)
    lem.resume(path, total_steps=640, progress=False)
    counts = {
        step: tensors["mean.count"].item() if "mean.count" in tensors else 0
        for step in (192, 224, 320, 352, 608)
        for tensors in [checkpoint.read(path / "checkpoints" / f"step-{step}").tensors]
    }
    assert counts == {192: 2, 224: 0, 320: 0, 352: 1, 608: 9}


def test_the_mean_begins_again_once_the_policy_has_it(rng):
    policy: Policy = torch.nn.Linear(2, 1)
    with torch.no_grad():
        mean = PolicyMean()
        for number in (1.0, 2.0, 6.0):
            policy.weight.fill_(number)
            mean.add(policy)
        mean.move_to(policy)
        assert policy.weight.tolist() == [[3.0, 3.0]]
        mean.add(policy)
        mean.move_to(policy)
        assert policy.weight.tolist() == [[3.0, 3.0]]
