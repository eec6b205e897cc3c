"""A policy for the spaces of an environment, and V(s): separate networks behind one normalizer; or Q alone."""

from torch import Tensor, nn

from lemniscate.errors import UserError
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


class Value(nn.Module):
    """V(s), behind the policy's observation normalizer; it sees the P = `privileged` numbers too, as they are."""

    def __init__(self, normalizer: NoNorm, net: nn.Module, privileged: int = 0) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net
        self.privileged = privileged

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O + P] to […]."""
        seen = with_privileged(self.normalizer(obs), obs, self.normalizer.size, self.privileged)
        return self.net(seen).squeeze(-1)


class ActorCritic(nn.Module):
    """A policy for any actions, and V(s), with `critic_layers` if they are not as those of the policy."""

    def __init__(
        self,
        spec: Spec,
        layers: Layers,
        initial_log_std: float = 0.0,
        normalize_observations: bool = False,
        *,
        critic_layers: Layers | None = None,
    ) -> None:
        super().__init__()
        self.policy = _policy(normalizer_of(spec, normalize_observations), spec, layers, initial_log_std)
        net = network_of(spec, critic_layers or layers, 1, last_gain=1.0, more=spec.privileged)
        self.value = Value(self.policy.normalizer, net, spec.privileged)

    def estimates(self, obs: Tensor, next_obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """V(s), V(s') and log π(a|s) of rows […, …], […] each."""
        return self.value(obs), self.value(next_obs), self.policy(obs).log_prob(action)


class ActionValues(nn.Module):
    """An ε-greedy policy; its network is Q(s, ·).

    Raises:
        UserError: actions of another kind than Discrete.
    """

    def __init__(self, spec: Spec, layers: Layers, normalize_observations: bool) -> None:
        super().__init__()
        if not isinstance(spec.action, Discrete):
            kind = type(spec.action).__name__
            raise UserError(f"{spec.env_id} has actions of kind {kind}; Q has an output for each one of n, Discrete.")
        net = network_of(spec, layers, spec.action.n, last_gain=0.01)
        self.policy = EpsilonGreedyPolicy(normalizer_of(spec, normalize_observations), net, spec.action)

    def q(self, obs: Tensor, action: Tensor) -> Tensor:
        """Q(s, a) of rows […, O] and […], […]."""
        return self.policy(obs).values.gather(-1, action.unsqueeze(-1)).squeeze(-1)

    def estimates(self, obs: Tensor, next_obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Q(s, a) and max_a Q(s', a) of rows […, O], […, O] and […], […] each."""
        return self.q(obs, action), self.policy(next_obs).values.amax(-1)


def normalizer_of(spec: Spec, normalize_observations: bool) -> NoNorm:
    """The normalizer of observations: pixels are scaled, numbers normalized or as they are."""
    numbers, parts = RunningNorm if normalize_observations else NoNorm, spec.observation_parts
    if spec.has_images and not spec.image:
        return NormByPart((ScaleBytes if part.image else numbers)(part.size) for part in parts)
    return (ScaleBytes if spec.image else numbers)(spec.observation_size)


def _policy(normalizer: NoNorm, spec: Spec, layers: Layers, initial_log_std: float) -> Policy:
    action = spec.action
    net = network_of(spec, layers, _outputs(action), last_gain=0.01)
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


def encoder_of(spec: Spec) -> tuple[nn.Module, int]:
    """The module that turns a normalized observation into features, and their number."""
    if not spec.has_images:
        return nn.Identity(), spec.observation_size
    parts = spec.observation_parts
    encoder = ImageEncoder(parts[0].shape) if len(parts) == 1 else PartsEncoder(parts)
    return encoder, encoder.size


def network_of(spec: Spec, layers: Layers, outputs: int, last_gain: float, more: int = 0) -> nn.Module:
    """A network from normalized observations, with an encoder before it where these are images, and `more` inputs."""
    encoder, features = encoder_of(spec)
    net = layers.network(features + more, outputs, last_gain)
    return nn.Sequential(encoder, net) if spec.has_images else net
