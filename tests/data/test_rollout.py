"""Rollouts of whole episodes, and the minibatches of a rollout."""

import numpy as np
import pytest
import torch

from helpers import CPU, MODES, vectorize
from lemniscate.algos import reinforce
from lemniscate.data.rollout import collect, collect_episodes, epoch_minibatches, one_minibatch
from lemniscate.errors import UserError
from lemniscate.types import Rollout


def policy_in(env):
    return reinforce.Config(num_envs=env.num_envs, hidden=(16,)).networks(env.spec).to(CPU).policy


@pytest.mark.parametrize("mode", MODES)
def test_whole_episodes_are_whole_and_as_many_from_each_environment(mode, rng):
    """Countdown's rows say whose they are: (environment, episode, step)."""
    lengths = np.array([3, 5, 8])
    env = vectorize("Countdown-v0", 3, mode=mode, length=lengths)
    policy = policy_in(env)
    collect(env, policy, 2, rng)  # now every environment is within an episode
    for _ in range(2):
        rollout = collect_episodes(env, policy, 2, rng)
        rows = rollout.obs[rollout.valid].int()
        for n in range(3):
            own = rows[rows[:, 0] == n, 1:]
            first = own[0, 0].item()
            assert own.tolist() == [[first + k, t] for k in range(2) for t in range(lengths[n])]


class Still:
    """A policy that takes action 0."""

    def draw_noise(self, shape, generator):
        return torch.zeros(*shape)

    def act(self, obs, noise):
        return torch.zeros(len(obs), dtype=torch.int64)


@pytest.mark.long
def test_an_episode_that_never_ends_is_an_error(rng):
    env = vectorize("Countdown-v0", 1, mode="DISABLED", length=None)
    with pytest.raises(UserError, match=r"Countdown-v0 has not ended after 20,000 steps"):
        collect_episodes(env, Still(), 1, rng)


def test_a_rollout_without_valid_rows_is_an_error(rng):
    with pytest.raises(UserError, match="No valid transition in the whole rollout; increase num_steps"):
        epoch_minibatches(torch.arange(0), 4, 2, rng)


def test_minibatches_have_every_row_once_an_epoch(rng):
    first, second = (epoch_minibatches(torch.arange(24), 24, 6, rng) for _ in range(2))
    for minibatches in (first, second):
        assert minibatches.shape == (4, 6)
        assert minibatches.flatten().sort().values.tolist() == list(range(24))
    assert not torch.equal(first[0], second[0])


@pytest.mark.parametrize(
    ("valid", "collected", "size", "shape"), [(5, 12, 4, (3, 4)), (12, 12, 5, (3, 5)), (3, 8, 9, (1, 8))]
)
def test_minibatches_have_one_shape_whatever_the_number_of_valid_rows(rng, valid, collected, size, shape):
    rows = torch.arange(valid) * 7
    minibatches = epoch_minibatches(rows, collected, size, rng)
    assert minibatches.shape == shape
    times = torch.bincount(minibatches.flatten(), minlength=valid * 7)[rows]
    assert times.sum() == minibatches.numel()
    assert times.min() >= 1
    assert times.max() - times.min() <= 1


def test_the_rows_of_a_flat_rollout_are_in_the_order_of_time(rng):
    """Environment n's step t has the number 10 n + t."""
    numbers = torch.arange(3)[:, None] + 10 * torch.arange(2)
    flags = torch.zeros(3, 2, dtype=torch.bool)
    rollout = Rollout(numbers, numbers, numbers.float(), numbers, flags, flags, numbers != 11)
    flat = rollout.flatten().obs
    assert flat.tolist() == [0, 10, 1, 11, 2, 12]
    assert flat[rollout.valid_rows].tolist() == [0, 10, 1, 2, 12]


def test_one_minibatch_has_all_rows_in_their_order():
    assert one_minibatch(torch.tensor([2, 3, 7]), 3).tolist() == [[2, 3, 7]]
    assert one_minibatch(torch.tensor([2, 3, 7]), 5).tolist() == [[2, 3, 7, 2, 3]]
