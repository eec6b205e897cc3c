import pytest

from lemniscate.optim.adam import adapt_to_kl, linear


def test_the_learning_rate_falls_linearly_to_its_fraction():
    assert [linear(1e-3, 0.2, progress) for progress in (0.0, 0.5, 1.0, 2.0)] == pytest.approx([1e-3, 6e-4, 2e-4, 2e-4])


def test_the_learning_rate_adapts_to_the_kl():
    assert adapt_to_kl(1e-3, kl=0.05, desired_kl=0.02) == pytest.approx(1e-3 / 1.5)
    assert adapt_to_kl(1e-3, kl=0.03, desired_kl=0.02) == 1e-3
    assert adapt_to_kl(1e-3, kl=0.005, desired_kl=0.02) == pytest.approx(1.5e-3)
    assert adapt_to_kl(9e-3, kl=0.0, desired_kl=0.02) == 1e-2
    assert adapt_to_kl(1.1e-6, kl=1.0, desired_kl=0.02) == 1e-6
