"""Rollouts of whole episodes, and the minibatches of a rollout."""

import dataclasses

import numpy as np
import pytest
import torch

from helpers import CPU, MODES, vectorize
from lemniscate.algos import reinforce
from lemniscate.data.rollout import collect, epoch_minibatches, estimates, one_minibatch
from lemniscate.data.whole_episodes import collect_episodes
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
    collect(env, policy, 2, (rng,))  # now every environment is within an episode
    for _ in range(2):
        rollout = collect_episodes(env, policy, 2, (rng,))
        rows = rollout.obs[rollout.valid].int()
        for n in range(3):
            own = rows[rows[:, 0] == n, 1:]
            first = own[0, 0].item()
            assert own.tolist() == [[first + k, t] for k in range(2) for t in range(lengths[n])]


class Still:
    """A policy that takes action 0."""

    def draw_noise(self, shape, streams):
        return torch.zeros(*shape)

    def act(self, obs, noise):
        return torch.zeros(len(obs), dtype=torch.int64)


def test_an_episode_that_never_ends_is_an_error(rng):
    env = vectorize("Countdown-v0", 1, mode="DISABLED", length=None)
    with pytest.raises(UserError, match=r"Countdown-v0 has not ended after 20,000 steps"):
        collect_episodes(env, Still(), 1, (rng,))


def test_a_rollout_without_valid_rows_is_an_error(rng):
    with pytest.raises(UserError, match="No valid transition in the whole rollout; increase num_steps"):
        epoch_minibatches([torch.arange(0)], 4, 2, (rng,))


def test_minibatches_have_every_row_once_an_epoch(rng):
    first, second = (epoch_minibatches([torch.arange(24)], 24, 6, (rng,)) for _ in range(2))
    for minibatches in (first, second):
        assert minibatches.shape == (4, 6)
        assert minibatches.flatten().sort().values.tolist() == list(range(24))
    assert not torch.equal(first[0], second[0])


@pytest.mark.parametrize(
    ("valid", "collected", "size", "shape"), [(5, 12, 4, (3, 4)), (12, 12, 5, (3, 5)), (3, 8, 9, (1, 8))]
)
def test_minibatches_have_one_shape_whatever_the_number_of_valid_rows(rng, valid, collected, size, shape):
    rows = torch.arange(valid) * 7
    minibatches = epoch_minibatches([rows], collected, size, (rng,))
    assert minibatches.shape == shape
    times = torch.bincount(minibatches.flatten(), minlength=valid * 7)[rows]
    assert times.sum() == minibatches.numel()
    assert times.min() >= 1
    assert times.max() - times.min() <= 1


def test_each_minibatch_has_as_many_rows_of_every_shard(rng):
    streams = tuple(torch.Generator().manual_seed(seed) for seed in range(4))
    minibatches = epoch_minibatches(list(torch.arange(48).chunk(4)), 48, 3, streams)
    assert minibatches.shape == (4, 12)
    assert (minibatches // 12).tolist() == [[shard for shard in range(4) for _ in range(3)]] * 4
    assert minibatches.flatten().sort().values.tolist() == list(range(48))


def test_the_rows_of_a_shard_are_together_in_a_flat_rollout(rng):
    """Environment n's step t has the number 10 n + t; two shards of two environments."""
    numbers = torch.arange(3)[:, None] + 10 * torch.arange(4)
    valid = numbers != 21
    flags = torch.zeros(3, 4, dtype=torch.bool)
    rollout = Rollout(numbers, numbers, numbers.float(), numbers, flags, flags, valid, shards=2)
    flat = rollout.flatten(2).obs
    assert flat.tolist() == [0, 10, 1, 11, 2, 12, 20, 30, 21, 31, 22, 32]
    assert [flat[rows].tolist() for rows in rollout.valid_rows] == [[0, 10, 1, 11, 2, 12], [20, 30, 31, 22, 32]]
    assert torch.equal(rollout.flatten().obs, numbers.flatten())


def test_the_networks_say_the_same_of_each_shard_alone(rng):
    env = vectorize("Pendulum-v1", 8)
    networks = reinforce.Config(num_envs=8, hidden=(16,)).networks(env.spec)
    rollout = collect(env, networks.policy, 5, (rng,))
    with torch.no_grad():
        whole = (networks.value(rollout.obs), networks.value(rollout.next_obs), None)
    for shards in (1, 4):
        value, next_value, log_prob = estimates(networks, dataclasses.replace(rollout, shards=shards))
        torch.testing.assert_close((value, next_value), whole[:2])
        assert log_prob.shape == (5, 8)


def test_one_minibatch_has_all_rows_in_their_order():
    assert one_minibatch([torch.tensor([2, 3, 7])], 3).tolist() == [[2, 3, 7]]
    assert one_minibatch([torch.tensor([2, 3, 7])], 5).tolist() == [[2, 3, 7, 2, 3]]
