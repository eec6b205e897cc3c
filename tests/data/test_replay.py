"""ReplayBuffer: whole transitions in a ring, drawn uniformly, restored bit for bit."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lemniscate.algos import sac
from lemniscate.data.replay import ReplayBuffer, bytes_per_transition
from lemniscate.spec import Box, ObservationPart, Spec
from lemniscate.types import Transition

CPU = torch.device("cpu")
SPEC = Spec("x", (ObservationPart((), (3,)),), Box((-1.0, -1.0), (1.0, 1.0)))


def numbered(first, count):
    """Transitions, every number of which says to which one it belongs."""
    n = torch.arange(first, first + count, dtype=torch.float32)
    return Transition(
        n[:, None].expand(-1, 3), -n[:, None].expand(-1, 2), 2 * n, n[:, None].expand(-1, 3) + 0.5, n % 2 == 0
    )


def numbers_of(rows):
    """The numbers of these transitions; fails if a row is put together from several."""
    n = rows.obs[:, 0]
    assert torch.equal(rows.obs, n[:, None].expand(-1, 3))
    assert torch.equal(rows.action, -n[:, None].expand(-1, 2))
    assert torch.equal(rows.reward, 2 * n)
    assert torch.equal(rows.next_obs, rows.obs + 0.5)
    assert torch.equal(rows.terminated, n % 2 == 0)
    return n.int().tolist()


@given(st.lists(st.integers(0, 7), max_size=30), st.integers(7, 20))
def test_it_holds_the_last_transitions_each_of_them_whole(counts, capacity):
    replay, written = ReplayBuffer(SPEC, capacity, CPU), 0
    for count in counts:
        replay.extend(numbered(written, count))
        written += count
    assert len(replay) == min(written, capacity)
    held = numbers_of(replay.transitions[: len(replay)])
    assert sorted(held) == list(range(max(0, written - capacity), written))


def test_every_filled_row_is_drawn_and_no_other(rng):
    replay = ReplayBuffer(SPEC, 50, CPU)
    replay.extend(numbered(0, 8))
    rows = replay.sample_indices(400, 20, rng)
    assert rows.shape == (400, 20)
    counts = torch.bincount(rows.flatten(), minlength=8)
    assert len(counts) == 8
    assert (counts / 1000 - 1).abs().max() < 0.15  # five standard deviations


@pytest.mark.parametrize("written", [0, 5, 10, 13])
def test_a_checkpoint_restores_it_bit_for_bit(written):
    replay, other = ReplayBuffer(SPEC, 10, CPU), ReplayBuffer(SPEC, 10, CPU)
    other.extend(numbered(100, 7))
    if written:
        replay.extend(numbered(0, min(written, 7)))
        replay.extend(numbered(7, written - min(written, 7)))
    other.load_state_dict({name: t.clone() for name, t in replay.state_dict().items()})
    for ring in (replay, other):
        ring.extend(numbered(50, 4))
    assert len(replay) == len(other)
    for name in vars(replay.transitions):
        mine, its = (getattr(ring.transitions, name)[: len(ring)] for ring in (replay, other))
        assert torch.equal(mine, its)


def test_state_dict_copies_nothing():
    replay = ReplayBuffer(SPEC, 10, CPU)
    replay.extend(numbered(0, 4))
    saved = replay.state_dict()
    assert saved["obs"].data_ptr() == replay.transitions.obs.data_ptr()
    assert saved["obs"].shape == (4, 3)


def test_a_million_of_hopper_fit_into_130_megabytes():
    hopper = Spec("Hopper-v5", (ObservationPart((), (11,)),), Box((-1.0,) * 3, (1.0,) * 3))
    replay = ReplayBuffer(hopper, 1_000_000, CPU)
    assert 1_000_000 * bytes_per_transition(hopper) == sum(t.nbytes for t in vars(replay.transitions).values()) <= 130e6


def test_an_image_stays_bytes():
    image = Spec("x", (ObservationPart((), (4, 4, 3), image=True),), Box((-1.0,), (1.0,)))
    assert ReplayBuffer(image, 5, CPU).transitions.next_obs.dtype == torch.uint8
    assert bytes_per_transition(image) == 2 * 48 + 4 + 4 + 1


def test_beside_numbers_an_image_is_float32_which_is_counted_and_said():
    parts = ObservationPart(("a",), (4, 4, 3), image=True), ObservationPart(("b",), (2,))
    mixed = Spec("x", parts, Box((-1.0,), (1.0,)))
    replay = ReplayBuffer(mixed, 5, CPU)
    assert 5 * bytes_per_transition(mixed) == sum(t.nbytes for t in vars(replay.transitions).values())
    assert "pixels are stored as float32" in sac.Config().notices(mixed, CPU)[1]
    assert len(sac.Config().notices(SPEC, CPU)) == 1
