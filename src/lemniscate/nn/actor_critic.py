"""A policy for the spaces of an environment, and V(s): separate networks behind one normalizer; or Q alone."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn

from lemniscate.errors import UserError
from lemniscate.maths import Distribution
from lemniscate.nn.memory import (
    Columns,
    Remembering,
    cell_of,
    give_memory,
    head_of,
    remember,
    remembered_by,
    side_by_side,
)
from lemniscate.nn.networks import ImageEncoder, Layers, PartsEncoder
from lemniscate.nn.normalizer import NoNorm, NormByPart, RunningNorm, ScaleBytes, with_privileged
from lemniscate.nn.policies import (
    BernoulliPolicy,
    CategoricalPolicy,
    EpsilonGreedyPolicy,
    GaussianPolicy,
    MultiCategoricalPolicy,
    Policy,
)
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, Spec

CHUNK = 4096
"""rows that a network takes at once where all are given: what comes of more does not stay in a processor's cache"""


class Value(nn.Module):
    """V(s), behind the policy's observation normalizer; it sees the P = `privileged` numbers too, as they are."""

    def __init__(self, normalizer: NoNorm, net: nn.Module, privileged: int = 0) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net
        self.privileged = privileged

    def inputs(self, obs: Tensor) -> Tensor:
        """Rows […, O + P], normalized."""
        return with_privileged(self.normalizer(obs), obs, self.normalizer.size, self.privileged)

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O + P] to […]."""
        return self.net(self.inputs(obs)).squeeze(-1)

    def remember(self, obs: Tensor) -> Tensor:
        """The memory of its network after rows [N, O + P]."""
        return remember(self.net, self.inputs(obs))


class ActorCritic(nn.Module):
    """A policy for any actions, and V(s), with `critic_layers` if they are not as those of the policy.

    Networks that remember learn from pieces of `length` steps. With `shared_memory` V(s) sees what the policy
    remembers, in the place of a memory of its own.
    """

    def __init__(
        self,
        spec: Spec,
        layers: Layers,
        initial_log_std: float = 0.0,
        normalize_observations: bool = False,
        *,
        critic_layers: Layers | None = None,
        length: int = 0,
        shared_memory: bool = False,
    ) -> None:
        super().__init__()
        net = network_of(spec, layers, _outputs(spec.action), last_gain=0.01, remembers=length > 0)
        size = remembered_by(net)
        self.policy = _policy(normalizer_of(spec, normalize_observations, size), net, spec, initial_log_std)
        more = {"privileged": spec.privileged, "policy": size, "remembers": not shared_memory}
        critic = network_of(spec, critic_layers or layers, 1, last_gain=1.0, **more)
        self.value = Value(self.policy.normalizer, critic, spec.privileged + remembered_by(critic))
        self.memory = give_memory(self.policy, critic, spec, length)
        self.piece_length = length if self.memory else 0

    def forward(self, obs: Tensor) -> tuple[Distribution, Tensor]:
        """π(·|s) and V(s) of rows [B, …], or of pieces of L steps [P, L, …]."""
        if obs.dim() == 2:
            return self.policy(obs), self.value(obs)
        inputs = self.policy.normalizer(obs), self.value.inputs(obs)
        outputs, value = side_by_side((self.policy.net, self.value.net), inputs)
        return self.policy.distribution_of(outputs, obs), value.squeeze(-1)

    def estimates(self, obs: Tensor, next_obs: Tensor) -> tuple[Tensor, Tensor]:
        """V(s) and V(s') of rows [T, N, …], [T, N] each."""
        value = in_chunks(self.value, obs)  # of rows, not of pieces
        return value, next_values(self.value, value, obs, next_obs)

    @torch.no_grad()
    def log_prob(self, obs: Tensor, action: Tensor) -> Tensor:
        """Log π(a|s) of rows [T, N, …], [T, N], without a gradient."""
        rows = zip(obs.flatten(0, 1).split(CHUNK), action.flatten(0, 1).split(CHUNK), strict=True)
        return torch.cat([self.policy(s).log_prob(a) for s, a in rows]).view(obs.shape[:2])

    def remember(self, obs: Tensor) -> Tensor:
        """The memories of policy and critic after rows [N, …], [N, policy + critic]."""
        return torch.cat([self.policy.remember(obs), self.value.remember(obs)], dim=-1)


class ActionValues(nn.Module):
    """An ε-greedy policy; its network is Q(s, ·).

    Raises:
        UserError: actions of another kind than Discrete.
    """

    memory = None
    """no columns: Q learns without a memory"""

    def __init__(self, spec: Spec, layers: Layers, normalize_observations: bool) -> None:
        super().__init__()
        if not isinstance(spec.action, Discrete):
            kind = type(spec.action).__name__
            raise UserError(
                f"{spec.env_id} has actions of kind {kind}; Q has an output for each one of n,"
                " Discrete. ppo learns here."
            )
        net = network_of(spec, layers, spec.action.n, last_gain=0.01)
        self.policy = EpsilonGreedyPolicy(normalizer_of(spec, normalize_observations), net, spec.action)

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """Q(s, a) of rows […, O] and […], […]."""
        return _values_taken(self.policy(obs).values, action)

    def value(self, obs: Tensor) -> Tensor:
        """max_a Q(s, a) of rows […, O], […]."""
        return self.policy(obs).values.amax(-1)

    def estimates(self, obs: Tensor, next_obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Q(s, a) and max_a Q(s', a) of rows [T, N, O], [T, N, O] and [T, N], [T, N] each."""
        values = self.policy(obs).values
        return _values_taken(values, action), next_values(self.value, values.amax(-1), obs, next_obs)


def _values_taken(values: Tensor, action: Tensor) -> Tensor:
    """Those of the actions taken, […], of Q(s, ·) […, n]."""
    return values.gather(-1, action.unsqueeze(-1)).squeeze(-1)


def in_chunks(function: Callable[[Tensor], Tensor], rows: Tensor) -> Tensor:
    """A function of rows [T, N, …], a chunk of them at a time, [T, N]."""
    return torch.cat(list(map(function, rows.flatten(0, 1).split(CHUNK)))).view(rows.shape[:2])


def next_values(function: Callable[[Tensor], Tensor], now: Tensor, obs: Tensor, next_obs: Tensor) -> Tensor:
    """A function at s' [T, N, …]: its value `now` [T, N] at the row after, where that begins with s'; else computed."""
    if torch.compiler.is_compiling():  # a program has one shape
        return in_chunks(function, next_obs)
    others = torch.ones_like(now, dtype=torch.bool)
    others[:-1] = (next_obs[:-1] != obs[1:]).any(-1)
    after = now.roll(-1, 0)
    after[others] = function(next_obs[others])
    return after


def normalizer_of(spec: Spec, normalize_observations: bool, remembered: int = 0) -> NoNorm:
    """The normalizer of observations: pixels are scaled, numbers normalized or as they are, as a memory always is."""
    numbers, parts = RunningNorm if normalize_observations else NoNorm, spec.observation_parts
    if spec.has_images and not spec.image:
        own: NoNorm = NormByPart((ScaleBytes if part.image else numbers)(part.size) for part in parts)
    else:
        own = (ScaleBytes if spec.image else numbers)(spec.observation_size)
    return NormByPart((own, NoNorm(remembered))) if remembered else own


def _policy(normalizer: NoNorm, net: nn.Module, spec: Spec, initial_log_std: float) -> Policy:
    action = spec.action
    if isinstance(action, Box):
        return GaussianPolicy(normalizer, net, action, initial_log_std)
    if isinstance(action, Discrete):
        return CategoricalPolicy(normalizer, net, action)
    if isinstance(action, MultiDiscrete):
        return MultiCategoricalPolicy(normalizer, net, action)
    return BernoulliPolicy(normalizer, net, action)


def _outputs(action: Action) -> int:
    """The number of parameters of a distribution over the actions."""
    if isinstance(action, Box):
        return action.size
    return sum(action.nvec) if isinstance(action, MultiDiscrete) else action.n


def encoder_of(spec: Spec) -> tuple[nn.Module, int]:
    """The module that turns a normalized observation into features, and their number."""
    if not spec.has_images:
        return nn.Identity(), spec.observation_size
    parts = spec.observation_parts
    encoder = ImageEncoder(parts[0].shape) if len(parts) == 1 else PartsEncoder(parts)
    return encoder, encoder.size


def network_of(
    spec: Spec,
    layers: Layers,
    outputs: int,
    last_gain: float,
    *,
    privileged: int = 0,
    actions: int = 0,
    policy: int = 0,
    remembers: bool = False,
) -> nn.Module:
    """A network from normalized observations, with an encoder before it where these are images.

    Behind the observation stand `privileged` numbers, and behind these `actions`. Of a critic, `policy` are the columns
    that a policy remembers, which it sees if it has no memory; `remembers` says whether it may have one.

    Raises:
        UserError: layers with a memory, for a network without.
    """
    encoder, features = encoder_of(spec)
    inputs, size = features + privileged, spec.observation_size
    if remembers and layers.remembers:
        cell = cell_of(layers, inputs, layers.hidden[-1] if actions else outputs)
        head = head_of(layers, cell, actions, outputs, last_gain)
        return Remembering(encoder, cell, head, (size, policy, privileged))
    if policy:
        net = replace(layers, kind="mlp").network(inputs + policy - 1 + actions, outputs, last_gain)
        return nn.Sequential(Columns(encoder, (size, 1)), net)
    net = layers.network(inputs + actions, outputs, last_gain)
    return nn.Sequential(encoder, net) if spec.has_images else net
