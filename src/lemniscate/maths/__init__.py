"""The mathematics: pure functions on tensors, each with its equation and a test against brute force."""

from lemniscate.maths.discrete import Bernoulli, Categorical, EpsilonGreedy, MultiCategorical
from lemniscate.maths.distributions import (
    Deterministic,
    Distribution,
    Gaussian,
    SquashedGaussian,
    mean_and_std,
    tanh,
)
from lemniscate.maths.losses import clipped_surrogate, policy_gradient, surrogate, value_loss
from lemniscate.maths.noise import coloured, ornstein_uhlenbeck, uniform
from lemniscate.maths.returns import episode_return, gae, q_lambda, reward_to_go
from lemniscate.maths.stats import (
    clip_fraction,
    explained_by,
    explained_variance,
    kl_k1,
    kl_k3,
    means,
    merge_moments,
    moments,
    ratio_statistics,
    standardize,
)
from lemniscate.maths.targets import cross_entropy, hl_gauss, polyak, soft_lambda_return, td_target
from lemniscate.maths.trust_region import backtrack, conjugate_gradient, fisher_product, natural_step

__all__ = [
    "Bernoulli",
    "Categorical",
    "Deterministic",
    "Distribution",
    "EpsilonGreedy",
    "Gaussian",
    "MultiCategorical",
    "SquashedGaussian",
    "backtrack",
    "clip_fraction",
    "clipped_surrogate",
    "coloured",
    "conjugate_gradient",
    "cross_entropy",
    "episode_return",
    "explained_by",
    "explained_variance",
    "fisher_product",
    "gae",
    "hl_gauss",
    "kl_k1",
    "kl_k3",
    "mean_and_std",
    "means",
    "merge_moments",
    "moments",
    "natural_step",
    "ornstein_uhlenbeck",
    "policy_gradient",
    "polyak",
    "q_lambda",
    "ratio_statistics",
    "reward_to_go",
    "soft_lambda_return",
    "standardize",
    "surrogate",
    "tanh",
    "td_target",
    "uniform",
    "value_loss",
]
