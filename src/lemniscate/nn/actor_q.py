"""A policy and Q(s, a) for bounded continuous actions: separate networks behind one normalizer."""

import copy
import math
from typing import Any

import torch
from torch import Generator, Tensor, nn

from lemniscate.nn.actor_critic import encoder_of, network_of, normalizer_of
from lemniscate.nn.critics import BINS, Bins, CategoricalQ, Critics, QValue, Temperature
from lemniscate.nn.memory import give_memory, remember, remembered_by
from lemniscate.nn.networks import Layers
from lemniscate.nn.policies import DeterministicPolicy, Policy, SquashedGaussianPolicy
from lemniscate.spec import Spec


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

    kind: type[Policy] = DeterministicPolicy
    outputs = 1
    """of the policy's network, for each coordinate of an action"""

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
        self.bins, action = bins, spec.bounded_box()
        normalizer = normalizer_of(spec, normalize_observations)
        net = network_of(spec, actor_layers, self.outputs * action.size, last_gain=0.01)
        self.policy = self.kind(normalizer, net, action)

        def critic() -> QValue:
            encoder, features = encoder_of(spec)
            inputs = features + spec.privileged + action.size
            if bins is None:
                return QValue(normalizer, encoder, critic_layers.network(inputs, 1, last_gain=1.0), spec.privileged)
            net = critic_layers.network(inputs, BINS, last_gain=0.01)
            return CategoricalQ(normalizer, encoder, net, bins, privileged=spec.privileged)

        self.critics = Critics(critic() for _ in range(critics))

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """The smallest of the C values of [B, O] and [B, A], [B]."""
        return self.critics(obs, action).amin(0)

    def entropy_bonus(self, obs: Tensor, generator: Generator) -> Tensor:
        """The value of the policy's entropy at each observation [B, O]: 0 [B] for a deterministic policy."""
        return torch.zeros(len(obs), device=obs.device)

    def followed(self) -> nn.Module:
        """Policy and critics, of which the target networks are copies."""
        return self

    def target(self) -> nn.Module:
        """A copy for the target networks, with the same normalizer and bins; its parameters need no gradient."""
        shared = {id(module): module for module in (self.policy.normalizer, self.bins)}  # a memo: these are not copied
        return copy.deepcopy(self.followed(), shared).requires_grad_(False)


class SoftActorQ(ActorQ):
    """A stochastic policy for bounded continuous actions, C critics, and the temperature α of its entropy."""

    kind = SquashedGaussianPolicy
    outputs = 2

    def __init__(self, *args: Any, initial_temperature: float, **options: Any) -> None:
        super().__init__(*args, **options)
        self.temperature = Temperature(initial_temperature)

    def followed(self) -> nn.Module:
        """The critics: SAC has no target policy."""
        return self.critics

    def entropy_bonus(self, obs: Tensor, generator: Generator) -> Tensor:
        """−α log π(a|s) of an action drawn at each observation [B, O], [B]."""
        return _bonus(self.temperature(), self.policy, obs, generator)


def _bonus(temperature: Tensor, policy: Policy, obs: Tensor, generator: Generator) -> Tensor:
    _, log_prob = policy(obs).sample_with_log_prob(policy.draw_noise((len(obs),), generator))
    return -temperature * log_prob


class Multipliers(nn.Module):
    """The Lagrange multipliers α and β, above zero; their logs are the parameter. As in the paper, 0.01 at first."""

    def __init__(self) -> None:
        super().__init__()
        self.log = nn.Parameter(torch.full((2,), math.log(0.01)))

    def forward(self) -> Tensor:
        """α and β, [2]."""
        return self.log.exp()

    @torch.no_grad()
    def keep_temperature_above(self, least: float) -> None:
        """Set α to `least` where it is below, in place: the projection of projected gradient descent."""
        self.log[:1].clamp_(min=math.log(least) if least else -math.inf)


class ActorCategoricalQ(nn.Module):
    """A stochastic policy for bounded continuous actions, Q(s, a) as a distribution, and the multipliers α and β.

    The first arguments are those of `ActorQ`.

    Args:
        initial_log_std: log σ of the policy before the tanh, at first.
        value_range: of the critic's bins.
        length: steps of the pieces that networks with a memory learn from.
        shared_memory: let the critic see what the policy remembers, in the place of a memory of its own.

    Raises:
        UserError: actions that are not continuous, or without bounds.
    """

    def __init__(
        self,
        spec: Spec,
        actor_layers: Layers,
        critic_layers: Layers,
        normalize_observations: bool,
        initial_log_std: float,
        value_range: float,
        length: int = 0,
        shared_memory: bool = False,
    ) -> None:
        super().__init__()
        action, privileged = spec.bounded_box(), spec.privileged
        net = network_of(spec, actor_layers, 2 * action.size, last_gain=0.01, remembers=length > 0)
        kept = remembered_by(net)
        normalizer = normalizer_of(spec, normalize_observations, kept)
        self.policy = SquashedGaussianPolicy(normalizer, net, action, initial_log_std)
        encoder, features = encoder_of(spec)
        if kept:
            more = {"privileged": privileged, "actions": action.size, "policy": kept, "remembers": not shared_memory}
            encoder, critic = nn.Identity(), network_of(spec, critic_layers, BINS, last_gain=0.01, **more)
        else:
            critic = critic_layers.network(features + privileged + action.size, BINS, last_gain=0.01)
        gain = ((features + privileged) / action.size) ** 0.5  # of two parts of the input, neither drowns the other
        privileged += remembered_by(critic)
        self.critic = CategoricalQ(normalizer, encoder, critic, Bins(value_range), gain, privileged)
        self.multipliers = Multipliers()
        self.memory = give_memory(self.policy, critic, spec, length)
        self.piece_length = length if self.memory else 0

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """[B, O] and [B, A] to Q(s, a), [B]."""
        return self.critic(obs, action)

    def entropy_bonus(self, obs: Tensor, generator: Generator) -> Tensor:
        """−α log π(a|s) of an action drawn at each observation [B, O], [B]."""
        return _bonus(self.multipliers()[0], self.policy, obs, generator)

    def estimates(self, obs: Tensor, next_obs: Tensor, action: Tensor, noise: Tensor) -> tuple[Tensor, ...]:
        """Q(s, a), Q(s', a') and log π(a'|s') of an a' drawn with `noise`, μ and log σ of π(·|s): of rows [T, N, …]."""
        shape = obs.shape[:2]
        obs, next_obs, action, noise = (x.flatten(0, 1) for x in (obs, next_obs, action, noise))  # rows, not pieces
        policy = self.policy(obs)
        next_action, next_log_prob = self.policy(next_obs).sample_with_log_prob(noise)
        values = self.critic(obs, action), self.critic(next_obs, next_action)
        return tuple(x.unflatten(0, shape) for x in (*values, next_log_prob, policy.mean, policy.log_std))

    def remember(self, obs: Tensor) -> Tensor:
        """The memories of policy and critic after rows [N, …], [N, policy + critic]."""
        return torch.cat([self.policy.remember(obs), remember(self.critic.net, self.critic.features(obs))], dim=-1)
