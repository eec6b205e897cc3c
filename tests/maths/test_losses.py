import inspect
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lemniscate import maths
from lemniscate.maths import Categorical, clipped_surrogate, policy_gradient, surrogate, value_loss


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


@given(floats)
def test_the_surrogate_is_the_mean_of_ratio_times_advantage_and_at_ratio_one_the_policy_gradient(values):
    advantage = torch.tensor(values, dtype=torch.float64)
    far = torch.linspace(-1, 1, len(values), dtype=torch.float64)
    assert surrogate(far, advantage).item() == pytest.approx(
        -sum(math.exp(x) * a for x, a in zip(far.tolist(), values, strict=True)) / len(values)
    )
    log_ratio, log_prob = (torch.zeros_like(advantage, requires_grad=True) for _ in range(2))
    surrogate(log_ratio, advantage).backward()
    policy_gradient(log_prob, advantage).backward()
    torch.testing.assert_close(log_ratio.grad, log_prob.grad)
    torch.testing.assert_close(log_prob.grad, -advantage / len(values))


BANDIT = torch.tensor([0.3, -0.5, 1.1], dtype=torch.float64)
PAYS = torch.tensor([10.0, 11.0, 12.5], dtype=torch.float64)


def gradients(baseline, samples=4000, batch=10):
    """Many policy gradients of a bandit with three arms, each from `batch` pulls, [samples, 3]."""
    noise = torch.rand(samples, batch, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    action = Categorical(BANDIT.expand(samples, batch, 3)).sample(noise)

    def gradient(action):
        return torch.func.grad(
            lambda logits: policy_gradient(
                Categorical(logits.expand(batch, 3)).log_prob(action), (PAYS - baseline)[action]
            )
        )(BANDIT)

    return torch.func.vmap(gradient)(action)


def test_the_policy_gradient_is_the_gradient_of_what_is_expected():
    exact = torch.func.grad(lambda logits: -(logits.softmax(0) * PAYS).sum())(BANDIT)
    estimates = gradients(0.0)
    error = estimates.std(0) / len(estimates) ** 0.5
    assert ((estimates.mean(0) - exact).abs() < 4 * error).all()


def test_a_baseline_changes_only_the_variance():
    exact = torch.func.grad(lambda logits: -(logits.softmax(0) * PAYS).sum())(BANDIT)
    plain, less = gradients(0.0), gradients((BANDIT.softmax(0) * PAYS).sum())
    error = less.std(0) / len(less) ** 0.5
    assert ((less.mean(0) - exact).abs() < 4 * error).all()
    assert less.var(0).sum() < plain.var(0).sum() / 50


def test_the_score_is_zero_in_the_mean():
    """E[∇log π] = 0, which is why."""
    scores = gradients(PAYS - 1)  # every pull weighs one
    assert (scores.mean(0).abs() < 4 * scores.std(0) / len(scores) ** 0.5).all()


def unchecked(name):
    """A function as users have it: in these tests alone jaxtyping looks at shapes first."""
    return inspect.unwrap(getattr(maths, name))


A, B_1 = torch.zeros(4), torch.zeros(4, 1)
T_N, N_T = torch.zeros(3, 2), torch.zeros(2, 3)
ENDS = torch.zeros(3, 2, dtype=torch.bool)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (
            lambda: unchecked("value_loss")(B_1, A),
            r"value has the shape \[4, 1\], and target \[4\]; they must be the same",
        ),
        (lambda: unchecked("value_loss")(A, A, B_1, 0.2), r"value has the shape \[4\], and old_value \[4, 1\]"),
        (lambda: unchecked("policy_gradient")(A, B_1), r"log_prob has the shape \[4\], and weight \[4, 1\]"),
        (lambda: unchecked("surrogate")(A, B_1), r"log_ratio has the shape \[4\], and advantage \[4, 1\]"),
        (lambda: unchecked("clipped_surrogate")(B_1, A), r"log_ratio has the shape \[4, 1\], and advantage \[4\]"),
        (lambda: unchecked("cross_entropy")(T_N, N_T), r"logits has the shape \[3, 2\], and target \[2, 3\]"),
        (lambda: unchecked("explained_variance")(B_1, A), r"prediction has the shape \[4, 1\], and target \[4\]"),
        (lambda: unchecked("td_target")(A, B_1, A.bool()), r"reward has the shape \[4\], and next_value \[4, 1\]"),
        (lambda: unchecked("td_target")(A, A, B_1.bool()), r"reward has the shape \[4\], and terminated \[4, 1\]"),
        (
            lambda: unchecked("gae")(T_N, T_N, N_T, ENDS, ENDS),
            r"reward has the shape \[3, 2\], and next_value \[2, 3\]",
        ),
        (lambda: unchecked("gae")(T_N, T_N, T_N, ENDS, ENDS[0]), r"reward has the shape \[3, 2\], and done \[2\]"),
        (lambda: unchecked("q_lambda")(T_N, T_N[:, :1], ENDS, ENDS), r"and next_value \[3, 1\]"),
        (lambda: unchecked("reward_to_go")(T_N, T_N, ENDS[:, 0], ENDS), r"and terminated \[3\]"),
        (lambda: unchecked("episode_return")(T_N, N_T, ENDS), r"to_go has the shape \[3, 2\], and reward \[2, 3\]"),
        (lambda: unchecked("soft_lambda_return")(T_N, T_N, N_T, ENDS, ENDS), r"and next_bonus \[2, 3\]"),
        (lambda: unchecked("gae")([1.0], T_N, T_N, ENDS, ENDS), "reward must be a Tensor, not list"),
        (lambda: unchecked("value_loss")(A, A.numpy()), "target must be a Tensor, not ndarray"),
    ],
)
def test_shapes_that_would_be_broadcast_are_refused(call, said):
    with pytest.raises(ValueError, match=said):
        call()


def test_two_critics_share_a_reward():
    assert unchecked("td_target")(A, torch.zeros(2, 4), A.bool()).shape == (2, 4)


def test_a_number_goes_with_every_shape():
    assert unchecked("policy_gradient")(A, 1.0) == 0
    assert unchecked("value_loss")(A, torch.tensor(0.0)) == 0
    assert unchecked("gae")(T_N, T_N, torch.tensor(0.0), ENDS, ENDS)[0].shape == (3, 2)
    assert unchecked("td_target")(A, torch.tensor(0.0), A.bool()).shape == (4,)
