"""Parameters as one vector, and a policy as a function of it."""

import copy

import torch

from helpers import copy_of, small_networks
from lemniscate.optim.adam import ParameterVector, PolicyVector


def test_views_and_join_are_inverse_and_the_module_is_unchanged():
    networks, _ = small_networks()
    before = copy_of(networks.parameters())
    vector = ParameterVector(networks)
    for was, now in zip(before, networks.parameters(), strict=True):
        assert torch.equal(was, now)
        assert isinstance(now, torch.nn.Parameter)
    other = torch.randn_like(vector.vector)
    views = vector.views(other)
    assert {name: view.shape for name, view in views.items()} == {
        name: p.shape for name, p in networks.named_parameters()
    }
    assert torch.equal(vector.join(views), other)
    vector.vector.copy_(other)
    assert all(torch.equal(p, views[name]) for name, p in networks.named_parameters())


def test_a_policy_at_other_parameters_is_the_policy_with_these():
    networks, _ = small_networks()
    policy, obs = networks.policy, torch.randn(6, 5, dtype=torch.float64)
    other = copy.deepcopy(policy)
    vector = PolicyVector(policy)
    theta = torch.randn_like(vector.vector)
    with torch.no_grad():
        for name, parameter in other.named_parameters():
            parameter.copy_(vector.views(theta)[name])
        there, expected = vector.at(theta, obs), other(obs)
        torch.testing.assert_close(there.mean, expected.mean)
        torch.testing.assert_close(there.log_std, expected.log_std)
        assert not torch.allclose(policy(obs).mean, expected.mean)


def test_the_fisher_product_is_the_curvature_of_the_kl():
    networks, _ = small_networks()
    vector, obs = PolicyVector(networks.policy), torch.randn(6, 5, dtype=torch.float64)
    here = vector.vector.clone()

    def kl(theta):
        return vector.at(here, obs).kl(vector.at(theta, obs)).mean()

    hessian = torch.func.hessian(kl)(here)
    direction = torch.randn_like(here)
    torch.testing.assert_close(vector.fisher(direction, obs), hessian @ direction)
