"""A policy and its critics for the spaces of an environment: separate networks behind one normalizer."""

import copy
import math
from typing import Any, Self

import torch
from torch import Generator, Tensor, nn

from lemniscate.nn.critics import QValue, TwinQ, Value
from lemniscate.nn.networks import ImageEncoder, Layers
from lemniscate.nn.normalizer import NoNorm, RunningNorm, ScaleBytes
from lemniscate.nn.policies import (
    BernoulliPolicy,
    CategoricalPolicy,
    DeterministicPolicy,
    GaussianPolicy,
    MultiCategoricalPolicy,
    Policy,
    SquashedGaussianPolicy,
)
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, Spec


class ActorCritic(nn.Module):
    """A policy and a value for the spaces in `spec`: two separate networks behind one normalizer."""

    def __init__(
        self,
        spec: Spec,
        layers: Layers,
        initial_log_std: float = 0.0,
        normalize_observations: bool = False,
    ) -> None:
        super().__init__()
        self.policy = _policy(_normalizer(spec, normalize_observations), spec, layers, initial_log_std)
        self.value = Value(self.policy.normalizer, _from_obs(spec, layers, 1, last_gain=1.0))


class Temperature(nn.Module):
    """SAC's α, the price of entropy; log α is what is learned."""

    def __init__(self, initial: float) -> None:
        super().__init__()
        self.log = nn.Parameter(torch.tensor(math.log(initial)))

    def forward(self) -> Tensor:
        """α, a scalar."""
        return self.log.exp()


class ActorQ(nn.Module):
    """A policy over continuous actions and its Q-value, or two of them: separate networks behind one normalizer.

    With a `temperature` the policy is random, and α, its price of entropy, is learned from there on.
    """

    def __init__(
        self,
        spec: Spec,
        actor_layers: Layers,
        critic_layers: Layers,
        normalize_observations: bool,
        *,
        twin: bool,
        temperature: float | None = None,
    ) -> None:
        super().__init__()
        stochastic = temperature is not None
        size = spec.bounded_box().size
        normalizer = _normalizer(spec, normalize_observations)
        net = _from_obs(spec, actor_layers, 2 * size if stochastic else size, last_gain=0.01)
        kind = SquashedGaussianPolicy if stochastic else DeterministicPolicy
        self.policy: Policy = kind(normalizer, net, size)

        def value() -> QValue:
            encoder, seen = _encoder(spec)
            return QValue(normalizer, encoder, critic_layers.network(seen + size, 1, last_gain=1.0))

        self.critic: Any = TwinQ(value(), value()) if twin else value()
        self.temperature = Temperature(temperature) if temperature is not None else None

    @property
    def actor(self) -> nn.ModuleList:
        """What learns to act: the policy, and α where there is one."""
        return nn.ModuleList(part for part in (self.policy, self.temperature) if part is not None)

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """What is believed of [B, O] and [B, A], [B]: the lower of two."""
        value = self.critic(obs, action)
        return value.amin(0) if isinstance(self.critic, TwinQ) else value

    def entropy_bonus(self, obs: Tensor, generator: Generator) -> Tensor:
        """−α log π of an action drawn at each observation [B, O], [B]; 0 where the policy is not paid for entropy."""
        if self.temperature is None:
            return torch.zeros(len(obs), device=obs.device)
        _, log_prob = self.policy(obs).sample_with_log_prob(self.policy.noise((len(obs),), generator))
        return -self.temperature() * log_prob

    def target(self) -> Self:
        """A copy that only follows, behind the same normalizer."""
        normalizer = self.policy.normalizer
        return copy.deepcopy(self, {id(normalizer): normalizer}).requires_grad_(False)


def _normalizer(spec: Spec, normalize_observations: bool) -> NoNorm:
    kind = ScaleBytes if spec.image else RunningNorm if normalize_observations else NoNorm
    return kind(spec.observation_size)


def _policy(normalizer: NoNorm, spec: Spec, layers: Layers, initial_log_std: float) -> Policy:
    action = spec.action
    net = _from_obs(spec, layers, _outputs(action), last_gain=0.01)
    if isinstance(action, Box):
        return GaussianPolicy(normalizer, net, action, initial_log_std)
    if isinstance(action, Discrete):
        return CategoricalPolicy(normalizer, net, action)
    if isinstance(action, MultiDiscrete):
        return MultiCategoricalPolicy(normalizer, net, action)
    return BernoulliPolicy(normalizer, net, action.n)


def _outputs(action: Action) -> int:
    """How many numbers a network has to give for the distribution over actions."""
    if isinstance(action, Box):
        return action.size
    return sum(action.nvec) if isinstance(action, MultiDiscrete) else action.n


def _encoder(spec: Spec) -> tuple[nn.Module, int]:
    """What an observation goes through first, and how many numbers come out."""
    if not spec.image:
        return nn.Identity(), spec.observation_size
    height, width, channels = spec.observation_parts[0].shape
    encoder = ImageEncoder((height, width, channels))
    return encoder, encoder.size


def _from_obs(spec: Spec, layers: Layers, outputs: int, last_gain: float) -> nn.Sequential:
    encoder, size = _encoder(spec)
    net = layers.network(size, outputs, last_gain)
    return nn.Sequential(encoder, net) if spec.image else net
