"""V(s), the critics Q(s, a), and the temperature."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from helpers import spec_of
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.actor_q import ActorCategoricalQ, ActorQ
from lemniscate.nn.critics import Temperature, normalize_units
from lemniscate.nn.networks import Layers


def test_a_value_is_one_number_for_each_observation():
    value, obs = ActorCritic(spec_of(), Layers()).value, torch.randn(20, 5)
    assert value(obs).shape == (20,)
    assert value(obs.view(4, 5, 5)).shape == (4, 5)


def test_units_of_a_frozen_layer_keep_their_length():
    free, frozen = torch.nn.Linear(3, 4), torch.nn.Linear(3, 4).requires_grad_(False)
    before = frozen.weight.clone()
    with torch.no_grad():
        normalize_units(torch.nn.Sequential(free, frozen))
    torch.testing.assert_close(free.weight.norm(dim=1), torch.ones(4))
    assert torch.equal(frozen.weight, before)


@pytest.mark.parametrize("kind", [ActorCritic, ActorQ, ActorCategoricalQ])
def test_critics_see_what_is_privileged_and_policies_do_not(kind):
    spec, layers = replace(spec_of(), privileged=3), Layers((8,))
    if kind is ActorCritic:
        networks = ActorCritic(spec, layers)
        critic = networks.value
    elif kind is ActorQ:
        networks = ActorQ(spec, layers, layers, False, critics=2)
        critic = partial(networks.q, action=torch.zeros(20, 2))
    else:
        networks = ActorCategoricalQ(spec, layers, layers, False, -1.0, 10.0)
        critic = partial(networks.critic, action=torch.zeros(20, 2))
    obs = torch.randn(20, 8)
    other = torch.cat([obs[:, :5], torch.randn(20, 3)], dim=1)
    for given in (other, obs[:, :5]):
        assert torch.equal(networks.policy(given).mode(), networks.policy(obs).mode())
    assert not torch.isclose(critic(obs), critic(other), rtol=0).any()
    with pytest.raises(RuntimeError):  # without them there is no value, and none is made up
        critic(obs[:, :5])


@pytest.mark.parametrize("count", [1, 2, 3])
def test_critics_are_c_independent_networks(count):
    critics = ActorQ(spec_of(), Layers((8,)), Layers((8,)), False, critics=count).critics
    obs, action = torch.randn(20, 5), torch.randn(20, 2)
    values = critics(obs, action)
    assert values.shape == (count, 20)
    assert critics(obs.view(4, 5, 5), action.view(4, 5, 2)).shape == (count, 4, 5)
    assert torch.equal(critics.first(obs, action), values[0])
    assert len({value.sum().item() for value in values}) == count
    values[0].sum().backward()
    moved = [any(p.grad is not None and p.grad.any() for p in q.parameters()) for q in critics.members]
    assert moved == [True] + [False] * (count - 1)


def test_the_temperature_is_positive_and_starts_where_the_setting_says():
    temperature = Temperature(0.3)
    assert temperature().item() == pytest.approx(0.3)
    with torch.no_grad():
        temperature.log_alpha.sub_(20.0)
    assert temperature() > 0
