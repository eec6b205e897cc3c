"""The random generators of a run."""

import torch

from helpers import CPU
from lemniscate.run.seeding import Generators


def drawn(rng, count=20):
    """Numbers of each stream of a run."""
    return [torch.rand(count, generator=stream) for stream in vars(rng).values()]


def test_the_generators_of_a_run_are_streams_of_its_seed_that_share_nothing():
    one, again, other = (drawn(Generators(seed, CPU)) for seed in (3, 3, 4))
    streams = vars(Generators(3, CPU))
    assert streams.keys() == {"action", "minibatch"}
    assert len(set(streams.values())) == 2
    assert all(map(torch.equal, one, again))
    assert len(torch.stack([*one, *other]).unique(dim=0)) == 4


def test_a_checkpoint_restores_every_generator():
    one, other = Generators(3, CPU), Generators(4, CPU)
    torch.rand(7, generator=one.minibatch)
    other.load_state_dict({name: state.clone() for name, state in one.state_dict().items()})
    assert all(map(torch.equal, drawn(one), drawn(other)))
