"""Policies and values. A policy returns a distribution and remembers nothing."""

from collections.abc import Callable, Sequence

import torch
from torch import Generator, Tensor, nn

from lemniscate.maths import Bernoulli, Categorical, Distribution, Gaussian, MultiCategorical
from lemniscate.nn.native import Native
from lemniscate.nn.networks import Activation, ImageEncoder, mlp
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


class Value(nn.Module):
    """V(s). It looks through the policy's normalizer, and does not own it."""

    def __init__(self, normalizer: Observed, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net

    def forward(self, obs: Tensor) -> Tensor:
        """[…, O] to […]."""
        return self.net(self.normalizer(obs)).squeeze(-1)


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
        size = spec.observation_size
        kind = Pixels if spec.image else RunningNorm if normalize_observations else Observed
        self.policy = _policy(kind(size), spec, hidden, activation, initial_log_std)
        self.value = Value(self.policy.normalizer, _network(spec, hidden, activation, 1, last_gain=1.0))


def _policy(
    normalizer: Observed, spec: Spec, hidden: Sequence[int], activation: Activation, initial_log_std: float
) -> Policy:
    action = spec.action
    net = _network(spec, hidden, activation, _outputs(action), last_gain=0.01)
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


def _network(
    spec: Spec, hidden: Sequence[int], activation: Activation, outputs: int, last_gain: float
) -> nn.Sequential:
    if not spec.image:
        return mlp((spec.observation_size, *hidden, outputs), activation, last_gain)
    height, width, channels = spec.layout[0].shape
    encoder = ImageEncoder((height, width, channels))
    return nn.Sequential(encoder, mlp((encoder.size, *hidden, outputs), activation, last_gain))
