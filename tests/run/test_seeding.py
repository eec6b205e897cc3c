"""The random generators of a run."""

import pytest
import torch

from helpers import CPU
from lemniscate.run.seeding import Generators


def drawn(rng, count=20):
    """Numbers of each stream of a run, of each shard."""
    return [torch.rand(count, generator=stream) for streams in vars(rng).values() for stream in streams]


@pytest.mark.parametrize("shards", [1, 4])
def test_the_generators_of_a_run_are_streams_of_its_seed_that_share_nothing(shards):
    one, again, other = (drawn(Generators(seed, CPU, shards)) for seed in (3, 3, 4))
    rng = Generators(3, CPU, shards)
    assert vars(rng).keys() == {"action", "minibatch"}
    assert len({*rng.action, *rng.minibatch}) == 2 * shards
    assert len(one) == 2 * shards
    assert all(map(torch.equal, one, again))
    every = torch.stack([*one, *other])
    assert len(every.unique(dim=0)) == 4 * shards


@pytest.mark.parametrize("shards", [1, 4])
def test_a_checkpoint_restores_every_generator(shards):
    one, other = Generators(3, CPU, shards), Generators(4, CPU, shards)
    torch.rand(7, generator=one.minibatch[-1])
    other.load_state_dict({name: state.clone() for name, state in one.state_dict().items()})
    assert all(map(torch.equal, drawn(one), drawn(other)))


def test_a_process_keeps_the_generators_of_its_shards():
    whole, part = Generators(3, CPU, 4), Generators(3, CPU, 4)
    part.hold(range(1, 3))
    expected = drawn(whole)
    assert all(map(torch.equal, drawn(part), [expected[i] for i in (1, 2, 5, 6)]))
