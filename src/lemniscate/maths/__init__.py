"""The mathematics: pure functions on tensors, each with its equation and a test against brute force."""

# ruff: noqa: F401  all that is imported here is offered

from lemniscate.maths.actions import clip_inward, coloured, ornstein_uhlenbeck, uniform
from lemniscate.maths.discrete import Bernoulli, Categorical, EpsilonGreedy, MultiCategorical
from lemniscate.maths.distributions import (
    Deterministic,
    Distribution,
    Gaussian,
    SquashedGaussian,
    mean_and_std,
    tanh,
)
from lemniscate.maths.losses import (
    clipped_surrogate,
    cross_entropy,
    hl_gauss,
    policy_gradient,
    surrogate,
    value_loss,
)
from lemniscate.maths.returns import (
    episode_return,
    gae,
    polyak,
    q_lambda,
    reward_to_go,
    soft_lambda_return,
    td_target,
)
from lemniscate.maths.stats import (
    clip_fraction,
    explained_by,
    explained_by_each,
    explained_variance,
    kl_k1,
    kl_k3,
    means,
    merge_moments,
    moments,
    ratio_statistics,
    standardize,
)
from lemniscate.maths.trust_region import backtrack, conjugate_gradient, fisher_product, natural_step

__all__ = sorted(name for name, value in vars().items() if callable(value))  # pyright: ignore[reportUnsupportedDunderAll]
