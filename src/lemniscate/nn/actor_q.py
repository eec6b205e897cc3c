"""A policy and Q(s, a) for bounded continuous actions: separate networks behind one normalizer."""

import copy
from typing import TypeVar

import torch
from torch import Generator, Tensor, nn

from lemniscate.nn.actor_critic import encoder_of, network_of, normalizer_of
from lemniscate.nn.bounded import Critics, DeterministicPolicy, QValue, SquashedGaussianPolicy, Temperature
from lemniscate.nn.categorical_q import BINS, Bins, CategoricalQ
from lemniscate.nn.networks import Layers
from lemniscate.nn.normalizer import NoNorm
from lemniscate.nn.policies import Policy
from lemniscate.spec import Spec

Module = TypeVar("Module", bound=nn.Module)


class ActorQ(nn.Module):
    """A policy for bounded continuous actions, deterministic in this class, and C critics Q(s, a).

    Args:
        spec: of the environment.
        actor_layers: of the policy.
        critic_layers: of each critic.
        normalize_observations: put a running normalizer in front of all of them.
        critics: C.
        bins: those of a Q that is a distribution; None: Q is a number.

    Raises:
        UserError: actions that are not continuous, or without bounds.
    """

    def __init__(
        self,
        spec: Spec,
        actor_layers: Layers,
        critic_layers: Layers,
        normalize_observations: bool,
        *,
        critics: int,
        bins: Bins | None = None,
    ) -> None:
        super().__init__()
        self.bins = bins
        size = spec.bounded_box().size
        normalizer = normalizer_of(spec, normalize_observations)
        self.policy: Policy = self._policy(spec, normalizer, actor_layers, size)

        def critic() -> QValue:
            encoder, features = encoder_of(spec)
            inputs = features + spec.privileged + size
            if self.bins is None:
                return QValue(normalizer, encoder, critic_layers.network(inputs, 1, last_gain=1.0), spec.privileged)
            net = critic_layers.network(inputs, BINS, last_gain=0.01)
            return CategoricalQ(normalizer, encoder, net, self.bins, privileged=spec.privileged)

        self.critics = Critics(critic() for _ in range(critics))

    def _policy(self, spec: Spec, normalizer: NoNorm, layers: Layers, size: int) -> Policy:
        return DeterministicPolicy(normalizer, network_of(spec, layers, size, last_gain=0.01), size)

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """The smallest of the C values of [B, O] and [B, A], [B]."""
        return self.critics(obs, action).amin(0)

    def entropy_bonus(self, obs: Tensor, generator: Generator) -> Tensor:
        """The value of the policy's entropy at each observation [B, O]: 0 [B] for a deterministic policy."""
        return torch.zeros(len(obs), device=obs.device)

    def target(self) -> nn.Module:
        """A copy for the target networks, with the same normalizer and bins; its parameters need no gradient."""
        return self._follower(self)

    def _follower(self, networks: Module) -> Module:
        shared = {id(module): module for module in (self.policy.normalizer, self.bins)}  # a memo: these are not copied
        return copy.deepcopy(networks, shared).requires_grad_(False)


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
        bins: Bins | None = None,
    ) -> None:
        super().__init__(spec, actor_layers, critic_layers, normalize_observations, critics=critics, bins=bins)
        self.temperature = Temperature(initial_temperature)

    def _policy(self, spec: Spec, normalizer: NoNorm, layers: Layers, size: int) -> Policy:
        return SquashedGaussianPolicy(normalizer, network_of(spec, layers, 2 * size, last_gain=0.01), size)

    def target(self) -> nn.Module:
        """A copy of the critics, which are all that has target networks."""
        return self._follower(self.critics)

    def entropy_bonus(self, obs: Tensor, generator: Generator) -> Tensor:
        """−α log π(a|s) of an action drawn at each observation [B, O], [B]."""
        _, log_prob = self.policy(obs).sample_with_log_prob(self.policy.draw_noise((len(obs),), generator))
        return -self.temperature() * log_prob
