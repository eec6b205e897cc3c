"""Policies and values. A policy returns a distribution and remembers nothing."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lemniscate.maths import Categorical, Distribution, Gaussian
from lemniscate.nn.networks import Activation, mlp
from lemniscate.nn.normalizer import RunningNorm
from lemniscate.types import Box, Spec


class Policy(nn.Module):
    """Base of all policies: `normalizer`, then `forward(obs [B, O]) -> Distribution`."""

    normalizer: nn.Module

    def forward(self, obs: Tensor) -> Distribution:
        """The distribution over actions at each observation, [B, O]."""
        raise NotImplementedError

    def observe(self, obs: Tensor) -> None:
        """Take [B, O] training observations into the normalizer's statistics, if there is one."""
        if isinstance(self.normalizer, RunningNorm):
            self.normalizer.update(obs)


class GaussianPolicy(Policy):
    """N(μ(s), σ²) in normalized action units, σ one learned number per coordinate, the same in every state."""

    def __init__(self, normalizer: nn.Module, net: nn.Module, action_size: int, initial_log_std: float) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net
        self.log_std = nn.Parameter(torch.full((action_size,), initial_log_std))

    def forward(self, obs: Tensor) -> Gaussian:
        """[B, O] to N(μ [B, A], σ [A])."""
        return Gaussian(self.net(self.normalizer(obs)), self.log_std)


class CategoricalPolicy(Policy):
    """A softmax over n actions."""

    def __init__(self, normalizer: nn.Module, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net

    def forward(self, obs: Tensor) -> Categorical:
        """[B, O] to logits [B, n]."""
        return Categorical(self.net(self.normalizer(obs)))


class Value(nn.Module):
    """V(s). It looks through the policy's normalizer, and does not own it."""

    def __init__(self, normalizer: nn.Module, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O] to […]."""
        return self.net(self.normalizer(obs)).squeeze(-1)


def policy_and_value(
    spec: Spec,
    hidden: Sequence[int] = (64, 64),
    activation: Activation = "tanh",
    *,
    initial_log_std: float = 0.0,
    normalize_observations: bool = False,
) -> tuple[Policy, Value]:
    """Two separate networks for the spaces in `spec`: Gaussian for Box actions, categorical for Discrete ones."""
    obs_size = spec.observation_size
    normalizer = RunningNorm(obs_size) if normalize_observations else nn.Identity()
    if isinstance(spec.action, Box):
        net = mlp((obs_size, *hidden, spec.action.size), activation, last_gain=0.01)
        policy: Policy = GaussianPolicy(normalizer, net, spec.action.size, initial_log_std)
    else:
        policy = CategoricalPolicy(normalizer, mlp((obs_size, *hidden, spec.action.n), activation, last_gain=0.01))
    return policy, Value(normalizer, mlp((obs_size, *hidden, 1), activation, last_gain=1.0))
