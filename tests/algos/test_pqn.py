"""PQN: its targets, its loss, exploration, masks, and Q of worlds whose Q is known."""

import dataclasses

import gymnasium as gym
import numpy as np
import pytest
import torch

import helpers
import lemniscate as lem
import toy
from helpers import CPU, begin, slope, spec_of, vectorize
from lemniscate.algos import pqn
from lemniscate.data.rollout import collect
from lemniscate.errors import UserError
from lemniscate.maths import q_lambda
from lemniscate.run.metrics import read_metrics
from lemniscate.spec import Discrete


def small(env="CartPole-v1", **fields):
    """A Config that takes an update in a moment."""
    return helpers.small(pqn, env, **{"epochs": 2, **fields})


class Arms(toy.Countdown):
    """Two steps; the second pays 1 for action 1, and the first pays 0.5 for action 0; an action of 2 pays −1."""

    def __init__(self, num_envs, mode="DISABLED", **kwargs):
        super().__init__(num_envs, mode, length=2, horizon=None)
        self.single_action_space = gym.spaces.Discrete(3)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)

    def _observe(self):
        return np.stack([self.t == 0, self.t == 1, self.t > 1], axis=1).astype(np.float32)

    def _reward(self, actions):
        return np.where(actions == 2, -1.0, np.where(self.t == 0, 0.5 * (actions == 0), 1.0 * (actions == 1)))


gym.register("Arms-v0", vector_entry_point=lambda **kwargs: Arms(**kwargs))


def test_the_target_is_the_return_of_the_best_next_action():
    config = small(td_lambda=0.8, gamma=0.9, num_steps=40)
    state, env = begin(pqn, config)
    rollout = collect(env, state.policy, 40, state.rng.action)
    assert rollout.terminated.any()
    batch = pqn.targets(config, state.networks, rollout)
    best = state.policy.net(rollout.next_obs).max(-1).values
    target = q_lambda(rollout.reward, best, rollout.terminated, rollout.done, gamma=0.9, lam=0.8)
    torch.testing.assert_close(batch.target, target.flatten())
    taken = state.policy.net(batch.obs)[torch.arange(160), batch.action]
    torch.testing.assert_close(batch.value, taken)


def test_the_loss_is_half_the_squared_error_of_the_actions_taken():
    config = small()
    state, env = begin(pqn, config)
    batch = pqn.targets(config, state.networks, collect(env, state.policy, 8, state.rng.action))
    batch = dataclasses.replace(batch, target=torch.linspace(-2, 2, 32))
    found, metrics = pqn.loss(state.networks, batch)
    taken = state.policy.net(batch.obs)[torch.arange(32), batch.action]
    expected = 0.5 * (taken - batch.target).square().mean()
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(slope(found, state.networks), slope(expected, state.networks))
    torch.testing.assert_close(metrics["losses/critic"], expected.detach())
    torch.testing.assert_close(metrics["q"], taken.mean().detach())


def test_epsilon_falls_linearly_from_one_and_stays():
    config = pqn.Config(total_steps=1000, exploration=0.2, final_epsilon=0.1)
    assert [pqn.epsilon(config, step) for step in (0, 100, 200, 201, 1000, 1100)] == pytest.approx(
        [1, 0.55, 0.1, 0.1, 0.1, 0.1]
    )
    assert pqn.epsilon(config.replace(exploration=0.0), 0) == pytest.approx(0.1)


def test_a_run_explores_less_and_less_also_where_it_was_resumed(tmp_path):
    fields = {
        "num_envs": 4,
        "num_steps": 8,
        "minibatch_size": 16,
        "hidden": (8,),
        "exploration": 0.5,
        "progress": False,
    }
    stop = [lambda step, *_: step >= 96]
    lem.train("pqn", "CartPole-v1", run=tmp_path / "r", total_steps=256, final_epsilon=0.1, callbacks=stop, **fields)
    lem.resume(tmp_path / "r", progress=False)
    found = [line["epsilon"] for line in read_metrics(tmp_path / "r") if "epsilon" in line]
    assert found == pytest.approx([1, 0.775, 0.55, 0.325, 0.1, 0.1, 0.1, 0.1])


def test_the_policy_that_is_evaluated_does_not_explore(rng):
    state, _ = begin(pqn, small())
    obs = torch.randn(500, 4, generator=rng)
    assert state.policy.epsilon == 1
    assert torch.equal(state.policy(obs).mode(), state.policy.net(obs).argmax(-1))
    assert len(state.policy.act(obs, torch.rand(500, generator=rng)).unique()) == 2


def test_actions_that_are_masked_are_never_drawn_and_never_the_maximum(rng):
    spec = dataclasses.replace(spec_of("discrete"), action=Discrete(3, masked=True))
    state = pqn.init(small(), spec, CPU)
    obs = torch.cat([torch.randn(400, 5, generator=rng), torch.tensor([[1.0, 0.0, 1.0]]).expand(400, 3)], dim=1)
    drawn = state.policy.act(obs, torch.rand(400, generator=rng))
    assert set(drawn.tolist()) == {0, 2}
    values = state.policy.net(obs[:, :5])
    _, (best,) = state.networks.estimates(obs[None], obs[None], drawn[None])
    assert (values.argmax(1) == 1).any()
    torch.testing.assert_close(best, values[:, [0, 2]].max(1).values)


def learned_q(lam, last_epsilon):
    """Q of both states after 120 updates, ε 1 in the first half."""
    fields = {"gamma": 0.9, "learning_rate": 1e-2, "scale_rewards": False, "normalize_observations": False}
    config = small("Arms-v0", td_lambda=lam, total_steps=120 * 32, **fields)  # the learning rate ends at 0
    torch.manual_seed(0)
    env = vectorize("Arms-v0")
    state = pqn.init(config, env.spec, CPU)
    for k in range(120):
        state.policy.epsilon.fill_(1.0 if k < 60 else last_epsilon)
        pqn.update(config, state, collect(env, state.policy, 8, state.rng.action))
    return state.policy(torch.eye(3)[:2]).values


def test_one_step_q_learning_finds_the_best_q_from_random_actions():
    """By hand: Q(s₁, ·) = [0, 1, −1]; Q(s₀, ·) = [0.5, 0, −1] + 0.9."""
    expected = torch.tensor([[1.4, 0.9, -0.1], [0.0, 1.0, -1.0]])
    torch.testing.assert_close(learned_q(0.0, 1.0), expected, atol=0.05, rtol=0)


def test_with_lambda_it_is_the_q_of_the_policy_that_collects():
    """Of random actions, at λ = 1: Q(s₀, ·) = [0.5, 0, −1] + 0.9 · (0 + 1 − 1) / 3; of the best ones at the end, 1.4."""
    random, best = learned_q(1.0, 1.0), learned_q(0.9, 0.0)
    torch.testing.assert_close(random[0], torch.tensor([0.5, 0.0, -1.0]), atol=0.15, rtol=0)
    torch.testing.assert_close(best.amax(1), torch.tensor([1.4, 1.0]), atol=0.05, rtol=0)


def test_other_actions_are_refused():
    with pytest.raises(UserError, match="Discrete"):
        pqn.init(small("Pendulum-v1"), spec_of("box"), CPU)
