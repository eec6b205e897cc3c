import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lemniscate.maths import clipped_surrogate, value_loss


def f64(*x):
    return torch.tensor(x, dtype=torch.float64)


def test_the_course_policy_loss():
    ratio, advantage = f64(1.1, 1.3, 0.7, 0.9), f64(1, 0.5, -1, -0.5)
    assert clipped_surrogate(ratio.log(), advantage, 0.2).item() == pytest.approx(-0.1125, abs=1e-12)


def test_the_course_value_losses():
    new, target, old = f64(2.5, 1.5, 3, 4.5), f64(3, 1, 2, 5), f64(2, 1, 2.5, 4)
    assert value_loss(new, target).item() == pytest.approx(0.21875, abs=1e-12)
    assert value_loss(new, target, old, 0.2).item() == pytest.approx(0.31625, abs=1e-12)


@pytest.mark.parametrize(
    ("ratio", "advantage", "gradient_flows"),
    [
        (1.0, 1.0, True),
        (1.3, 1.0, False),  # good action already made likelier by more than the clip
        (0.7, 1.0, True),  # good action made rarer: always pulled back
        (0.7, -1.0, False),  # bad action already made rarer by more than the clip
        (1.3, -1.0, True),  # bad action made likelier: always pulled back
    ],
)
def test_the_five_cases_of_the_clip(ratio, advantage, gradient_flows):
    log_ratio = f64(ratio).log().requires_grad_()
    clipped_surrogate(log_ratio, f64(advantage), 0.2).backward()
    expected = -ratio * advantage if gradient_flows else 0.0
    assert log_ratio.grad.item() == pytest.approx(expected, abs=1e-12)


floats = st.lists(st.floats(-3, 3), min_size=1, max_size=8)


@given(floats, st.floats(0.05, 0.9))
def test_it_is_a_pessimistic_bound(values, clip):
    log_ratio = torch.tensor(values, dtype=torch.float64) / 3
    advantage = torch.linspace(-1, 1, len(values), dtype=torch.float64)
    unclipped = -(log_ratio.exp() * advantage).mean()
    assert clipped_surrogate(log_ratio, advantage, clip) >= unclipped - 1e-12


@given(floats)
def test_at_ratio_one_clipping_does_nothing_and_the_gradient_is_the_policy_gradient(values):
    advantage = torch.tensor(values, dtype=torch.float64)
    log_ratio = torch.zeros_like(advantage, requires_grad=True)
    loss = clipped_surrogate(log_ratio, advantage, 0.2)
    loss.backward()
    torch.testing.assert_close(loss.detach(), -advantage.mean())
    torch.testing.assert_close(log_ratio.grad, -advantage / len(advantage))


@given(floats)
def test_a_wide_value_clip_is_no_clip(values):
    value = torch.tensor(values, dtype=torch.float64)
    target = value.flip(0) + 0.5
    torch.testing.assert_close(value_loss(value, target, torch.zeros_like(value), 100.0), value_loss(value, target))


def test_a_clip_without_old_values_is_refused():
    with pytest.raises(ValueError, match="old_value"):
        value_loss(f64(1.0), f64(1.0), clip=0.2)
