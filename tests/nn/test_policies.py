"""Policies: their distributions, where they start, their noise and metrics."""

import pytest
import torch

from helpers import spec_of
from lemniscate.maths import Bernoulli, Categorical, Gaussian, MultiCategorical
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.actor_q import ActorQ, SoftActorQ
from lemniscate.nn.networks import Layers
from lemniscate.spec import Discrete, MultiBinary, MultiDiscrete, ObservationPart, Spec


def policy_for(action, **fields):
    parts = (ObservationPart((), (5,)),)
    return ActorCritic(Spec("x", parts, action), Layers((8,)), **fields).policy


def test_a_gaussian_policy_starts_near_the_centre():
    policy = ActorCritic(spec_of(), Layers(), initial_log_std=-0.5).policy
    distribution = policy(torch.randn(20, 5))
    assert isinstance(distribution, Gaussian)
    assert distribution.mean.abs().max() < 0.1
    torch.testing.assert_close(distribution.log_std, torch.full((2,), -0.5))
    torch.testing.assert_close(policy.metrics()["policy_std"], torch.tensor(-0.5).exp())


@pytest.mark.parametrize(
    ("action", "kind", "noise", "shape"),
    [
        (Discrete(3), Categorical, (), ()),
        (MultiDiscrete((2, 3), (0, 0)), MultiCategorical, (2,), (2,)),
        (MultiBinary(4), Bernoulli, (4,), (4,)),
    ],
)
def test_every_kind_of_action_has_its_distribution(action, kind, noise, shape, rng):
    policy = policy_for(action)
    obs = torch.randn(20, 5)
    assert isinstance(policy(obs), kind)
    drawn = policy.draw_noise((20,), rng)
    assert drawn.shape == (20, *noise)
    assert 0 <= drawn.min() <= drawn.max() < 1
    assert policy.act(obs, drawn).shape == (20, *shape)
    assert torch.equal(policy.act(obs, drawn), policy(obs).sample(drawn))


def test_masked_actions_have_no_probability(rng):
    policy = policy_for(Discrete(3, masked=True))
    mask = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]).repeat(50, 1)
    obs = torch.cat([torch.randn(100, 5), mask], dim=-1)
    action = policy.act(obs, policy.draw_noise((100,), rng))
    assert mask.gather(1, action[:, None]).all()
    assert len(set(action.tolist())) == 3


def test_policies_of_bounded_actions_act_between_their_bounds(rng):
    obs = 100 * torch.randn(200, 5)
    for kind, extra in ((ActorQ, {}), (SoftActorQ, {"initial_temperature": 1.0})):
        policy = kind(spec_of(), Layers((8,)), Layers((8,)), False, critics=1, **extra).policy
        noise = policy.draw_noise((200,), rng)
        assert noise.shape == (200, 2)
        assert noise.any() == (kind is SoftActorQ)
        assert policy.act(obs, noise).abs().max() <= 1


def test_the_std_of_a_squashed_gaussian_is_bounded():
    policy = SoftActorQ(spec_of(), Layers((8,)), Layers((8,)), False, critics=1, initial_temperature=1.0).policy
    with torch.no_grad():
        policy.net[-1].bias[2:] = torch.tensor([-1e3, 1e3])
    log_std = policy(torch.randn(20, 5)).log_std
    torch.testing.assert_close(log_std, torch.tensor([-5.0, 2.0]).expand(20, 2))


def test_the_normalizer_moves_in_observe_only():
    policy = ActorCritic(spec_of(), Layers(), normalize_observations=True).policy
    policy(torch.randn(20, 5))
    assert policy.normalizer.count == 0
    policy.observe(torch.randn(20, 5))
    assert policy.normalizer.count == 20
