"""Statistics over several seeds: Agarwal et al. 2021, arXiv:2108.13264.

Intervals are percentile bootstraps (section 4.1): seeds are drawn again with replacement, of each group on its own.
The random generator has a fixed seed, so the same scores give the same intervals.
"""

from collections.abc import Sequence

import numpy as np

RESAMPLES = 10_000


def iqm(scores: Sequence[float] | np.ndarray, axis: int = -1) -> np.ndarray:
    """Interquartile mean: the mean of the middle half, cut points weighted by the part of them that is inside."""
    ordered = np.sort(np.asarray(scores, dtype=np.float64), axis=axis)
    n = ordered.shape[axis]
    rank = np.arange(n)
    weight = np.clip(np.minimum(rank + 1, 0.75 * n) - np.maximum(rank, 0.25 * n), 0, None)
    return np.moveaxis(ordered, axis, -1) @ (weight / weight.sum())


def bootstrap_interval(scores: Sequence[float], resamples: int = RESAMPLES) -> tuple[float, float]:
    """95 % interval of the IQM over resampled seeds."""
    drawn = _drawn_again(np.asarray(scores, dtype=np.float64), np.random.default_rng(0), resamples)
    low, high = _percentiles(iqm(drawn))
    return float(low), float(high)


def mean_interval(curves: np.ndarray, resamples: int = 2_000) -> np.ndarray:
    """95 % interval of the mean over resampled seeds at each point of `curves` [seeds, points]: [2, points]."""
    means = _drawn_again(curves, np.random.default_rng(0), resamples).mean(axis=1)
    return _percentiles(means)


def probability_of_improvement(x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray) -> np.ndarray:
    """P(X > Y): the share of pairs, a run of x [..., n] and one of y [..., m], in which x is higher; a tie is half.

    1/(nm) Σᵢ Σⱼ S(xᵢ, yⱼ) with S = 1, ½, 0 for more, equal, less: the paper's probability of improvement on one task,
    which is the U statistic of Mann and Whitney 1947 over nm.
    """
    difference = np.asarray(x, dtype=np.float64)[..., :, None] - np.asarray(y, dtype=np.float64)[..., None, :]
    return (1 + np.sign(difference).mean(axis=(-2, -1))) / 2


def improvement_interval(x: Sequence[float], y: Sequence[float], resamples: int = RESAMPLES) -> tuple[float, float]:
    """95 % interval of P(X > Y) over resampled seeds of both."""
    rng = np.random.default_rng(0)
    drawn = [_drawn_again(np.asarray(scores, dtype=np.float64), rng, resamples) for scores in (x, y)]
    low, high = _percentiles(probability_of_improvement(*drawn))
    return float(low), float(high)


def _drawn_again(scores: np.ndarray, rng: np.random.Generator, resamples: int) -> np.ndarray:
    """[resamples, seeds, …]: as many seeds as there are, each drawn from all of them."""
    return rng.choice(scores, (resamples, len(scores)))


def _percentiles(resampled: np.ndarray) -> np.ndarray:
    """The ends of the middle 95 % of resampled values, along their first dimension."""
    return np.quantile(resampled, [0.025, 0.975], axis=0)
