"""SHAC: the gradient through the steps against differences, the value's targets, and a world whose best return is known."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from own_simulator import Glide
from torch.nn.utils import parameters_to_vector, vector_to_parameters

import lemniscate as lem
from helpers import CPU, spec_of
from lemniscate.algos import shac
from lemniscate.data.rollout import collect
from lemniscate.envs.vec_env import VecEnv
from lemniscate.maths import clip_inward, q_lambda
from lemniscate.spec import Box, ObservationPart, Spec

BACKEND = "own_simulator:Glide"


class Short(Glide):
    """With episodes that end in the middle of rollouts, in both ways: outside of 0.6 at once."""

    def step(self, action):
        step = super().step(action)
        far = step.next_obs[:, :2].detach().norm(dim=-1) > 0.6
        self._state = torch.where(far[:, None], self._starts(), step.obs)
        return replace(step, obs=self._state, terminated=step.terminated | far, truncated=step.truncated & ~far)


class Broken(Glide):
    """Whose reward has no derivative."""

    def step(self, action):
        step = super().step(action)
        return replace(step, reward=step.reward + (0 * step.next_obs).square().sum(-1).sqrt())


class Cut(Glide):
    """Whose reward has lost its history."""

    def step(self, action):
        return super().step(action).detach()


def small(**fields):
    """A Config that takes an update in a moment."""
    defaults = {"env": "Glide-v0", "num_envs": 4, "num_steps": 8, "total_steps": 100_000, "hidden": (8,)}
    return shac.Config(**{**defaults, "critic_minibatch_size": 16, **fields})


@pytest.fixture
def _float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def begin(config, kind=Short):
    """A new state, and its environments."""
    torch.manual_seed(0)
    env = VecEnv(kind("Glide-v0", config.num_envs, CPU, stagger=True))
    state = shac.init(config, env.spec, CPU)
    return state, env


def unchanged(action):
    """Actions as they are, with their whole gradient."""
    return action


def loss_at(config, state, env, seed=3, through=unchanged):
    """The policy's loss on a rollout from the same starts with the same noise, and the rollout."""
    env.restart(seed)
    env._actions = torch.Size((config.num_envs, 2)), torch.get_default_dtype()
    rollout = collect(env, state.policy, config.num_steps, torch.Generator().manual_seed(5), through=through)
    return shac.actor_loss(config, state.networks.value, state.policy, rollout)[0], rollout


@pytest.mark.usefixtures("_float64")
def test_the_gradient_is_that_of_the_return_through_all_steps_and_ends():
    config = small(gamma=0.9, normalize_observations=False)
    state, env = begin(config)
    loss, rollout = loss_at(config, state, env)
    assert rollout.terminated.any()
    assert rollout.truncated.any()
    parameters = list(state.policy.parameters())
    gradient = parameters_to_vector(torch.autograd.grad(loss, parameters))
    theta = parameters_to_vector(parameters).detach()
    for seed in range(3):
        direction = torch.randn(theta.shape, generator=torch.Generator().manual_seed(seed))
        ends = []
        for sign in (1, -1):
            vector_to_parameters(theta + sign * 1e-5 * direction, parameters)
            ends.append(loss_at(config, state, env)[0].item())
        slope = (ends[0] - ends[1]) / 2e-5
        assert slope == pytest.approx((gradient @ direction).item(), rel=1e-5, abs=1e-9)
        assert abs(slope) > 1e-4


def test_a_policy_that_is_out_of_range_everywhere_finds_back():
    config = small()
    state, env = begin(config)
    bias = list(state.policy.parameters())[-1]
    assert bias.shape == (2,)
    bias.data += torch.tensor([5.0, -5.0])
    loss, _ = loss_at(config, state, env)
    assert torch.autograd.grad(loss, bias)[0].tolist() == [0, 0]
    loss, _ = loss_at(config, state, env, through=partial(clip_inward, max_ratio=3.0))
    right, left = torch.autograd.grad(loss, bias)[0]
    assert right > 0 > left


@pytest.mark.usefixtures("_float64")
def test_the_loss_is_the_return_of_every_episode_in_the_rollout():
    config = small(gamma=0.9, num_steps=12)
    state, env = begin(config)
    loss, rollout = loss_at(config, state, env)
    with torch.no_grad():
        value = state.networks.value(rollout.next_obs)
    total = 0.0
    for i in range(4):
        weight = 1.0
        for t in range(12):
            total += weight * rollout.reward[t, i].item()
            weight *= 0.9
            if rollout.truncated[t, i] or (t == 11 and not rollout.terminated[t, i]):
                total += weight * value[t, i].item()
            weight = 1.0 if rollout.done[t, i] else weight
    assert loss.item() == pytest.approx(-total / 48, rel=1e-12)


def test_the_value_is_fitted_to_its_lambda_return():
    config = small(gamma=0.9, td_lambda=0.8)
    state, env = begin(config)
    rollout = loss_at(config, state, env)[1].detach()
    batch = shac.targets(config, state.networks.value, rollout)
    with torch.no_grad():
        value, after = state.networks.value(rollout.obs), state.networks.value(rollout.next_obs)
    target = q_lambda(rollout.reward, after, rollout.terminated, rollout.done, gamma=0.9, lam=0.8)
    torch.testing.assert_close(batch.target, target.flatten())
    torch.testing.assert_close(batch.value, value.flatten())
    loss, _ = shac.critic_loss(state.networks.value, batch)
    torch.testing.assert_close(loss, 0.5 * (batch.value - batch.target).square().mean())


def test_the_policy_moves_by_its_own_return_and_the_value_by_its_error_alone():
    config = small()
    state, env = begin(config)
    rollout = loss_at(config, state, env)[1]
    before = [parameters_to_vector(net.parameters()).clone() for net in (state.policy, state.networks.value)]
    state.actor_optimizer.learning_rate = 0.1
    state.actor_optimizer.step(partial(shac.actor_loss, config, state.networks.value), rollout)
    after = [parameters_to_vector(net.parameters()) for net in (state.policy, state.networks.value)]
    assert not torch.equal(before[0], after[0])
    assert torch.equal(before[1], after[1])


def test_nothing_that_is_kept_can_be_differentiated():
    config = small()
    state, env = begin(config)
    rollout = loss_at(config, state, env)[1]
    assert all(getattr(rollout, name).requires_grad for name in ("obs", "action", "reward", "next_obs"))
    recent = env.recent()
    assert recent is not None
    assert not any(tensor.requires_grad for tensor in vars(recent).values())
    torch.testing.assert_close(recent[-8:].reward, rollout.reward.detach())
    here = env.obs
    assert here.requires_grad
    again = collect(env, state.policy, 8, state.rng.action, through=unchanged)
    assert torch.autograd.grad(again.reward.sum(), here, allow_unused=True)[0] is None
    env.detach()
    plain = collect(env, state.policy, 8, state.rng.action)
    assert not any(tensor.requires_grad for tensor in vars(plain).values())


def best_return(steps=50):
    """The mean return of the best linear feedback from the starts of `Glide`: Riccati's recursion, in float64."""
    a = torch.tensor([[1.0, 0.1], [0.0, 1.0]], dtype=torch.float64)
    b = torch.tensor([[0.01], [0.1]], dtype=torch.float64)
    q, p = torch.eye(2, dtype=torch.float64), torch.zeros(2, 2, dtype=torch.float64)
    for _ in range(steps):
        cost = q + p
        gain = torch.linalg.solve(1.0 + b.T @ cost @ b, b.T @ cost @ a)
        p = a.T @ cost @ (a - b @ gain)
    return -2 / 3 * p[0, 0].item()  # E[x²] = 1/3 in each of two directions


def test_a_learned_policy_is_nearly_the_best_there_is(tmp_path):
    run = lem.train("shac", "Glide-v0", backend=BACKEND, total_steps=60_000, run=tmp_path / "r", progress=False)
    reached = lem.evaluate(run.policy, episodes=500, seed=3).mean_return
    assert best_return() * 1.08 < reached < best_return() * 0.92  # the mean over 500 starts, ± 2 %


def test_what_cannot_be_differentiated_is_refused_in_a_sentence(tmp_path):
    with pytest.raises(lem.UserError, match=r"CartPole-v1 in the backend \w+ cannot be differentiated"):
        lem.train("shac", "CartPole-v1", run=tmp_path / "r", progress=False)
    assert not (tmp_path / "r").exists()
    with pytest.raises(lem.UserError, match="shards must be 1"):
        small(shards=2)
    with pytest.raises(lem.UserError, match="needs continuous ones"):
        shac.init(small(), spec_of("discrete"), CPU)
    with pytest.raises(lem.UserError, match="gru has a memory, with which"):
        shac.init(small(network="gru"), Spec("Glide-v0", (ObservationPart((), (4,)),), Box((-1.0,), (1.0,))), CPU)


def test_rewards_without_a_history_are_refused_in_a_sentence():
    config = small()
    state, env = begin(config, Cut)
    with pytest.raises(lem.UserError, match="The rewards of Cut have no history of the actions, though it says diff"):
        loss_at(config, state, env)


def test_a_derivative_that_is_not_finite_is_named_and_nothing_is_saved(tmp_path):
    fields = {"num_envs": 4, "total_steps": 640, "hidden": (8,), "critic_minibatch_size": 16}
    with pytest.raises(lem.NonFiniteError, match="gradient_norm/actor is nan in the update that ends at step 128"):
        lem.train("shac", "Glide-v0", backend=f"{__name__}:Broken", run=tmp_path / "r", progress=False, **fields)
    assert not list((tmp_path / "r").glob("checkpoints/step-*"))
