"""ActionNoise: the statistics of each kind, and where its sequences begin again."""

import pytest
import torch

from lemniscate.data.replay import ActionNoise

CPU = torch.device("cpu")
KINDS = ["white", "ou", "coloured"]


def noise(kind, shape=(3, 2), length=8):
    return ActionNoise(kind, shape, length, CPU, time=5.0, exponent=1.0)


def drawn(action_noise, steps, rng):
    return torch.stack([action_noise(rng) for _ in range(steps)])  # [T, N, A]


@pytest.mark.parametrize("kind", KINDS)
def test_the_variance_is_one_at_every_step_of_an_episode(kind, rng):
    x = drawn(noise(kind, (4000, 2), 10), 25, rng)
    assert (x.std(dim=(1, 2)) - 1).abs().max() < 0.05
    assert x.mean(dim=(1, 2)).abs().max() < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_the_correlation_of_neighbouring_steps_is_that_of_the_kind(kind, rng):
    x = drawn(noise(kind, (500, 4), 20), 20, rng).flatten(1)
    neighbours = (x[1:] * x[:-1]).mean().item()
    assert neighbours == pytest.approx({"white": 0, "ou": 0.819, "coloured": 0.6}[kind], abs=0.1)


@pytest.mark.parametrize("kind", KINDS)
def test_environments_and_coordinates_are_independent(kind, rng):
    x = drawn(noise(kind, (2, 2), 4), 8000, rng).flatten(1)
    assert (torch.corrcoef(x.T) - torch.eye(4)).abs().max() < 0.05


@pytest.mark.parametrize("kind", ["ou", "coloured"])
def test_the_end_of_an_episode_begins_a_new_sequence_there_and_nowhere_else(kind, rng):
    """Ends after every second step in the odd environments: there, noise after an end does not depend on that before."""
    action_noise, x = noise(kind, (2000, 1), 100), []
    odd = torch.arange(2000) % 2 == 1
    for t in range(12):
        x.append(action_noise(rng)[:, 0])
        if t % 2 == 1:
            action_noise.on_episode_end(odd)
    x = torch.stack(x)
    across = [(x[t] * x[t + 1]) for t in range(1, 11, 2)]
    within = [(x[t] * x[t + 1]) for t in range(0, 12, 2)]
    assert torch.stack(across)[:, odd].mean().abs() < 0.05
    assert torch.stack(across)[:, ~odd].mean() > 0.5
    assert torch.stack(within).mean() > 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_a_checkpoint_restores_it_bit_for_bit(kind):
    one, two = noise(kind), noise(kind)
    generators = [torch.Generator().manual_seed(s) for s in (3, 4)]
    drawn(one, 5, generators[0])
    one.on_episode_end(torch.tensor([True, False, False]))
    drawn(two, 3, generators[1])
    two.load_state_dict({name: t.clone() for name, t in one.state_dict().items()})
    generators[1].set_state(generators[0].get_state())
    assert torch.equal(drawn(one, 20, generators[0]), drawn(two, 20, generators[1]))


def test_a_restart_begins_new_sequences_everywhere(rng):
    action_noise = noise("ou", (4000, 1), 100)
    before = action_noise(rng)
    action_noise.on_restart()
    assert (before * action_noise(rng)).mean().abs() < 0.05
