"""Policies without training, and their exports."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from lemniscate.algos import ppo
from lemniscate.api.policy import TrainedPolicy
from lemniscate.exporting.c_code import c_files
from lemniscate.exporting.compiled import HostPolicy, host_compiler
from lemniscate.exporting.deployed import Deployed, act_with, input_size
from lemniscate.exporting.onnx_model import onnx_act, onnx_model
from lemniscate.exporting.translation import Program, translate
from lemniscate.spec import Box, ObservationPart, Spec

needs_compiler = pytest.mark.skipif(not host_compiler(), reason="there is no C compiler")
BOX = Box((-1.0, -2.0, 0.0), (1.0, 2.0, 0.5))


@dataclass
class Exported:
    """A policy, what it was translated to, and observations with the true actions."""

    policy: TrainedPolicy
    program: Program
    obs: np.ndarray
    true: np.ndarray
    hosts: dict[Any, HostPolicy] = field(default_factory=dict)

    def files(self, tests=16):
        obs, true = self.obs[:tests], self.true[:tests]
        return c_files(self.program, self.policy.spec.action, obs, true, title="A policy.", origin="random ones")

    def host(self, *flags):
        """Compiled once for each choice of flags."""
        flags = flags or ("-O0",)
        if flags not in self.hosts:
            self.hosts[flags] = HostPolicy(self.files(), host_compiler(), flags)
        return self.hosts[flags]

    def onnx(self, obs):
        return onnx_act(onnx_model(self.program, {"a": 1}))[0](obs)


def policy_for(action=BOX, algo=ppo, *, observations=7, spread=0.2, seed=0, **fields: Any):
    """A policy with random parameters, and a normalizer of random moments where it has one."""
    torch.manual_seed(seed)
    spec = Spec("x", (ObservationPart((), (observations,)),), action)
    config = algo.Config(env="CartPole-v1", **{"hidden": (16, 16), **fields})
    networks = config.networks(spec)
    with torch.no_grad():
        for parameter in networks.policy.parameters():
            parameter += spread * torch.randn_like(parameter)
    networks.policy.observe(torch.randn(100, input_size(spec)) * 2 + torch.randn(input_size(spec)))
    return TrainedPolicy(networks, spec, config, 0)


def observations_for(policy, rows=500, seed=1):
    """Random observations, and in a masked environment masks that permit something."""
    rng = np.random.default_rng(seed)
    obs = rng.normal(0, 3, (rows, policy.spec.observation_size)).astype(np.float32)
    action = policy.spec.action
    for count in getattr(action, "nvec", (action.mask_size,)) if action.mask_size else ():
        mask = rng.random((rows, count)) < 0.5
        mask[:, -1] |= ~mask.any(1)
        obs = np.concatenate([obs, mask], axis=1).astype(np.float32)
    return obs


def exported(policy, **how):
    """The export of a policy in memory."""
    obs = observations_for(policy, **how)
    program = translate(Deployed(policy).eval(), obs.shape[1])
    return Exported(policy, program, obs, act_with(policy)(obs))


@cache
def plain():
    """The export of a policy without anything special, for tests that look at its text."""
    return exported(policy_for())
