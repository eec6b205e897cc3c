"""ActionNoise noise: what each kind is, copy by copy, and where it is cut."""

import pytest
import torch

from lemniscate.data.action_noise import ActionNoise

CPU = torch.device("cpu")
KINDS = ["white", "ou", "coloured"]


def noise(kind, shape=(3, 2), length=8):
    return ActionNoise(kind, shape, length, CPU, time=5.0, exponent=1.0)


def played(action_noise, steps, rng):
    return torch.stack([action_noise(rng) for _ in range(steps)])  # [T, N, A]


@pytest.mark.parametrize("kind", KINDS)
def test_it_has_variance_one_at_every_step_of_an_episode(kind, rng):
    x = played(noise(kind, (4000, 2), 10), 25, rng)
    assert (x.std(dim=(1, 2)) - 1).abs().max() < 0.05
    assert x.mean(dim=(1, 2)).abs().max() < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_neighbouring_steps_resemble_each_other_unless_white(kind, rng):
    x = played(noise(kind, (500, 4), 20), 20, rng).flatten(1)
    neighbours = (x[1:] * x[:-1]).mean().item()
    assert neighbours == pytest.approx({"white": 0, "ou": 0.819, "coloured": 0.6}[kind], abs=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_copies_and_coordinates_are_independent(kind, rng):
    x = played(noise(kind, (2, 2), 4), 8000, rng).flatten(1)
    assert (torch.corrcoef(x.T) - torch.eye(4)).abs().max() < 0.05


@pytest.mark.parametrize("kind", ["ou", "coloured"])
def test_an_episode_that_ends_cuts_its_own_sequence_and_no_other(kind, rng):
    """Ends after every second step in the odd copies: there, what follows an end owes nothing to what was."""
    action_noise, x = noise(kind, (2000, 1), 100), []
    odd = torch.arange(2000) % 2 == 1
    for t in range(12):
        x.append(action_noise(rng)[:, 0])
        if t % 2 == 1:
            action_noise.cut(odd)
    x = torch.stack(x)
    across = [(x[t] * x[t + 1]) for t in range(1, 11, 2)]
    within = [(x[t] * x[t + 1]) for t in range(0, 12, 2)]
    assert torch.stack(across)[:, odd].mean().abs() < 0.05
    assert torch.stack(across)[:, ~odd].mean() > 0.5
    assert torch.stack(within).mean() > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_it_goes_on_from_a_checkpoint_in_the_same_bits(kind):
    one, two = noise(kind), noise(kind)
    generators = [torch.Generator().manual_seed(s) for s in (3, 4)]
    played(one, 5, generators[0])
    one.cut(torch.tensor([True, False, False]))
    played(two, 3, generators[1])
    two.load_state_dict({name: t.clone() for name, t in one.state_dict().items()})
    generators[1].set_state(generators[0].get_state())
    assert torch.equal(played(one, 20, generators[0]), played(two, 20, generators[1]))


def test_after_a_restart_all_begin_anew(rng):
    action_noise = noise("ou", (4000, 1), 100)
    before = action_noise(rng)
    action_noise.restart()
    assert (before * action_noise(rng)).mean().abs() < 0.05
