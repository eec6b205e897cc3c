"""The random generators of a run."""

import torch

from helpers import CPU
from lemniscate.run.seeding import Generators


def test_the_generators_of_a_run_are_streams_of_its_seed_that_share_nothing():
    one, again, other = Generators(3, CPU), Generators(3, CPU), Generators(4, CPU)
    assert vars(one).keys() == {"action", "minibatch"}
    assert one.action is not one.minibatch
    drawn = [torch.rand(20, generator=g) for rng in (one, again, other) for g in (rng.action, rng.minibatch)]
    assert torch.equal(torch.stack(drawn[:2]), torch.stack(drawn[2:4]))
    for i in (0, 1, 4, 5):
        for j in (0, 1, 4, 5):
            assert torch.equal(drawn[i], drawn[j]) == (i == j)


def test_a_checkpoint_restores_every_generator():
    one, other = Generators(3, CPU), Generators(4, CPU)
    torch.rand(7, generator=one.minibatch)
    other.load_state_dict({name: state.clone() for name, state in one.state_dict().items()})
    for name in ("action", "minibatch"):
        assert torch.equal(torch.rand(5, generator=vars(one)[name]), torch.rand(5, generator=vars(other)[name]))
