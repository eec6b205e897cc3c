"""The mathematics: pure functions on tensors, each with its equation and a test against brute force."""

from lemniscate.maths.discrete import Bernoulli, Categorical, MultiCategorical
from lemniscate.maths.distributions import Deterministic, Distribution, Gaussian, SquashedGaussian
from lemniscate.maths.losses import clipped_surrogate, policy_gradient, surrogate, value_loss
from lemniscate.maths.noise import coloured, ornstein_uhlenbeck, uniform
from lemniscate.maths.returns import episode_return, gae, polyak, reward_to_go, td_target
from lemniscate.maths.stats import (
    clip_fraction,
    explained_variance,
    kl_k1,
    kl_k3,
    means,
    merge_moments,
    ratio_statistics,
    standardize,
)
from lemniscate.maths.trust_region import backtrack, conjugate_gradient, fisher_product, natural_step

__all__ = [
    "Bernoulli",
    "Categorical",
    "Deterministic",
    "Distribution",
    "Gaussian",
    "MultiCategorical",
    "SquashedGaussian",
    "backtrack",
    "clip_fraction",
    "clipped_surrogate",
    "coloured",
    "conjugate_gradient",
    "episode_return",
    "explained_variance",
    "fisher_product",
    "gae",
    "kl_k1",
    "kl_k3",
    "means",
    "merge_moments",
    "natural_step",
    "ornstein_uhlenbeck",
    "policy_gradient",
    "polyak",
    "ratio_statistics",
    "reward_to_go",
    "standardize",
    "surrogate",
    "td_target",
    "uniform",
    "value_loss",
]
