"""An algorithm of one's own: PPO with a penalty on the KL in place of the clip (arXiv:1707.06347, eq. 8).

    cd examples
    lemniscate train own_algorithm --env CartPole-v1 --total-steps 30_000 --beta 2
    python own_algorithm.py

A module needs `Config` and `train`; with `State`, `init` and `update` beside them, `lemniscate.testing` checks it. It
gets the command line, presets, checkpoints, exact resume, evaluation, sweeps and plots.
"""

import sys
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

import lemniscate as lem
from lemniscate.algos.ppo import advantages
from lemniscate.data.rollout import collect, epoch_minibatches
from lemniscate.maths import kl_k3, means, standardize, surrogate, value_loss
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.normalizer import RewardScale
from lemniscate.optim.adam import Adam
from lemniscate.presets import Preset
from lemniscate.run.config import Count, Fraction, NonNegative, Positive
from lemniscate.run.on_policy import ActorCriticConfig, OnPolicyState
from lemniscate.run.run import Run
from lemniscate.spec import Spec
from lemniscate.types import DrawnBatch, Loss, Metrics, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(ActorCriticConfig):
    """The settings of PPO with a KL penalty."""

    beta: NonNegative = 3.0
    """weight β of the KL from the old policy to the new one; usually 0.5 to 10"""
    epochs: Count = 10
    """passes over each rollout; usually 3 to 15"""
    minibatch_size: Count = 256
    """rows of each gradient step; usually 64 to 1024"""
    learning_rate: Positive = 1e-3
    """Adam's step size; usually 1e-4 to 1e-3"""
    gae_lambda: Fraction = 0.95
    """trace decay λ of the advantage estimate; usually 0.9 to 1"""

    @property
    def gradient_steps(self) -> int:
        """The number of gradient steps of the whole run."""
        return self.num_rollouts * self.epochs * -(-self.num_rows // self.minibatch_size)


@dataclass(kw_only=True)
class State(OnPolicyState):
    """The training state."""

    optimizer: Adam


PRESETS = [Preset("careful", Config(env="CartPole-v1", beta=10.0), "an example, not tuned", "2026-11")]


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state, seeded by the run's seed."""
    networks = config.make_networks(spec, device)
    optimizer = Adam(networks, max_grad_norm=1.0)
    optimizer.learning_rate = config.learning_rate
    return State(
        networks=networks,
        optimizer=optimizer,
        reward_scale=RewardScale(config.num_envs, config.gamma).to(device),
        rng=config.generators(device),
        learn=learn,
    )


def loss(config: Config, networks: ActorCritic, batch: DrawnBatch) -> Loss:
    """−r A + β KL(π_old ‖ π) + ½ (V − target)² (eq. 8, with the value's loss), and its metrics."""
    log_ratio = networks.policy(batch.obs).log_prob(batch.action) - batch.log_prob
    policy_loss, kl = surrogate(log_ratio, batch.advantage), kl_k3(log_ratio)
    critic_loss = value_loss(networks.value(batch.obs), batch.target)
    return policy_loss + config.beta * kl + critic_loss, {
        "losses/policy": policy_loss.detach(),
        "losses/value": critic_loss.detach(),
        "approx_kl": kl.detach(),
    }


def learn(config: Config, state: State, batch: DrawnBatch, minibatches: Tensor, advantage: Tensor) -> list[Metrics]:
    """A gradient step on each minibatch, rows [K, M] of the batch, with its standardized advantages [K, M]."""
    steps = (replace(batch[rows], advantage=a) for rows, a in zip(minibatches, advantage, strict=True))
    return [state.optimizer.step(partial(loss, config), minibatch) for minibatch in steps]


def update(config: Config, state: State, rollout: Rollout) -> Metrics:
    """Some epochs of minibatch steps on one rollout; returns the means of the metrics."""
    if config.scale_rewards:
        rollout = state.reward_scale.scale(rollout)
    batch, valid_rows = advantages(config, state.networks, rollout), rollout.valid_rows
    metrics: list[Metrics] = []
    for _ in range(config.epochs):
        minibatches = epoch_minibatches(valid_rows, rollout.num_rows, config.minibatch_size, state.rng.minibatch)
        advantage = standardize(batch.advantage[minibatches])
        metrics.append(means(state.learn(config, state, batch, minibatches, advantage)))
    state.networks.policy.observe(rollout.obs, rollout.valid)
    state.step += config.num_rows
    return means(metrics)


def train(config: Config, run: Run) -> State:
    """Collect, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.networks.policy, config.num_steps, state.rng.action)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state


if __name__ == "__main__":
    trained = lem.train(sys.modules[__name__], env="CartPole-v1", total_steps=30_000)
    print(lem.evaluate(trained.policy, episodes=20).mean_return)
