"""Policy and critics for the spaces of an environment."""

import pytest
import torch

from helpers import equal, spec_of
from lemniscate.errors import UserError
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.actor_q import ActorQ, SoftActorQ
from lemniscate.nn.networks import ImageEncoder, Layers
from lemniscate.nn.normalizer import NoNorm, RunningNorm
from lemniscate.nn.policies import DeterministicPolicy, SquashedGaussianPolicy
from lemniscate.spec import Box, ObservationPart, Spec

SMALL = Layers((8,))


def test_policy_and_value_share_one_normalizer():
    networks = ActorCritic(spec_of(), Layers(), normalize_observations=True)
    assert networks.policy.normalizer is networks.value.normalizer
    assert isinstance(networks.policy.normalizer, RunningNorm)
    assert type(ActorCritic(spec_of(), Layers()).policy.normalizer) is NoNorm


def test_the_value_of_what_follows_is_that_of_the_true_next_observation(rng):
    """Also where the row after begins with another one: at ends, and at the end of the rollout."""
    networks = ActorCritic(spec_of(), SMALL, normalize_observations=True)
    obs, action = torch.randn(6, 3, 5, generator=rng), torch.randn(6, 3, 2, generator=rng)
    next_obs = torch.cat([obs[1:], torch.randn(1, 3, 5, generator=rng)])
    next_obs[2, 1, 0] += 1  # the end of an episode
    next_obs[4, 2] = torch.nan  # never equal to anything
    with torch.no_grad():
        value, after = networks.estimates(obs, next_obs)
        torch.testing.assert_close(value, networks.value(obs))
        torch.testing.assert_close(after, networks.value(next_obs), equal_nan=True)
        torch.testing.assert_close(networks.log_prob(obs, action), networks.policy(obs).log_prob(action))
        assert after.isnan().sum() == 1


def test_policy_and_critics_share_one_normalizer():
    networks = ActorQ(spec_of(), SMALL, SMALL, True, critics=2)
    assert all(q.normalizer is networks.policy.normalizer for q in networks.critics.members)
    names = [name for name, _ in networks.named_buffers()]  # named once, saved under each name
    assert names == ["policy.normalizer.mean", "policy.normalizer.var", "policy.normalizer.count"]


@pytest.mark.parametrize(("kind", "policy"), [(ActorQ, DeterministicPolicy), (SoftActorQ, SquashedGaussianPolicy)])
def test_targets_are_copies_behind_the_same_normalizer(kind, policy):
    extra = {"initial_temperature": 0.5} if kind is SoftActorQ else {}
    networks = kind(spec_of(), SMALL, SMALL, True, critics=2, **extra)
    assert isinstance(networks.policy, policy)
    targets = networks.target()
    followed = networks.critics if kind is SoftActorQ else networks
    assert all(equal(followed.parameters(), targets.parameters()))
    assert not any(parameter.requires_grad for parameter in targets.parameters())
    with torch.no_grad():
        for parameter in networks.parameters():
            parameter.add_(1.0)
    assert not any(equal(followed.parameters(), targets.parameters()))
    critics = targets if kind is SoftActorQ else targets.critics
    assert all(q.normalizer is networks.policy.normalizer for q in critics.members)


def test_q_is_the_smallest_of_the_critics():
    networks = ActorQ(spec_of(), SMALL, SMALL, False, critics=3)
    obs, action = torch.randn(20, 5), torch.rand(20, 2) * 2 - 1
    each = torch.stack([q(obs, action) for q in networks.critics.members])
    assert torch.equal(networks.q(obs, action), each.min(0).values)
    assert len(set(each.argmin(0).tolist())) > 1


def test_the_entropy_bonus_is_the_temperature_times_the_entropy(rng):
    networks = SoftActorQ(spec_of(), SMALL, SMALL, False, critics=2, initial_temperature=0.3)
    obs, again = torch.randn(20, 5), torch.Generator().manual_seed(0)
    bonus = networks.entropy_bonus(obs, rng)
    _, log_prob = networks.policy(obs).sample_with_log_prob(torch.randn(20, 2, generator=again))
    torch.testing.assert_close(bonus, -0.3 * log_prob)
    deterministic = ActorQ(spec_of(), SMALL, SMALL, False, critics=1)
    assert torch.equal(deterministic.entropy_bonus(obs, rng), torch.zeros(20))


def test_discrete_actions_are_refused():
    with pytest.raises(UserError, match="has Discrete actions; this algorithm needs continuous ones"):
        ActorQ(spec_of("discrete"), SMALL, SMALL, False, critics=1)


CAMERAS = (
    ObservationPart(("left",), (20, 20, 3), image=True),
    ObservationPart(("joints",), (2,)),
    ObservationPart(("right",), (36, 40, 1), image=True),
    ObservationPart(("wrist",), (1,)),
)


@pytest.mark.parametrize("kind", [ActorCritic, ActorQ, SoftActorQ])
def test_pictures_go_through_convolutions_beside_normalized_numbers(kind, rng):
    spec = Spec("x", CAMERAS, Box((-1.0,), (1.0,)))
    extra = {"initial_temperature": 0.5} if kind is SoftActorQ else {}
    settings = (SMALL, 0.0, True) if kind is ActorCritic else (SMALL, SMALL, True)
    networks = kind(spec, *settings, **(extra if kind is ActorCritic else {"critics": 2, **extra}))
    pixels = [torch.randint(256, (7, size), generator=rng).float() for size in (1200, 1440)]
    joints, wrist = 5 + 3 * torch.randn(7, 2, generator=rng), torch.randn(7, 1, generator=rng)
    obs = torch.cat([pixels[0], joints, pixels[1], wrist], dim=-1)
    networks.policy.observe(obs)
    seen = networks.policy.normalizer(obs)
    torch.testing.assert_close(seen[:, :1200], pixels[0] / 255 - 0.5)
    torch.testing.assert_close(seen[:, 1202:-1], pixels[1] / 255 - 0.5)
    torch.testing.assert_close(seen[:, 1200:1202].mean(0), torch.zeros(2), atol=1e-5, rtol=0)
    encoder = networks.policy.net[0]
    left, right = (module for module in encoder.encoders if isinstance(module, ImageEncoder))
    features = torch.cat([left(seen[:, :1200]), seen[:, 1200:1202], right(seen[:, 1202:-1]), seen[:, -1:]], dim=-1)
    torch.testing.assert_close(encoder(seen), features)
    assert features.shape == (7, encoder.size)


def test_the_value_may_have_layers_of_its_own():
    networks = ActorCritic(spec_of(), SMALL, critic_layers=Layers((32, 16)))
    assert [layer.out_features for layer in networks.policy.net[::2]] == [8, 2]
    assert [layer.out_features for layer in networks.value.net[::2]] == [32, 16, 1]
