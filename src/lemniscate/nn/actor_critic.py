"""A policy and its critics for the spaces of an environment: separate networks behind one normalizer."""

import copy
from typing import TypeVar

import torch
from torch import Generator, Tensor, nn

from lemniscate.nn.critics import Critics, QValue, Temperature, Value
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

Module = TypeVar("Module", bound=nn.Module)


class ActorCritic(nn.Module):
    """A policy for any actions, and V(s)."""

    def __init__(
        self, spec: Spec, layers: Layers, initial_log_std: float = 0.0, normalize_observations: bool = False
    ) -> None:
        super().__init__()
        self.policy = _policy(_normalizer(spec, normalize_observations), spec, layers, initial_log_std)
        self.value = Value(self.policy.normalizer, _network(spec, layers, 1, last_gain=1.0))


class ActorQ(nn.Module):
    """A policy for bounded continuous actions, deterministic in this class, and C critics Q(s, a).

    Args:
        spec: of the environment.
        actor_layers: of the policy.
        critic_layers: of each critic.
        normalize_observations: put a running normalizer in front of all of them.
        critics: C.

    Raises:
        UserError: actions that are not continuous, or without bounds.
    """

    def __init__(
        self, spec: Spec, actor_layers: Layers, critic_layers: Layers, normalize_observations: bool, *, critics: int
    ) -> None:
        super().__init__()
        size = spec.bounded_box().size
        normalizer = _normalizer(spec, normalize_observations)
        self.policy: Policy = self._policy(spec, normalizer, actor_layers, size)

        def critic() -> QValue:
            encoder, features = _encoder(spec)
            return QValue(normalizer, encoder, critic_layers.network(features + size, 1, last_gain=1.0))

        self.critics = Critics(critic() for _ in range(critics))

    def _policy(self, spec: Spec, normalizer: NoNorm, layers: Layers, size: int) -> Policy:
        return DeterministicPolicy(normalizer, _network(spec, layers, size, last_gain=0.01), size)

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """The smallest of the C values of [B, O] and [B, A], [B]."""
        return self.critics(obs, action).amin(0)

    def entropy_bonus(self, obs: Tensor, generator: Generator) -> Tensor:
        """The value of the policy's entropy at each observation [B, O]: 0 [B] for a deterministic policy."""
        return torch.zeros(len(obs), device=obs.device)

    def target(self) -> nn.Module:
        """A copy for the target networks: it shares the normalizer, and its parameters need no gradient."""
        return self._follower(self)

    def _follower(self, networks: Module) -> Module:
        normalizer = self.policy.normalizer
        return copy.deepcopy(networks, {id(normalizer): normalizer}).requires_grad_(False)  # the memo keeps it shared


class SoftActorQ(ActorQ):
    """A stochastic policy for bounded continuous actions, C critics, and the temperature α of its entropy."""

    def __init__(
        self,
        spec: Spec,
        actor_layers: Layers,
        critic_layers: Layers,
        normalize_observations: bool,
        *,
        critics: int,
        initial_temperature: float,
    ) -> None:
        super().__init__(spec, actor_layers, critic_layers, normalize_observations, critics=critics)
        self.temperature = Temperature(initial_temperature)

    def _policy(self, spec: Spec, normalizer: NoNorm, layers: Layers, size: int) -> Policy:
        return SquashedGaussianPolicy(normalizer, _network(spec, layers, 2 * size, last_gain=0.01), size)

    def target(self) -> nn.Module:
        """A copy of the critics, which are all that has target networks."""
        return self._follower(self.critics)

    def entropy_bonus(self, obs: Tensor, generator: Generator) -> Tensor:
        """−α log π(a|s) of an action drawn at each observation [B, O], [B]."""
        _, log_prob = self.policy(obs).sample_with_log_prob(self.policy.draw_noise((len(obs),), generator))
        return -self.temperature() * log_prob


def _normalizer(spec: Spec, normalize_observations: bool) -> NoNorm:
    kind = ScaleBytes if spec.image else RunningNorm if normalize_observations else NoNorm
    return kind(spec.observation_size)


def _policy(normalizer: NoNorm, spec: Spec, layers: Layers, initial_log_std: float) -> Policy:
    action = spec.action
    net = _network(spec, layers, _outputs(action), last_gain=0.01)
    if isinstance(action, Box):
        return GaussianPolicy(normalizer, net, action, initial_log_std)
    if isinstance(action, Discrete):
        return CategoricalPolicy(normalizer, net, action)
    if isinstance(action, MultiDiscrete):
        return MultiCategoricalPolicy(normalizer, net, action)
    return BernoulliPolicy(normalizer, net, action.n)


def _outputs(action: Action) -> int:
    """The number of parameters of a distribution over the actions."""
    if isinstance(action, Box):
        return action.size
    return sum(action.nvec) if isinstance(action, MultiDiscrete) else action.n


def _encoder(spec: Spec) -> tuple[nn.Module, int]:
    """The module that turns a normalized observation into features, and their number."""
    if not spec.image:
        return nn.Identity(), spec.observation_size
    height, width, channels = spec.observation_parts[0].shape
    encoder = ImageEncoder((height, width, channels))
    return encoder, encoder.size


def _network(spec: Spec, layers: Layers, outputs: int, last_gain: float) -> nn.Module:
    encoder, features = _encoder(spec)
    net = layers.network(features, outputs, last_gain)
    return nn.Sequential(encoder, net) if spec.image else net
