"""Statistics over seeds: scipy is the oracle where it has the same, counting by hand elsewhere."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, trim_mean

from lemniscate.report.seeds import interval, iqm, probability_of_improvement


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
        low, high = interval(iqm, rng.normal(5, 1, 20), resamples=300)
        hits += low <= 5 <= high
    assert 170 <= hits <= 199


def test_the_same_scores_give_the_same_interval():
    assert (interval(iqm, [1.0, 2.0, 4.0]) == interval(iqm, [1.0, 2.0, 4.0])).all()


@pytest.mark.parametrize(("n", "m"), [(1, 1), (5, 5), (3, 7)])
def test_the_probability_of_improvement_is_a_count_over_all_pairs(n, m):
    rng = np.random.default_rng(n)
    x, y = rng.integers(0, 5, n), rng.integers(0, 5, m)
    wins = sum(1.0 if a > b else 0.5 if a == b else 0.0 for a in x for b in y)
    assert probability_of_improvement(x, y) == pytest.approx(wins / (n * m))
    assert probability_of_improvement(x, y) == pytest.approx(mannwhitneyu(x, y).statistic / (n * m))
    assert probability_of_improvement(x, y) + probability_of_improvement(y, x) == pytest.approx(1)


def test_equal_scores_improve_on_each_other_half_the_time():
    assert probability_of_improvement([1.0, 1.0, 1.0], [1.0, 1.0]) == 0.5
    assert tuple(interval(probability_of_improvement, [1.0, 1.0, 1.0], [1.0, 1.0])) == (0.5, 0.5)


def test_the_interval_of_an_improvement_is_that_of_seeds_drawn_one_by_one():
    x, y = [3.0, 5.0, 9.0, 4.0], [2.0, 4.0, 6.0]
    rng = np.random.default_rng(1)
    drawn = [probability_of_improvement(rng.choice(x, 4), rng.choice(y, 3)) for _ in range(4000)]
    assert interval(probability_of_improvement, x, y) == pytest.approx(np.quantile(drawn, [0.025, 0.975]), abs=0.05)
    assert tuple(interval(probability_of_improvement, [9.0, 8.0], [1.0, 2.0])) == (1.0, 1.0)


def test_the_band_of_a_mean_is_drawn_over_seeds_and_not_over_points():
    """Where all seeds agree it has no width, wherever they disagree the width that their means have."""
    seeds = np.random.default_rng(0).normal(0, 1, 30)
    low, high = interval(lambda drawn: drawn.mean(axis=1), np.stack([np.zeros(30), seeds], axis=1), resamples=2_000)
    assert (low[0], high[0]) == (0, 0)
    half = 1.96 * seeds.std() / np.sqrt(30)
    assert (low[1], high[1]) == pytest.approx((seeds.mean() - half, seeds.mean() + half), abs=0.05)
