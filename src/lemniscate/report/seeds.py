"""What several seeds say together: Agarwal et al. 2021, arXiv:2108.13264."""

from collections.abc import Sequence

import numpy as np


def iqm(scores: Sequence[float] | np.ndarray, axis: int = -1) -> np.ndarray:
    """Interquartile mean: the mean of the middle half, cut points weighted by the part of them that is inside."""
    ordered = np.sort(np.asarray(scores, dtype=np.float64), axis=axis)
    n = ordered.shape[axis]
    rank = np.arange(n)
    weight = np.clip(np.minimum(rank + 1, 0.75 * n) - np.maximum(rank, 0.25 * n), 0, None)
    return np.moveaxis(ordered, axis, -1) @ (weight / weight.sum())


def bootstrap_interval(
    scores: Sequence[float], confidence: float = 0.95, resamples: int = 10_000
) -> tuple[float, float]:
    """Percentile interval of the IQM over resampled seeds; always the same for the same scores."""
    rng = np.random.default_rng(0)
    drawn = rng.choice(np.asarray(scores, dtype=np.float64), (resamples, len(scores)))
    low, high = np.quantile(iqm(drawn), [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)
