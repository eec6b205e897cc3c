"""A stochastic policy, a Q(s, a) that is a distribution over bins, and the multipliers of two constraints."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lemniscate.nn.actor_critic import encoder_of, network_of, normalizer_of
from lemniscate.nn.bounded import SquashedGaussianPolicy
from lemniscate.nn.categorical_q import BINS, Bins, CategoricalQ
from lemniscate.nn.networks import Layers
from lemniscate.spec import Spec

INITIAL_MULTIPLIER = 0.01
"""α and β at first, as in the paper"""


class Multipliers(nn.Module):
    """Lagrange multipliers, each above zero; their logs are the parameter."""

    def __init__(self, initial: Sequence[float]) -> None:
        super().__init__()
        self.log = nn.Parameter(torch.tensor([math.log(value) for value in initial]))

    def forward(self) -> Tensor:
        """[number of multipliers]."""
        return self.log.exp()

    @torch.no_grad()
    def raise_first(self, least: float) -> None:
        """Set the first to `least` where it is below, in place: the projection of projected gradient descent."""
        self.log[:1].clamp_(min=math.log(least) if least else -math.inf)


class ActorCategoricalQ(nn.Module):
    """A stochastic policy for bounded continuous actions, Q(s, a) as a distribution, and the multipliers α and β.

    Args:
        spec: of the environment.
        actor_layers: of the policy.
        critic_layers: of the critic.
        normalize_observations: put a running normalizer in front of both.
        initial_log_std: log σ of the policy before the tanh, at first.
        value_range: of the critic's bins.

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
    ) -> None:
        super().__init__()
        size = spec.bounded_box().size
        normalizer = normalizer_of(spec, normalize_observations)
        net = network_of(spec, actor_layers, 2 * size, last_gain=0.01)
        self.policy = SquashedGaussianPolicy(normalizer, net, size, initial_log_std)
        encoder, features = encoder_of(spec)
        critic = critic_layers.network(features + spec.privileged + size, BINS, last_gain=0.01)
        gain = ((features + spec.privileged) / size) ** 0.5  # of two parts of the input, neither drowns the other
        self.critic = CategoricalQ(normalizer, encoder, critic, Bins(value_range), gain, spec.privileged)
        self.multipliers = Multipliers([INITIAL_MULTIPLIER] * 2)

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """[B, O] and [B, A] to Q(s, a), [B]."""
        return self.critic(obs, action)

    def estimates(self, obs: Tensor, next_obs: Tensor, action: Tensor, noise: Tensor) -> tuple[Tensor, ...]:
        """Q(s, a), Q(s', a') and log π(a'|s') of an a' drawn with `noise`, μ and log σ of π(·|s): of rows […, …]."""
        policy = self.policy(obs)
        next_action, next_log_prob = self.policy(next_obs).sample_with_log_prob(noise)
        values = self.critic(obs, action), self.critic(next_obs, next_action)
        return *values, next_log_prob, policy.mean, policy.log_std
