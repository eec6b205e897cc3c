"""The checker's error rates over the zoo: no false alarm, few misses, most causes named. Training loops are long."""

from collections import Counter  # noqa: I001

import pytest

import checker
from lemniscate import course


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # broken off within a callback of gc
@pytest.mark.parametrize(
    "exercise", [name if name != "train" else pytest.param(name, marks=pytest.mark.long) for name in course.EXERCISES]
)
@pytest.mark.one_in(16)
def test_right_solutions_pass_and_wrong_ones_do_not(exercise, monkeypatch):
    monkeypatch.setattr("lemniscate.course.exercise.LIMIT", 3.0)  # some of them never end
    results = checker.zoo(exercise)
    assert [each for each in results if "false alarm" in each.counts] == []
    count = Counter(column for each in results for column in each.counts)
    assert count["right"] >= 4
    assert count["wrong"] >= 12
    assert count["miss"] <= max(1, 0.04 * count["wrong"]), [each for each in results if "miss" in each.counts]
    assert count["named"] >= 0.8 * (count["wrong"] - count["miss"])
