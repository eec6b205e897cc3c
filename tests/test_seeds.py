"""Statistics over seeds: scipy's trimmed mean is the oracle where it is defined."""

import numpy as np
import pytest
from scipy.stats import trim_mean

from lemniscate.report.seeds import bootstrap_interval, iqm


@pytest.mark.parametrize("n", [4, 8, 20])
def test_the_interquartile_mean_is_the_trimmed_mean_where_quarters_are_whole(n):
    scores = np.random.default_rng(n).normal(size=n)
    assert iqm(scores) == pytest.approx(trim_mean(scores, 0.25))


def test_where_they_are_not_the_cut_scores_count_in_part():
    assert iqm([7.0]) == 7.0
    assert iqm([1.0, 3.0]) == 2.0
    assert iqm([0.0, 10.0, 100.0]) == pytest.approx((0 * 0.25 + 10 * 1 + 100 * 0.25) / 1.5)
    assert iqm([5.0, 1.0, 2.0, 4.0, 3.0]) == pytest.approx((2 * 0.75 + 3 + 4 * 0.75) / 2.5)


def test_an_outlier_does_not_move_it():
    assert iqm([1.0, 2.0, 3.0, 4.0, -1e9]) == iqm([1.0, 2.0, 3.0, 4.0, -1.0])


def test_the_interval_holds_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = bootstrap_interval(rng.normal(5, 1, 20), resamples=300)
        hits += low <= 5 <= high
    assert 170 <= hits <= 199


def test_the_same_scores_give_the_same_interval():
    assert bootstrap_interval([1.0, 2.0, 4.0]) == bootstrap_interval([1.0, 2.0, 4.0])
