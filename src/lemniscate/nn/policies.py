"""Policies and values. A policy returns a distribution and remembers nothing."""

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any, Self

import torch
from torch import Generator, Tensor, nn

from lemniscate.errors import UserError
from lemniscate.maths import Bernoulli, Categorical, Distribution, Gaussian, MultiCategorical, Point, SquashedGaussian
from lemniscate.nn.native import Native
from lemniscate.nn.networks import Activation, Architecture, ImageEncoder, network
from lemniscate.nn.normalizer import Observed, Pixels, RunningNorm
from lemniscate.types import Action, Box, Discrete, MultiDiscrete, Spec


class Policy(nn.Module):
    """Base of all policies: `normalizer`, `net`, then `forward(obs [B, O]) -> Distribution`."""

    def __init__(self, normalizer: Observed, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net
        self._act: Callable[[Tensor, Tensor], Tensor] = self._sample

    def act(self, obs: Tensor, noise: Tensor) -> Tensor:
        """An action at each observation [B, O], drawn with `noise`; once native, B is always the same."""
        return self._act(obs, noise)

    def make_native(self) -> None:
        """From the next action on, `act` is one native call."""
        self._act = Native(self._sample, self._sample, next(self.parameters()).device)

    def _sample(self, obs: Tensor, noise: Tensor) -> Tensor:
        return self(obs).sample(noise)

    def forward(self, obs: Tensor) -> Distribution:
        """The distribution over actions at each observation, [B, O]."""
        raise NotImplementedError

    def noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """What `Distribution.sample` needs for actions at observations [*shape, O]."""
        raise NotImplementedError

    def watch(self) -> dict[str, Tensor]:
        """What is worth a curve, by its usual name."""
        return {}

    def observe(self, obs: Tensor) -> None:
        """Take [B, O] training observations into the normalizer's statistics, if there is one."""
        if isinstance(self.normalizer, RunningNorm):
            self.normalizer.update(obs)


class GaussianPolicy(Policy):
    """N(μ(s), σ²) in normalized action units, σ one learned number per coordinate, the same in every state."""

    def __init__(self, normalizer: Observed, net: nn.Module, action: Box, initial_log_std: float) -> None:
        super().__init__(normalizer, net)
        self.log_std = nn.Parameter(torch.full((action.size,), initial_log_std))

    def forward(self, obs: Tensor) -> Gaussian:
        """[B, O] to N(μ [B, A], σ [A])."""
        return Gaussian(self.net(self.normalizer(obs)), self.log_std)

    def noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Standard normal, [*shape, A]."""
        return torch.randn(*shape, *self.log_std.shape, generator=generator, device=generator.device)

    def watch(self) -> dict[str, Tensor]:
        """The mean of σ over coordinates."""
        return {"policy_std": self.log_std.detach().exp().mean()}


class CategoricalPolicy(Policy):
    """A softmax over n actions; those that the observation's mask rules out get probability zero."""

    def __init__(self, normalizer: Observed, net: nn.Module, action: Discrete) -> None:
        super().__init__(normalizer, net)
        self.action = action

    def forward(self, obs: Tensor) -> Categorical:
        """[B, O] to logits [B, n]."""
        logits = self.net(self.normalizer(obs))
        if self.action.masked:
            logits = logits.masked_fill(obs[..., -self.action.n :] == 0, -1e9)
        return Categorical(logits)

    def noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Uniform in [0, 1), [*shape]."""
        return torch.rand(*shape, generator=generator, device=generator.device)


class MultiCategoricalPolicy(Policy):
    """K independent softmaxes over n_k actions each."""

    def __init__(self, normalizer: Observed, net: nn.Module, action: MultiDiscrete) -> None:
        super().__init__(normalizer, net)
        self.action = action

    def forward(self, obs: Tensor) -> MultiCategorical:
        """[B, O] to logits [B, n_k] for each of K."""
        logits = self.net(self.normalizer(obs)).split(self.action.nvec, dim=-1)
        return MultiCategorical(tuple(Categorical(part) for part in logits))

    def noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Uniform in [0, 1), [*shape, K]."""
        return torch.rand(*shape, len(self.action.nvec), generator=generator, device=generator.device)


class BernoulliPolicy(Policy):
    """n independent switches."""

    def __init__(self, normalizer: Observed, net: nn.Module, n: int) -> None:
        super().__init__(normalizer, net)
        self.n = n

    def forward(self, obs: Tensor) -> Bernoulli:
        """[B, O] to logits [B, n]."""
        return Bernoulli(self.net(self.normalizer(obs)))

    def noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Uniform in [0, 1), [*shape, n]."""
        return torch.rand(*shape, self.n, generator=generator, device=generator.device)


class DeterministicPolicy(Policy):
    """One action at each observation, tanh of a network: in [-1, 1]^A, which the env floor maps onto its bounds."""

    def __init__(self, normalizer: Observed, net: nn.Module, size: int) -> None:
        super().__init__(normalizer, net)
        self.size = size

    def forward(self, obs: Tensor) -> Point:
        """[B, O] to [B, A]."""
        return Point(torch.tanh(self.net(self.normalizer(obs))))

    def noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """It has none of its own: zeros, [*shape, A]."""
        return torch.zeros(*shape, self.size, device=generator.device)


class SquashedGaussianPolicy(Policy):
    """tanh(u), u ~ N(μ(s), σ(s)²); log σ is kept in [-5, 2], softly, as tanh moves from one end to the other."""

    def __init__(self, normalizer: Observed, net: nn.Module, size: int) -> None:
        super().__init__(normalizer, net)
        self.size = size

    def forward(self, obs: Tensor) -> SquashedGaussian:
        """[B, O] to μ and log σ, [B, A] each."""
        mean, log_std = self.net(self.normalizer(obs)).chunk(2, dim=-1)
        return SquashedGaussian(mean, -5 + 3.5 * (torch.tanh(log_std) + 1))

    def noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Standard normal, [*shape, A]."""
        return torch.randn(*shape, self.size, generator=generator, device=generator.device)


class Value(nn.Module):
    """V(s). It looks through the policy's normalizer, and does not own it."""

    def __init__(self, normalizer: Observed, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O] to […]."""
        return self.net(self.normalizer(obs)).squeeze(-1)


class QValue(nn.Module):
    """Q(s, a). It looks through the policy's normalizer, and does not own it."""

    def __init__(self, normalizer: Observed, encoder: nn.Module, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.encoder = encoder
        self.net = net

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O] and […, A] to […]."""
        seen = self.encoder(self.normalizer(obs))
        return self.net(torch.cat([seen, action], dim=-1)).squeeze(-1)


class TwinQ(nn.Module):
    """Two Q-values that never see each other: Fujimoto et al. 2018, arXiv:1802.09477, section 4.2."""

    def __init__(self, one: QValue, two: QValue) -> None:
        super().__init__()
        self.one, self.two = one, two

    def forward(self, obs: Tensor, action: Tensor) -> Tensor:
        """[…, O] and […, A] to [2, …]."""
        return torch.stack([self.one(obs, action), self.two(obs, action)])


class ActorCritic(nn.Module):
    """A policy and a value for the spaces in `spec`: two separate networks behind one normalizer."""

    def __init__(
        self,
        spec: Spec,
        hidden: Sequence[int] = (64, 64),
        activation: Activation = "tanh",
        initial_log_std: float = 0.0,
        normalize_observations: bool = False,
    ) -> None:
        super().__init__()
        self.policy = _policy(_normalizer(spec, normalize_observations), spec, hidden, activation, initial_log_std)
        self.value = Value(self.policy.normalizer, _from_obs(spec, hidden, activation, 1, last_gain=1.0))


class Temperature(nn.Module):
    """SAC's α, the price of entropy; log α is what is learned."""

    def __init__(self, initial: float) -> None:
        super().__init__()
        self.log = nn.Parameter(torch.tensor(math.log(initial)))

    def forward(self) -> Tensor:
        """α, a scalar."""
        return self.log.exp()


def bounded_box(spec: Spec) -> Box:
    """The actions of `spec`. Raises `UserError` unless they are numbers between finite bounds."""
    action = spec.action
    if not isinstance(action, Box):
        kind = type(action).__name__
        raise UserError(f"{spec.env_id} has {kind} actions; ddpg, td3 and sac need continuous ones. ppo learns here.")
    if not all(map(math.isfinite, (*action.low, *action.high))):
        raise UserError(
            f"{spec.env_id} has actions without bounds; ddpg, td3 and sac explore between bounds, such as those that"
            " gymnasium.wrappers.RescaleAction or ClipAction's Box sets. ppo learns here."
        )
    return action


class ActorQ(nn.Module):
    """A policy over continuous actions and its Q-value, or two of them: separate networks behind one normalizer.

    With a `temperature` the policy is random, and α, its price of entropy, is learned from there on.
    """

    def __init__(
        self,
        spec: Spec,
        hidden: Sequence[int],
        critic_hidden: Sequence[int],
        activation: Activation,
        architecture: Architecture,
        normalize_observations: bool,
        *,
        twin: bool,
        temperature: float | None = None,
    ) -> None:
        super().__init__()
        stochastic = temperature is not None
        size = bounded_box(spec).size
        normalizer = _normalizer(spec, normalize_observations)
        net = _from_obs(spec, hidden, activation, 2 * size if stochastic else size, 0.01, architecture)
        kind = SquashedGaussianPolicy if stochastic else DeterministicPolicy
        self.policy: Policy = kind(normalizer, net, size)

        def value() -> QValue:
            encoder, seen = _encoder(spec)
            net = network(architecture, (seen + size, *critic_hidden, 1), activation, last_gain=1.0)
            return QValue(normalizer, encoder, net)

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


def _normalizer(spec: Spec, normalize_observations: bool) -> Observed:
    kind = Pixels if spec.image else RunningNorm if normalize_observations else Observed
    return kind(spec.observation_size)


def _policy(
    normalizer: Observed, spec: Spec, hidden: Sequence[int], activation: Activation, initial_log_std: float
) -> Policy:
    action = spec.action
    net = _from_obs(spec, hidden, activation, _outputs(action), last_gain=0.01)
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
    height, width, channels = spec.layout[0].shape
    encoder = ImageEncoder((height, width, channels))
    return encoder, encoder.size


def _from_obs(
    spec: Spec,
    hidden: Sequence[int],
    activation: Activation,
    outputs: int,
    last_gain: float,
    kind: Architecture = "mlp",
) -> nn.Sequential:
    encoder, size = _encoder(spec)
    layers = network(kind, (size, *hidden, outputs), activation, last_gain)
    return nn.Sequential(encoder, layers) if spec.image else layers
