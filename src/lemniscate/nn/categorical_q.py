"""Q(s, a) as a distribution over bins, and weights of length 1, of SAC and REPPO; and all networks of REPPO."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lemniscate.maths import cross_entropy, hl_gauss
from lemniscate.nn.actor_critic import encoder_of, network_of, normalizer_of
from lemniscate.nn.bounded import QValue, SquashedGaussianPolicy
from lemniscate.nn.memory import give_memory, remember, remembered_by
from lemniscate.nn.networks import Layers
from lemniscate.nn.normalizer import NoNorm, RewardScale, WideBuffers
from lemniscate.spec import Spec

BINS = 101
"""K, the number of bins of a Q that is a distribution"""


class Bins(WideBuffers):
    """K = `BINS` bins of equal width on [-c x, c x], x = `value_range` and c a scale of the values.

    Args:
        value_range: x.
        scaled: c is the standard deviation of a return that `observe` follows, saved with the networks; else it is 1.
    """

    unit: Tensor
    """edges at c = 1, [K + 1]"""
    moments: Tensor
    """mean, variance and number of the returns so far, [3]"""

    def __init__(self, value_range: float, *, scaled: bool = False) -> None:
        super().__init__()
        self.register_buffer("unit", torch.linspace(-value_range, value_range, BINS + 1), persistent=False)
        self.register_buffer("moments", torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), persistent=scaled)

    @property
    def edges(self) -> Tensor:
        """The ends of the bins, [K + 1]."""
        return self.unit * self.moments[1].clamp(min=1e-8).sqrt().to(self.unit.dtype)

    def observe(self, scale: RewardScale) -> None:
        """Follow the returns of which `scale` has the statistics: what a distribution says moves with them."""
        self.moments.copy_(torch.stack([scale.mean, scale.var, scale.count]))

    def mean(self, logits: Tensor) -> Tensor:
        """The mean of the distributions with these logits: […, K] to […]."""
        edges = self.edges
        return logits.softmax(-1) @ ((edges[1:] + edges[:-1]) / 2)


class CategoricalQ(QValue):
    """Q(s, a) as the mean of a distribution over bins, behind the policy's observation normalizer.

    Args:
        normalizer: of observations.
        encoder: from normalized observations to features.
        net: from features and action to K = `BINS` logits.
        bins: the K bins; several Q may share them.
        action_gain: the factor of actions before `net`.
        privileged: P, of `QValue`.
    """

    def __init__(
        self,
        normalizer: NoNorm,
        encoder: nn.Module,
        net: nn.Module,
        bins: Bins,
        action_gain: float = 1.0,
        privileged: int = 0,
    ) -> None:
        super().__init__(normalizer, encoder, net, privileged)
        self.bins = bins
        self.action_gain = action_gain

    def logits(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O + P] and […, A] to […, K]."""
        return self.net(torch.cat([self.features(obs), self.action_gain * action], dim=-1))

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O + P] and […, A] to […]."""
        return self.bins.mean(self.logits(obs, action))

    def loss(self, obs: Tensor, action: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """The cross-entropy with the probabilities of y = `target` [M] over the bins, a scalar; and Q(s, a) [M]."""
        logits = self.logits(obs, action)
        return cross_entropy(logits, hl_gauss(target, self.bins.edges)), self.bins.mean(logits)


@torch.no_grad()
def normalize_units(networks: nn.Module) -> None:
    """Divide the weights of each unit of the linear layers by their length, in place.

    A constraint on networks with normalized layers: weights that cannot grow are turned as far by each step of Adam.
    """
    for layer in networks.modules():
        if isinstance(layer, nn.Linear) and layer.weight.requires_grad:
            layer.weight.div_(torch.linalg.vector_norm(layer.weight, dim=1, keepdim=True) + 1e-8)


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
        size, privileged = spec.bounded_box().size, spec.privileged
        net = network_of(spec, actor_layers, 2 * size, last_gain=0.01, remembers=length > 0)
        kept = remembered_by(net)
        normalizer = normalizer_of(spec, normalize_observations, kept)
        self.policy = SquashedGaussianPolicy(normalizer, net, size, initial_log_std)
        encoder, features = encoder_of(spec)
        if kept:
            more = {"privileged": privileged, "actions": size, "policy": kept, "remembers": not shared_memory}
            encoder, critic = nn.Identity(), network_of(spec, critic_layers, BINS, last_gain=0.01, **more)
        else:
            critic = critic_layers.network(features + privileged + size, BINS, last_gain=0.01)
        gain = ((features + privileged) / size) ** 0.5  # of two parts of the input, neither drowns the other
        privileged += remembered_by(critic)
        self.critic = CategoricalQ(normalizer, encoder, critic, Bins(value_range), gain, privileged)
        self.multipliers = Multipliers([INITIAL_MULTIPLIER] * 2)
        self.memory = give_memory(self.policy, critic, spec, length)
        self.piece_length = length if self.memory else 0

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """[B, O] and [B, A] to Q(s, a), [B]."""
        return self.critic(obs, action)

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
