"""What can be wrong, once: pure functions on tensors, each with its equation and its oracle in `tests/maths`."""

from lemniscate.maths.distributions import Bernoulli, Categorical, Distribution, Gaussian, MultiCategorical
from lemniscate.maths.losses import clipped_surrogate, value_loss
from lemniscate.maths.returns import gae
from lemniscate.maths.stats import (
    clip_fraction,
    explained_variance,
    kl_k1,
    kl_k3,
    merge_moments,
    standardize,
)

__all__ = [
    "Bernoulli",
    "Categorical",
    "Distribution",
    "Gaussian",
    "MultiCategorical",
    "clip_fraction",
    "clipped_surrogate",
    "explained_variance",
    "gae",
    "kl_k1",
    "kl_k3",
    "merge_moments",
    "standardize",
    "value_loss",
]
