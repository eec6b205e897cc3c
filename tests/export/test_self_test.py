"""Wrong exports, each of which `policy_self_test` tells from the right one."""

import numpy as np
import pytest
import torch
from exported import BOX, needs_compiler, policy_for
from torch import nn

from lemniscate.algos import ppo, sac
from lemniscate.exporting.c_code import c_files
from lemniscate.exporting.compiled import HostPolicy, host_compiler
from lemniscate.exporting.deployed import Deployed, act_with
from lemniscate.exporting.parity import EDGES, TESTS, self_tests
from lemniscate.exporting.translation import translate
from lemniscate.spec import Discrete

pytestmark = needs_compiler


class Swapped(nn.Module):
    """Two observations in each other's place."""

    def __init__(self, deployed):
        super().__init__()
        self.deployed = deployed

    def forward(self, obs):
        return self.deployed(obs[:, [1, 0, *range(2, obs.shape[1])]])


def no_observation_clip(deployed):
    deployed.policy.normalizer.clip = 1e30
    return deployed


def no_action_clip(deployed):
    deployed.low, deployed.high = deployed.low * 1e9 - 1e9, deployed.high * 1e9 + 1e9
    return deployed


def no_scale(deployed):
    deployed.middle, deployed.half_width = torch.zeros_like(deployed.middle), torch.ones_like(deployed.half_width)
    return deployed


def no_squash(deployed):
    class Plain(nn.Module):
        def __init__(self):
            super().__init__()
            self.deployed = deployed

        def forward(self, obs):
            mean = self.deployed.policy(obs).mean
            return torch.clamp(deployed.middle + deployed.half_width * mean, deployed.low, deployed.high)

    return Plain()


def other_normalizer(deployed):
    deployed.policy.normalizer.mean += 0.1
    deployed.policy.normalizer.var *= 1.2
    return deployed


def no_normalizer(deployed):
    deployed.policy.normalizer.mean *= 0
    deployed.policy.normalizer.var.fill_(1)
    return deployed


def transposed(deployed):
    layer = [module for module in deployed.policy.net.modules() if isinstance(module, nn.Linear)][1]
    layer.weight.data = layer.weight.data.T.contiguous()
    return deployed


def unchanged(deployed):
    return deployed


MUTANTS = [no_observation_clip, no_action_clip, no_scale, Swapped, other_normalizer, no_normalizer, transposed]


def self_test_of(mutate, algo=ppo, action=BOX, *, real=False):
    """What the self-test of a right policy says where the policy is another."""
    right, wrong = (policy_for(action, algo, normalize_observations=True) for _ in range(2))
    obs = np.random.default_rng(0).normal(0, 2, (1000, 7)).astype(np.float32)  # hardly one is clipped
    tests = self_tests(right, obs)
    tests = tests[:TESTS] if real else tests
    with torch.no_grad():
        program = translate(mutate(Deployed(wrong).eval()), 7)
    files = c_files(program, action, tests, act_with(right)(tests), title="", origin="")
    return HostPolicy(files, host_compiler(), ("-O0",)).self_test()


@pytest.mark.parametrize("mutate", MUTANTS)
def test_a_wrong_export_fails_its_self_test(mutate):
    assert self_test_of(mutate) > 1e-3


def test_an_export_without_its_squash_fails_too():
    assert self_test_of(no_squash, sac) > 1e-3


@pytest.mark.parametrize("algo", [ppo, sac])
def test_a_right_one_passes(algo):
    assert self_test_of(unchanged, algo) < 1e-5


def test_without_the_observations_for_the_clips_one_would_not_show():
    assert self_test_of(no_observation_clip, real=True) < 1e-5


def test_the_text_itself_can_be_broken_too():
    policy = policy_for(normalize_observations=True)
    obs = np.random.default_rng(0).normal(0, 2, (1000, 7)).astype(np.float32)
    tests = self_tests(policy, obs)
    files = c_files(translate(Deployed(policy).eval(), 7), BOX, tests, act_with(policy)(tests), title="", origin="")
    for right, wrong in (
        ("policy_max((obs[i]", "(0.0F * policy_max(0.0F, 0.0F) + (obs[i]"),  # no lower clip
        ("a += weight[i] * x[i];\n            b", "a += weight[i] * x[i + 1];\n            b"),
        ("y[row] = (a + b) + (c + d);", "y[row] = (a + b) + c;"),
        ("bias ? bias[row] : 0.0F", "bias ? 0.0F : 0.0F"),
    ):
        assert right in files["policy.c"]
        text = files["policy.c"].replace(right, wrong, 1)
        text = text.replace(", (-10.0F))", ")", 1) if "lower" in right else text
        if right.startswith("policy_max"):
            text = text.replace(", (-10.0F)), 10.0F)", "), 10.0F)", 1)
        assert HostPolicy({**files, "policy.c": text}, host_compiler(), ("-O0", "-Wno-error")).self_test() > 1e-3, wrong


def test_choices_that_hang_on_a_rounding_are_not_in_the_self_test():
    policy = policy_for(Discrete(3))
    obs = np.random.default_rng(0).normal(0, 2, (200, 7)).astype(np.float32)
    act, low, high = (
        act_with(policy),
        obs[0],
        next(row for row in obs if act_with(policy)(row[None]) != act_with(policy)(obs[:1])),
    )
    for _ in range(40):  # towards a point at which two actions are equally good
        middle = (low + high) / 2
        low, high = (middle, high) if act(middle[None]) == act(obs[:1]) else (low, middle)
    obs[::2] = low
    tests = self_tests(policy, obs)
    assert len(tests) == TESTS + EDGES
    assert not (tests == low).all(1).any()


def test_observations_of_the_self_test_are_real_and_from_all_over():
    policy = policy_for(normalize_observations=True)
    obs = np.random.default_rng(0).normal(0, 2, (1000, 7)).astype(np.float32)
    tests = self_tests(policy, obs)
    assert len(tests) == TESTS + EDGES
    places = [int(np.flatnonzero((obs == row).all(1))[0]) for row in tests[:TESTS]]
    assert places[0] == 0
    assert places[-1] == 999
    assert max(np.diff(places)) < 20
    changed = [(row != obs).sum(1).min() for row in tests[TESTS:]]
    assert changed == [1] * EDGES
