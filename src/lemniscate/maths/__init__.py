"""What can be wrong, once: pure functions on tensors, each with its equation and its oracle in `tests/maths`."""

from lemniscate.maths.distributions import (
    Bernoulli,
    Categorical,
    Distribution,
    Gaussian,
    MultiCategorical,
    Point,
    SquashedGaussian,
)
from lemniscate.maths.losses import clipped_surrogate, value_loss
from lemniscate.maths.noise import coloured, ornstein_uhlenbeck, uniform
from lemniscate.maths.returns import gae, polyak, td_target
from lemniscate.maths.schedules import adapt_to_kl, linear
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

__all__ = [
    "Bernoulli",
    "Categorical",
    "Distribution",
    "Gaussian",
    "MultiCategorical",
    "Point",
    "SquashedGaussian",
    "adapt_to_kl",
    "clip_fraction",
    "clipped_surrogate",
    "coloured",
    "explained_variance",
    "gae",
    "kl_k1",
    "kl_k3",
    "linear",
    "means",
    "merge_moments",
    "ornstein_uhlenbeck",
    "polyak",
    "ratio_statistics",
    "standardize",
    "td_target",
    "uniform",
    "value_loss",
]
