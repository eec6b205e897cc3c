"""Adam on one vector: torch's own as the oracle, and the parameters as views of the vector."""

import copy
from functools import partial

import pytest
import torch
from torch import nn

from helpers import equal, loss_of, numbers, small_networks
from lemniscate.algos import ppo
from lemniscate.optim.adam import Adam


@pytest.mark.parametrize("limit", [0.05, 1e6])
def test_it_is_the_adam_of_torch(limit):
    networks, config = small_networks()
    reference, loss = copy.deepcopy(networks), partial(ppo.loss, config)
    batch, minibatches = numbers(), torch.arange(24).view(3, 8)
    mine = Adam(networks, betas=(0.8, 0.9), eps=1e-4, max_grad_norm=limit)
    optimizer = torch.optim.Adam(reference.parameters(), betas=(0.8, 0.9), eps=1e-4)
    for step in range(9):
        rate = 0.01 / (step + 1)
        optimizer.param_groups[0]["lr"] = mine.learning_rate = rate
        assert mine.learning_rate == rate
        optimizer.zero_grad()
        rows = batch[minibatches[step % 3]]
        loss(reference, rows)[0].backward()
        norm = nn.utils.clip_grad_norm_(reference.parameters(), limit)
        optimizer.step()
        metrics = mine.step(loss, rows)
        assert mine.steps == step + 1
        torch.testing.assert_close(metrics["gradient_norm"], norm)
    for ours, theirs in zip(networks.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_the_parameters_are_views_of_the_vector():
    networks, config = small_networks()
    before = {name: p.clone() for name, p in networks.named_parameters()}
    optimizer = Adam(networks)
    optimizer.learning_rate = 0.1
    assert all(torch.equal(p, before[name]) for name, p in networks.named_parameters())
    optimizer.step(partial(ppo.loss, config), numbers()[torch.arange(8)])
    assert all(not torch.equal(p, before[name]) for name, p in networks.named_parameters())
    networks.load_state_dict({**networks.state_dict(), **before})
    assert torch.equal(optimizer.vector, torch.cat([p.flatten() for p in before.values()]))
    named = [name.removeprefix("networks.0.") for name in optimizer.views(optimizer.vector)]
    assert named == list(before)
    assert all(equal(optimizer.views(optimizer.vector).values(), networks.parameters()))


def test_only_its_own_parameters_move():
    networks, config = small_networks()
    policy = {name: p.clone() for name, p in networks.policy.named_parameters()}
    optimizer = Adam(networks.value, name="value")
    metrics = optimizer.step(loss_of(config, networks), numbers())
    assert "gradient_norm/value" in metrics
    assert all(torch.equal(p, policy[name]) for name, p in networks.policy.named_parameters())


def test_a_checkpoint_restores_its_moments_and_count():
    (one, config), (two, _) = small_networks(), small_networks()
    first, second = Adam(one), Adam(two)
    loss = partial(ppo.loss, config)
    for _ in range(3):
        first.step(loss, numbers())
    two.load_state_dict(one.state_dict())
    second.load_state_dict({name: tensor.clone() for name, tensor in first.state_dict().items()})
    for optimizer in (first, second):
        optimizer.learning_rate = 0.01
        optimizer.step(loss, numbers())
    assert second.steps == 4
    assert torch.equal(first.vector, second.vector)
