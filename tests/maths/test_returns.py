from statistics import NormalDist

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lemniscate.maths import episode_return, gae, hl_gauss, polyak, reward_to_go, soft_lambda_return, td_target


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


def mixture(reward, next_value, next_bonus, terminated, done, gamma, lam):
    """The TD(λ) return as what it is: n-step returns, weighted by (1 − λ) λ^(n−1), the longest by what is left."""
    T, N = reward.shape
    target = torch.zeros(T, N, dtype=torch.float64)
    for n in range(N):
        for t in range(T):
            last = next((k for k in range(t, T) if done[k, n]), T - 1)
            for end in range(t, last + 1):
                steps = range(t, end + 1)
                n_step = sum(gamma ** (k - t) * reward[k, n].item() for k in steps)
                n_step += sum(gamma ** (k - t + 1) * next_bonus[k, n].item() for k in steps if not terminated[k, n])
                if not terminated[end, n]:
                    n_step += gamma ** (end - t + 1) * next_value[end, n].item()
                target[t, n] += (lam ** (end - t) * (1 - lam) if end < last else lam ** (last - t)) * n_step
    return target


@given(rollouts(), st.floats(0, 1), st.floats(0, 1))
def test_the_soft_return_is_the_mixture_of_n_step_returns(rollout, gamma, lam):
    reward, next_bonus, next_value, terminated, done = rollout
    rows = reward, next_value, next_bonus, terminated, done
    found = soft_lambda_return(*rows, gamma=gamma, lam=lam)
    torch.testing.assert_close(found, mixture(*rows, gamma, lam), rtol=1e-10, atol=1e-10)


@given(rollouts(), st.floats(0, 1))
def test_at_lambda_zero_the_soft_return_is_the_target_of_sac(rollout, gamma):
    reward, bonus, next_value, terminated, done = rollout
    found = soft_lambda_return(reward, next_value, bonus, terminated, done, gamma=gamma, lam=0.0)
    flat = (x.flatten() for x in (reward, next_value + bonus, terminated))
    torch.testing.assert_close(found.flatten(), td_target(*flat, gamma=gamma))


@given(rollouts(), st.floats(0, 1), st.floats(0, 1))
def test_without_a_bonus_the_soft_return_is_the_target_of_gae(rollout, gamma, lam):
    reward, value, next_value, terminated, done = rollout
    next_value = torch.cat([torch.where(done[:-1], next_value[:-1], value[1:]), next_value[-1:]])  # V must agree
    _, target = gae(reward, value, next_value, terminated, done, gamma=gamma, lam=lam)
    found = soft_lambda_return(reward, next_value, torch.zeros_like(reward), terminated, done, gamma=gamma, lam=lam)
    torch.testing.assert_close(found, target, rtol=1e-10, atol=1e-10)


def test_hl_gauss_is_the_mass_of_a_normal_in_each_bin(rng):
    edges, width = torch.linspace(-2, 2, 9, dtype=torch.float64), 0.6
    target = torch.cat([torch.rand(20, generator=rng, dtype=torch.float64) * 4 - 2, torch.tensor([-2.0, 2.0])])
    phi = NormalDist().cdf
    for y, found in zip(target.tolist(), hl_gauss(target, edges, width), strict=True):
        below = [phi((edge - y) / (width * 0.5)) for edge in edges.tolist()]
        mass = np.diff(below) / (below[-1] - below[0])
        torch.testing.assert_close(found, torch.from_numpy(mass), rtol=1e-9, atol=1e-12)


@given(st.floats(-6, 6), st.integers(20, 200))
def test_the_mean_of_hl_gauss_is_the_number(y, bins):
    edges = torch.linspace(-10, 10, bins + 1, dtype=torch.float64)
    mean = hl_gauss(torch.tensor([y], dtype=torch.float64), edges) @ ((edges[1:] + edges[:-1]) / 2)
    assert mean.item() == pytest.approx(y, abs=1e-4)


def test_hl_gauss_of_what_lies_outside_is_that_of_the_end():
    edges = torch.linspace(-1, 1, 6)
    found = hl_gauss(torch.tensor([-1e30, -1.0, 1.0, 1e30]), edges)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[2], found[3])
    torch.testing.assert_close(found.sum(1), torch.ones(4))
