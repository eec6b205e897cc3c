"""Policies. A policy returns a distribution over actions; what it remembers is part of the observation: `memory`."""

from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn

from lemniscate.maths import Bernoulli, Categorical, Distribution, EpsilonGreedy, Gaussian, MultiCategorical
from lemniscate.nn.memory import Carrier, Memory, remember
from lemniscate.nn.normalizer import NoNorm
from lemniscate.spec import Box, Discrete, MultiDiscrete


class Policy(nn.Module):
    """Base of all policies: `normalizer`, `net`, then `forward(obs [B, O]) -> Distribution`."""

    def __init__(self, normalizer: NoNorm, net: nn.Module) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.net = net
        self.memory: Memory | None = None
        """the columns of what it remembers, if it has a memory"""

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
        raise NotImplementedError

    def draw_noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """The random numbers that `Distribution.sample` needs for actions at observations [*shape, O]."""
        raise NotImplementedError

    def metrics(self) -> dict[str, Tensor]:
        """Extra metrics of the policy, each a scalar."""
        return {}

    def observe(self, obs: Tensor, valid: Tensor | None = None) -> None:
        """Update the statistics of the normalizer, if it has any, with observations [..., N, O] of training.

        `valid` [..., N] is False in rows to leave out.
        """
        self.normalizer.update(obs, valid)


class GaussianPolicy(Policy):
    """N(μ(s), σ²) in normalized action units, σ one learned number per coordinate, the same in every state."""

    def __init__(self, normalizer: NoNorm, net: nn.Module, action: Box, initial_log_std: float) -> None:
        super().__init__(normalizer, net)
        self.log_std = nn.Parameter(torch.full((action.size,), initial_log_std))

    def forward(self, obs: Tensor) -> Gaussian:
        """[B, O] to N(μ [B, A], σ [A])."""
        return Gaussian(self.net(self.normalizer(obs)), self.log_std)

    def draw_noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Standard normal, [*shape, A]."""
        return torch.randn(*shape, *self.log_std.shape, generator=generator, device=generator.device)

    def metrics(self) -> dict[str, Tensor]:
        """The mean of σ over coordinates."""
        return {"policy_std": self.log_std.detach().exp().mean()}


class CategoricalPolicy(Policy):
    """A softmax over n actions; those that the observation's mask rules out get probability zero."""

    def __init__(self, normalizer: NoNorm, net: nn.Module, action: Discrete) -> None:
        super().__init__(normalizer, net)
        self.action = action

    def forward(self, obs: Tensor) -> Categorical:
        """[B, O] to logits [B, n]."""
        return Categorical(_permitted(self.net(self.normalizer(obs)), obs, self.action))

    def draw_noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Uniform in [0, 1), [*shape]."""
        return torch.rand(*shape, generator=generator, device=generator.device)


class EpsilonGreedyPolicy(Policy):
    """Whose `net` is Q(s, ·): the best of n permitted actions, or with probability `epsilon` any of them."""

    epsilon: Tensor
    """ε, a scalar; 1 at first, and saved with the policy"""

    def __init__(self, normalizer: NoNorm, net: nn.Module, action: Discrete) -> None:
        super().__init__(normalizer, net)
        self.action = action
        self.register_buffer("epsilon", torch.ones(()))

    def forward(self, obs: Tensor) -> EpsilonGreedy:
        """[B, O] to Q(s, ·), [B, n], with −10⁹ for actions that are not permitted."""
        return EpsilonGreedy(_permitted(self.net(self.normalizer(obs)), obs, self.action), self.epsilon)

    draw_noise = CategoricalPolicy.draw_noise

    def metrics(self) -> dict[str, Tensor]:
        """ε."""
        return {"epsilon": self.epsilon.clone()}


class MultiCategoricalPolicy(Policy):
    """K independent softmaxes over n_k actions each; those that the mask rules out get probability zero."""

    def __init__(self, normalizer: NoNorm, net: nn.Module, action: MultiDiscrete) -> None:
        super().__init__(normalizer, net)
        self.action = action

    def forward(self, obs: Tensor) -> MultiCategorical:
        """[B, O] to logits [B, n_k] for each of K."""
        logits = _permitted(self.net(self.normalizer(obs)), obs, self.action).split(self.action.nvec, dim=-1)
        return MultiCategorical(tuple(Categorical(part) for part in logits))

    def draw_noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Uniform in [0, 1), [*shape, K]."""
        return torch.rand(*shape, len(self.action.nvec), generator=generator, device=generator.device)


def _permitted(logits: Tensor, obs: Tensor, action: Discrete | MultiDiscrete) -> Tensor:
    """The logits [B, n], those of actions that the mask at the end of `obs` rules out at −10⁹."""
    return logits.masked_fill(obs[..., -action.mask_size :] == 0, -1e9) if action.masked else logits


class BernoulliPolicy(Policy):
    """n independent binary components."""

    def __init__(self, normalizer: NoNorm, net: nn.Module, n: int) -> None:
        super().__init__(normalizer, net)
        self.n = n

    def forward(self, obs: Tensor) -> Bernoulli:
        """[B, O] to logits [B, n]."""
        return Bernoulli(self.net(self.normalizer(obs)))

    def draw_noise(self, shape: Sequence[int], generator: Generator) -> Tensor:
        """Uniform in [0, 1), [*shape, n]."""
        return torch.rand(*shape, self.n, generator=generator, device=generator.device)
