import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lemniscate import maths
from lemniscate.maths import episode_return, gae, polyak, reward_to_go, td_target


def brute_force(reward, value, next_value, terminated, done, gamma, lam):
    """Eq. 16 as a double sum over each episode, one number at a time."""
    T, N = reward.shape
    advantage = torch.zeros(T, N, dtype=torch.float64)
    for n in range(N):
        for t in range(T):
            weight = 1.0
            for k in range(t, T):
                bootstrap = 0.0 if terminated[k, n] else next_value[k, n].item()
                delta = reward[k, n].item() + gamma * bootstrap - value[k, n].item()
                advantage[t, n] += weight * delta
                if done[k, n]:
                    break
                weight *= gamma * lam
    return advantage


@st.composite
def rollouts(draw):
    T, N = draw(st.integers(1, 12)), draw(st.integers(1, 4))
    g = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    reward, value, next_value = (torch.randn(T, N, generator=g, dtype=torch.float64) for _ in range(3))
    terminated = torch.rand(T, N, generator=g) < draw(st.floats(0, 0.5))
    truncated = torch.rand(T, N, generator=g) < draw(st.floats(0, 0.5))
    return reward, value, next_value, terminated, terminated | truncated


@given(rollouts(), st.floats(0, 1), st.floats(0, 1))
def test_gae_is_the_double_sum(rollout, gamma, lam):
    advantage, target = gae(*rollout, gamma=gamma, lam=lam)
    expected = brute_force(*rollout, gamma, lam)
    torch.testing.assert_close(advantage, expected, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(target, expected + rollout[1], rtol=1e-10, atol=1e-10)


def test_the_course_example():
    """Rewards 1, values .5 .6 .7 .8, the last row terminal; the course's own fixture is off by one here."""
    column = torch.tensor([[0.5], [0.6], [0.7], [0.8]])
    last = torch.tensor([[False], [False], [False], [True]])
    next_value = torch.tensor([[0.6], [0.7], [0.8], [0.0]])
    advantage, _ = gae(torch.ones(4, 1), column, next_value, last, last, gamma=0.99, lam=0.95)
    expected = torch.tensor([3.25427, 2.29693, 1.2801, 0.2])
    torch.testing.assert_close(advantage[:, 0], expected, rtol=0, atol=5e-6)


@given(rollouts(), st.floats(0, 1))
def test_lambda_zero_is_the_td_error(rollout, gamma):
    reward, value, next_value, terminated, _ = rollout
    advantage, _ = gae(*rollout, gamma=gamma, lam=0.0)
    torch.testing.assert_close(advantage, reward + gamma * next_value * ~terminated - value)


@given(rollouts(), st.floats(0, 1))
def test_lambda_one_is_monte_carlo_minus_the_baseline(rollout, gamma):
    reward, value, next_value, terminated, done = rollout
    next_value = next_value.clone()
    next_value[:-1] = torch.where(done[:-1], next_value[:-1], value[1:])  # the chain telescopes only if V agrees
    advantage, _ = gae(reward, value, next_value, terminated, done, gamma=gamma, lam=1.0)
    T, N = reward.shape
    for n in range(N):
        for t in range(T):
            total, weight = 0.0, 1.0
            for k in range(t, T):
                total += weight * reward[k, n].item()
                weight *= gamma
                if done[k, n] or k == T - 1:
                    total += 0.0 if terminated[k, n] else weight * next_value[k, n].item()
                    break
            assert advantage[t, n].item() == pytest.approx(total - value[t, n].item(), abs=1e-9)


@given(rollouts())
def test_permuting_the_environments_permutes_the_result(rollout):
    order = torch.arange(rollout[0].shape[1]).flip(0)
    straight, _ = gae(*rollout)
    permuted, _ = gae(*(column[:, order] for column in rollout))
    torch.testing.assert_close(straight[:, order], permuted)


@given(rollouts())
def test_cutting_a_rollout_at_an_end_changes_nothing(rollout):
    reward, value, next_value, terminated, done = rollout
    done = done.clone()
    cut = len(reward) // 2
    if cut == 0:
        return
    done[cut - 1] = True
    whole, _ = gae(reward, value, next_value, terminated, done)
    head, _ = gae(*(c[:cut] for c in (reward, value, next_value, terminated, done)))
    tail, _ = gae(*(c[cut:] for c in (reward, value, next_value, terminated, done)))
    torch.testing.assert_close(whole, torch.cat([head, tail]))


@given(st.integers(0, 2**31), st.sampled_from([(), (2,)]), st.floats(0, 1))
def test_a_td_target_is_the_sum_row_by_row(seed, critics, gamma):
    g = torch.Generator().manual_seed(seed)
    reward, next_value = (torch.randn(shape, generator=g, dtype=torch.float64) for shape in ((6,), (*critics, 6)))
    terminated = torch.rand(6, generator=g) < 0.5
    target = td_target(reward, next_value, terminated, gamma=gamma)
    for i in range(6):
        follows = 0.0 if terminated[i] else gamma * next_value[..., i]
        torch.testing.assert_close(target[..., i], reward[i] + torch.zeros_like(next_value[..., i]) + follows)


@given(st.integers(0, 2**31), st.floats(0, 1), st.integers(1, 6))
def test_polyak_moves_the_target_alone_and_by_a_power(seed, tau, times):
    g = torch.Generator().manual_seed(seed)
    target, online = ([torch.randn(3, 2, generator=g, dtype=torch.float64)] for _ in range(2))
    start, kept = target[0].clone(), online[0].clone()
    for _ in range(times):
        polyak(target, online, tau)
    left = (1 - tau) ** times
    torch.testing.assert_close(target[0], left * start + (1 - left) * kept)
    assert torch.equal(online[0], kept)


def test_polyak_takes_no_gradient():
    target, online = torch.zeros(2, requires_grad=True), torch.ones(2, requires_grad=True)
    polyak([target], [online], 1.0)
    assert torch.equal(target, online)
    assert target.is_leaf
    assert target.data_ptr() != online.data_ptr()


@given(rollouts(), st.floats(0, 1))
def test_reward_to_go_is_the_sum_of_what_follows(rollout, gamma):
    reward, _, next_value, terminated, done = rollout
    expected = torch.zeros_like(reward)
    for t, n in np.ndindex(*reward.shape):
        k, weight = t, 1.0
        while True:
            expected[t, n] += weight * reward[k, n]
            weight *= gamma
            if done[k, n] or k == len(reward) - 1:
                break
            k += 1
        expected[t, n] += 0 if terminated[k, n] else weight * next_value[k, n]
    actual = reward_to_go(reward, next_value, terminated, done, gamma=gamma)
    torch.testing.assert_close(actual, expected, rtol=1e-10, atol=1e-10)


@given(rollouts(), st.floats(0, 1))
def test_gae_with_lambda_one_is_reward_to_go_minus_the_value(rollout, gamma):
    """Where the value of a successor is that of the next row, the sum of TD errors telescopes."""
    reward, value, next_value, terminated, done = rollout
    shifted = torch.cat([value[1:], next_value[-1:]])
    next_value = torch.where(done, next_value, shifted)
    advantage, _ = gae(reward, value, next_value, terminated, done, gamma=gamma, lam=1.0)
    to_go = reward_to_go(reward, next_value, terminated, done, gamma=gamma)
    torch.testing.assert_close(advantage, to_go - value, rtol=1e-9, atol=1e-9)


@given(rollouts(), st.floats(0, 1))
def test_the_whole_return_is_that_of_the_first_row_of_the_episode(rollout, gamma):
    reward, _, next_value, terminated, done = rollout
    to_go = reward_to_go(reward, next_value, terminated, done, gamma=gamma)
    expected = to_go.clone()
    for n in range(reward.shape[1]):
        for t in range(1, len(reward)):
            expected[t, n] = to_go[t, n] if done[t - 1, n] else expected[t - 1, n]
    actual = episode_return(to_go, reward, done, gamma=gamma)
    torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", [torch.uint8, torch.int64, torch.float32])
def test_flags_may_be_numbers(kind):
    generator = torch.Generator().manual_seed(0)
    reward, value, after = (torch.randn(5, 2, generator=generator) for _ in range(3))
    terminated = torch.rand(5, 2, generator=generator) < 0.3
    done = terminated | (torch.rand(5, 2, generator=generator) < 0.3)
    flags = (terminated.to(kind), done.to(kind))
    plain = {
        name: getattr(maths, name) for name in ("gae", "q_lambda", "reward_to_go", "td_target", "soft_lambda_return")
    }
    for name, function in plain.items():
        rows = {"gae": (reward, value, after), "soft_lambda_return": (reward, after, value)}.get(name, (reward, after))
        number = 1 if name == "td_target" else 2
        function = getattr(function, "__wrapped__", function)  # past the checks of shapes and types
        expected, found = function(*rows, *(terminated, done)[:number]), function(*rows, *flags[:number])
        for one, other in zip([*expected], [*found], strict=True):
            assert torch.equal(one, other), name
