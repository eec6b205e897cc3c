"""Policies. A policy returns a distribution over actions; what it remembers is part of the observation: `memory`."""

import math
from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn

from lemniscate.maths import (
    Bernoulli,
    Categorical,
    Deterministic,
    Distribution,
    EpsilonGreedy,
    Gaussian,
    MultiCategorical,
    SquashedGaussian,
)
from lemniscate.nn.memory import Carrier, Memory, remember
from lemniscate.nn.normalizer import NoNorm
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, action_shape

SAC_LOG_STD = -1.5
"""log σ of SAC's policy, before its tanh, as it begins"""


class Policy(nn.Module):
    """Base of all policies: `normalizer`, `net`, and `distribution_of` its outputs, over an `action`."""

    def __init__(self, normalizer: NoNorm, net: nn.Module, action: Action) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net
        self.action = action
        self.memory: Memory | None = None
        """the columns of what it remembers, if it has a memory"""
        self._draw = torch.randn if isinstance(action, Box) else torch.rand
        self._shape = action_shape(action)

    def remember(self, obs: Tensor) -> Tensor:
        """The memory of a policy that has one after rows [N, …], as the columns of that memory."""
        return remember(self.net, self.normalizer(obs))

    def carrier(self) -> Carrier | None:
        """The carrier of its memory from step to step, if it has one."""
        return Carrier(self.memory, self.remember) if self.memory else None

    def act(self, obs: Tensor, noise: Tensor) -> Tensor:
        """An action at each observation [B, O], drawn with the random numbers `noise` of `draw_noise`."""
        return self(obs).sample(noise)

    def forward(self, obs: Tensor) -> Distribution:
        """The distribution over actions at each observation, [B, O]."""
        return self.distribution_of(self.net(self.normalizer(obs)), obs)

    def distribution_of(self, outputs: Tensor, obs: Tensor) -> Distribution:
        """The distribution that the network's outputs [B, …] at observations [B, O] say."""
        raise NotImplementedError

    def draw_noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """The random numbers that `Distribution.sample` needs for actions at observations [*shape, O].

        One for each number of an action: standard normal for a continuous one, else uniform in [0, 1).
        """
        return self._draw(*shape, *self._shape, generator=generator, device=generator.device)

    def metrics(self) -> dict[str, Tensor]:
        """Extra metrics of the policy, each a scalar."""
        return {}

    def observe(self, obs: Tensor, valid: Tensor | None = None) -> None:
        """Update the statistics of the normalizer, if it has any, with observations [..., N, O] of training.

        `valid` [..., N] is False in rows to leave out.
        """
        self.normalizer.update(obs, valid)

    def _permitted(self, outputs: Tensor, obs: Tensor) -> Tensor:
        """The network's outputs, those of actions that the mask at the end of `obs` rules out at −10⁹."""
        size = self.action.mask_size
        return outputs.masked_fill(obs[..., -size:] == 0, -1e9) if size else outputs


class GaussianPolicy(Policy):
    """N(μ(s), σ²) in normalized action units, σ one learned number per coordinate, the same in every state."""

    def __init__(self, normalizer: NoNorm, net: nn.Module, action: Box, initial_log_std: float) -> None:
        super().__init__(normalizer, net, action)
        self.log_std = nn.Parameter(torch.full((action.size,), initial_log_std))

    def distribution_of(self, outputs: Tensor, obs: Tensor) -> Gaussian:
        """N(μ [B, A], σ [A])."""
        return Gaussian(outputs, self.log_std)

    def metrics(self) -> dict[str, Tensor]:
        """The mean of σ over coordinates."""
        return {"policy_std": self.log_std.detach().exp().mean()}


class CategoricalPolicy(Policy):
    """A softmax over n actions; those that the observation's mask rules out get probability zero."""

    def distribution_of(self, outputs: Tensor, obs: Tensor) -> Categorical:
        """By logits [B, n]."""
        return Categorical(self._permitted(outputs, obs))


class EpsilonGreedyPolicy(Policy):
    """Whose `net` is Q(s, ·): the best of n permitted actions, or with probability `epsilon` any of them."""

    epsilon: Tensor
    """ε, a scalar; 1 at first, and saved with the policy"""

    def __init__(self, normalizer: NoNorm, net: nn.Module, action: Discrete) -> None:
        super().__init__(normalizer, net, action)
        self.register_buffer("epsilon", torch.ones(()))

    def distribution_of(self, outputs: Tensor, obs: Tensor) -> EpsilonGreedy:
        """By Q(s, ·), [B, n], with −10⁹ for actions that are not permitted."""
        return EpsilonGreedy(self._permitted(outputs, obs), self.epsilon)

    def metrics(self) -> dict[str, Tensor]:
        """ε."""
        return {"epsilon": self.epsilon.clone()}


class MultiCategoricalPolicy(Policy):
    """K independent softmaxes over n_k actions each; those that the mask rules out get probability zero."""

    action: MultiDiscrete

    def distribution_of(self, outputs: Tensor, obs: Tensor) -> MultiCategorical:
        """By logits [B, n_k] for each of K."""
        return MultiCategorical(tuple(map(Categorical, self._permitted(outputs, obs).split(self.action.nvec, dim=-1))))


class BernoulliPolicy(Policy):
    """n independent binary components."""

    def distribution_of(self, outputs: Tensor, obs: Tensor) -> Bernoulli:
        """By logits [B, n]."""
        return Bernoulli(outputs)


class DeterministicPolicy(Policy):
    """One action at each observation, tanh of a network: in [-1, 1]^A, which the backend maps onto the bounds."""

    def distribution_of(self, outputs: Tensor, obs: Tensor) -> Deterministic:
        """[B, A]."""
        return Deterministic(torch.tanh(outputs))

    def draw_noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Zeros, [*shape, A]: the policy has no randomness of its own."""
        return torch.zeros(*shape, *self._shape, device=generator.device)


class SquashedGaussianPolicy(Policy):
    """tanh(u), u ~ N(μ(s), σ(s)²); log σ is kept in [-5, 2], softly, as tanh moves from one end to the other.

    Args:
        normalizer: of observations.
        net: from normalized observations to μ and what log σ is made of, [B, 2 A].
        action: of A coordinates.
        initial_log_std: log σ, inside (-5, 2), where the network says 0, as it does at first.
    """

    def __init__(self, normalizer: NoNorm, net: nn.Module, action: Box, initial_log_std: float = SAC_LOG_STD) -> None:
        super().__init__(normalizer, net, action)
        self._offset = math.atanh((initial_log_std + 5) / 3.5 - 1)

    def distribution_of(self, outputs: Tensor, obs: Tensor) -> SquashedGaussian:
        """By μ and log σ, [B, A] each."""
        mean, log_std = outputs.chunk(2, dim=-1)
        return SquashedGaussian(mean, -5 + 3.5 * (torch.tanh(log_std + self._offset) + 1))
