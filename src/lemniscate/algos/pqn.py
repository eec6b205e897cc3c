"""Parallelised Q-Network: Gallici et al. 2025, arXiv:2407.04811.

Collect a rollout with an ε-greedy policy, let Q learn its λ-returns in a few epochs, discard the rollout. Layer
normalization takes the place of a target network, and many environments that of a replay buffer.
Departures from the paper, and why: docs/notes/pqn.md.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from lemniscate.data.rollout import QBatch, collect, epoch_minibatches
from lemniscate.maths import explained_variance, means, q_lambda, value_loss
from lemniscate.nn.actor_critic import ActionValues
from lemniscate.nn.networks import Activation
from lemniscate.nn.normalizer import RewardScale
from lemniscate.optim.adam import Adam, linear
from lemniscate.run.config import Count, Fraction, NumEnvs, Positive, Repeats, Scheduled, Width
from lemniscate.run.on_policy import OnPolicyConfig, OnPolicyState
from lemniscate.run.run import Run
from lemniscate.spec import Spec
from lemniscate.types import Loss, Metrics, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(OnPolicyConfig):
    """The settings of PQN."""

    num_envs: NumEnvs = 32
    """parallel environments, N; usually 16 to 128"""
    num_steps: Count = 32
    """steps of each environment between updates, T; usually 16 to 64"""
    epochs: Repeats = 4
    """passes over each rollout; usually 2 to 4"""
    minibatch_size: Count = 128
    """rows of each gradient step, M; at most N · T, usually 64 to 256"""
    learning_rate: Scheduled[Positive] = 5e-4
    """Adam's initial step size; usually 1e-4 to 1e-3"""
    final_learning_rate: Fraction = 0.0
    """final learning rate as a fraction of the initial one, annealed linearly; 1: constant"""
    max_grad_norm: Positive | None = 10.0
    """gradient clipping by global norm, usually 1 to 10; none: no clipping"""
    td_lambda: Fraction = 0.8
    """trace decay λ of the return, usually 0.65 to 0.95; 0 is one-step Q-learning, 1 Monte Carlo"""
    final_epsilon: Fraction = 0.05
    """ε after exploration, the share of random actions; usually 0.01 to 0.2"""
    exploration: Fraction = 0.2
    """share of the run in which ε falls linearly from 1 to final_epsilon; usually 0.1 to 0.5"""
    hidden: tuple[Width, ...] = (128, 128)
    """widths of Q's hidden layers; usually 2 of 128 to 512"""
    activation: Activation = "relu"
    """activation function between the layers"""
    network: str = "layer_norm"
    """mlp, layer_norm (the same with layer normalization), simba (residual blocks of one width), or module:Class"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_minibatch("minibatch_size")

    def networks(self, spec: Spec) -> ActionValues:
        """New networks for the spaces in `spec`: Q, and the policy that acts by it."""
        return ActionValues(spec, self.layers, self.normalize_observations)


@dataclass(kw_only=True)
class State(OnPolicyState[ActionValues]):
    """The training state of PQN."""

    optimizer: Adam


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state, seeded by the run's seed."""
    networks = config.make_networks(spec, device)
    return State(
        networks=networks,
        optimizer=Adam(networks, max_grad_norm=config.max_grad_norm),
        reward_scale=RewardScale(config.num_envs, config.gamma).to(device),
        rng=config.generators(device),
        learn=learn,
    )


def epsilon(config: Config, step: int) -> float:
    """ε at a step of the run: from 1 linearly to `final_epsilon`, which it keeps."""
    progress = step / config.total_steps
    return linear(1.0, config.final_epsilon, progress / config.exploration if config.exploration else 1.0)


@torch.no_grad()
def targets(config: Config, networks: ActionValues, rollout: Rollout) -> QBatch:
    """The rows of a rollout with Q(s, a) and the λ-return that it should say, [B, …] (section 4)."""
    q, next_value = networks.estimates(rollout.obs, rollout.next_obs, rollout.action)
    ends, gamma, lam = (rollout.terminated, rollout.done), config.gamma, config.td_lambda
    target = q_lambda(rollout.reward, next_value, *ends, gamma=gamma, lam=lam)
    return QBatch(rollout.obs, rollout.action, q, target).flatten()  # [T, N, …] -> [B, …]


def loss(networks: ActionValues, batch: QBatch) -> Loss:
    """½ (Q(s, a) − G)² (algorithm 1), and its metrics."""
    q = networks.q(batch.obs, batch.action)
    critic_loss = value_loss(q, batch.target)
    return critic_loss, {"losses/critic": critic_loss.detach(), "q": q.detach().mean()}


def learn(config: Config, state: State, batch: QBatch, minibatches: Tensor) -> list[Metrics]:
    """A clipped gradient step on each minibatch, rows [K, M] of the batch."""
    return [state.optimizer.step(loss, batch[rows]) for rows in minibatches]


def update(config: Config, state: State, rollout: Rollout) -> dict[str, Tensor | float]:
    """Some epochs of minibatch steps on one rollout (algorithm 1); returns the means of the metrics."""
    rate = linear(config.learning_rate, config.final_learning_rate, state.step / config.total_steps)
    state.optimizer.learning_rate = rate
    if config.scale_rewards:
        rollout = state.reward_scale.scale(rollout)
    batch = collected = targets(config, state.networks, rollout)
    rows, metrics = rollout.valid_rows, []
    for epoch in range(config.epochs):
        if epoch > 0:
            batch = targets(config, state.networks, rollout)
        minibatches = epoch_minibatches(rows, rollout.num_rows, config.minibatch_size, state.rng.minibatch)
        metrics.append(means(state.learn(config, state, batch, minibatches)))
    state.policy.observe(rollout.obs, rollout.valid)  # last: all targets are seen through the same normalizer
    state.step += config.num_steps * config.num_envs
    explained = explained_variance(collected.value[rows], collected.target[rows])
    return {**means(metrics), **state.policy.metrics(), "explained_variance": explained, "learning_rate": rate}


def train(config: Config, run: Run) -> State:
    """Algorithm 1: collect, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        state.networks.policy.epsilon.fill_(epsilon(config, state.step))
        rollout = collect(env, state.networks.policy, config.num_steps, state.rng.action)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
