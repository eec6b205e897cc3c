"""Gradients over shards: those of all rows at once, to rounding, in every algorithm's losses."""

import copy
from dataclasses import replace
from functools import partial

import pytest
import torch

from helpers import begin, begin_off_policy, numbers, small, small_networks, small_off_policy, spec_of
from lemniscate.algos import a2c, ppo, reinforce, reppo, sac, trpo
from lemniscate.data.rollout import SoftBatch, collect
from lemniscate.maths import standardize
from lemniscate.optim.adam import Adam
from lemniscate.optim.shards import GradientOverShards, estimates_over_shards
from lemniscate.system.world import World
from lemniscate.types import Rollout, Transition
from threads import in_world


def twins(networks, **fields):
    """Two optimizers of equal networks, the second one over four shards."""
    one, two = (Adam(copy.deepcopy(networks), **fields) for _ in range(2))
    two.over_shards = GradientOverShards(two, World(4), None)
    for optimizer in (one, two):
        optimizer.learning_rate = 0.01
    return one, two


def require_equal(one, two, loss, *args):
    for _ in range(3):
        a, b = (optimizer.step(loss, *args) for optimizer in (one, two))
        assert a.keys() == b.keys()
        for name in a:
            torch.testing.assert_close(a[name].double(), b[name].double(), rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(one.vector, two.vector, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("actions", ["box", "discrete"])
def test_a_step_over_four_shards_is_one_over_all_rows(actions):
    networks, config = small_networks(actions, entropy_coef=0.1)
    batch = numbers(actions)
    batch = replace(batch, advantage=standardize(batch.advantage))
    require_equal(*twins(networks, max_grad_norm=0.1), partial(ppo.loss, config), batch)


def test_the_gradient_of_each_shard_is_computed_with_its_rows_alone():
    networks, config = small_networks()
    sizes = []

    def loss(networks, batch, scale):
        sizes.append(len(batch.obs))
        total, metrics = ppo.loss(config, networks, batch)
        return scale * total, metrics

    _, two = twins(networks)
    two.step(loss, numbers(), 2.0)
    assert sizes == [6] * 4


def test_the_critics_of_sac_too(rng):
    config = small_off_policy(sac, critic_hidden=(8,))
    state, _ = begin_off_policy(sac, config)
    batch = Transition(
        **{n: x.double() if x.is_floating_point() else x for n, x in vars(state.replay.transitions[:48]).items()}
    )
    state.networks.double(), state.targets.double()
    noise = torch.randn(48, 1, generator=rng, dtype=torch.float64)
    require_equal(*twins(state.networks.critics), partial(sac.critic_loss, config, state), batch, noise)


def test_the_losses_of_reppo_too(rng):
    config = reppo.Config(num_envs=4, num_steps=12, minibatch_size=24, hidden=(8,), max_kl=0.1)
    torch.manual_seed(0)
    state = reppo.init(config, spec_of(), torch.device("cpu"))
    state.networks.double()
    obs, action, mean, log_std = (torch.randn(48, n, generator=rng, dtype=torch.float64) for n in (5, 2, 2, 2))
    noise, value, target = torch.randn(48, 2, generator=rng, dtype=torch.float64), *torch.randn(2, 48, generator=rng)
    batch = SoftBatch(obs, action.tanh(), value.double(), target.double(), mean, log_std / 3 - 0.5)
    require_equal(*twins(state.networks.critic), reppo.critic_loss, batch)
    require_equal(*twins(state.networks.policy), partial(reppo.actor_loss, config, state), batch, noise)


@pytest.mark.parametrize("size", [2, 4])
def test_any_number_of_processes_has_the_same_gradient_to_the_last_bit(size, rng):
    networks, config = small_networks(entropy_coef=0.1)
    batch, weight = numbers(), torch.rand(24, generator=rng)  # a record of rows, and a tensor of them

    def loss(networks, batch, weight):
        return ppo.loss(config, networks, replace(batch, advantage=weight * batch.advantage))

    def step(world):
        optimizer = Adam(copy.deepcopy(networks))
        optimizer.learning_rate = 0.01
        optimizer.over_shards = GradientOverShards(optimizer, world, None)
        return optimizer.step(loss, batch, weight), optimizer.vector

    ((metrics, vector),) = in_world(4, 1, step)
    for theirs, other in in_world(4, size, step):
        assert torch.equal(vector, other)
        assert {name: x.item() for name, x in theirs.items()} == {name: x.item() for name, x in metrics.items()}


@pytest.mark.parametrize("size", [1, 2, 4])
def test_estimates_are_those_of_all_rows_in_every_process(size, rng):
    def function(x, y):
        return x.sum(-1), (x * y[..., None]).sum(-1)

    rows = torch.randn(3, 8, 5, generator=rng), torch.randn(3, 8, generator=rng)
    expected = function(*rows)
    for found in in_world(4, size, lambda world: estimates_over_shards(function, world)(*rows)):
        assert all(map(torch.equal, found, expected))


FIELDS = {
    ppo: {"minibatch_size": 64, "epochs": 2, "normalize_observations": True, "desired_kl": 0.01},
    a2c: {"scale_rewards": True},
    trpo: {"critic_minibatch_size": 64, "critic_epochs": 2, "cg_iterations": 3},  # more of them magnify rounding
    reinforce: {"critic_minibatch_size": 64, "critic_epochs": 2, "scale_rewards": True},
}


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("algo", FIELDS)
def test_updates_over_four_shards_are_those_over_all_rows(algo, dtype, rtol):
    """Where all rows are one minibatch, so that the order of the rows is nobody's."""
    config = small(algo, "Pendulum-v1", num_envs=8, num_steps=8, **FIELDS[algo])
    states = [begin(algo, c)[0] for c in (config, config.replace(shards=4))]
    _, env = begin(algo, config)
    for state in states:
        state.networks.to(dtype)
    states[0], states[1] = (rebuilt(algo, config, state, dtype) for state in states)
    states[1].prepare(World(4), None)
    for _ in range(3):
        rollout = collect(
            env,
            states[0].policy.float() if dtype is torch.float32 else Acting(states[0].policy),
            8,
            states[0].rng.action,
        )
        wide = Rollout(*(x.to(dtype) if x.is_floating_point() else x for x in vars(rollout).values()))
        for state in states:
            algo.update(config, state, wide)
        one, two = (torch.cat([p.flatten() for p in state.networks.parameters()]) for state in states)
        torch.testing.assert_close(one, two, rtol=rtol, atol=10 * rtol)
        norms = [state.policy.normalizer.state_dict() for state in states]
        for name in norms[0]:
            torch.testing.assert_close(norms[0][name], norms[1][name], rtol=rtol, atol=rtol)


class Acting:
    """A policy in float64, as the environments see it."""

    def __init__(self, policy):
        self.policy, self.draw_noise = policy, policy.draw_noise

    def act(self, obs, noise):
        return self.policy.act(obs.double(), noise.double()).float()


def rebuilt(algo, config, state, dtype):
    """The state with optimizers of the networks as they are now."""
    torch.manual_seed(0)
    for name, value in vars(state).items():
        if isinstance(value, Adam):
            fresh = Adam(value.networks, max_grad_norm=getattr(config, "max_grad_norm", None))
            fresh.learning_rate = 0.01
            setattr(state, name, fresh)
    if algo is trpo:
        state.__post_init__()
    return state
