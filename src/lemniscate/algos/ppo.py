"""Proximal Policy Optimization: Schulman et al. 2017, arXiv:1707.06347.

Collect a rollout, estimate advantages, take a few epochs of clipped minibatch steps, discard the rollout.
Departures from the paper, and why: docs/notes/ppo.md.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import torch
from torch import Tensor

from lemniscate.data.rollout import collect, epoch_minibatches, rows_of
from lemniscate.maths import (
    clipped_surrogate,
    explained_variance,
    gae,
    means,
    ratio_statistics,
    standardize,
    value_loss,
)
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.normalizer import RewardScale
from lemniscate.optim.adam import Adam, adapt_to_kl, linear
from lemniscate.run.config import Count, Epsilon, Fraction, NonNegative, Positive, Range, Repeats, Scheduled
from lemniscate.run.on_policy import OnPolicyState, RecurrentConfig
from lemniscate.run.run import Run
from lemniscate.spec import Spec
from lemniscate.types import DrawnBatch, Loss, Metrics, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(RecurrentConfig):
    """The settings of PPO."""

    epochs: Repeats = 10
    """passes over each rollout; usually 3 to 15"""
    minibatch_size: Count = 256
    """rows of each gradient step, M; at most N · T, usually 64 to 1024"""
    learning_rate: Scheduled[Positive] = 3e-4
    """Adam's initial step size; usually 1e-4 to 1e-3"""
    final_learning_rate: Fraction = 0.0
    """final learning rate as a fraction of the initial one, annealed linearly; not used with desired_kl"""
    desired_kl: Scheduled[Positive] | None = 0.01
    """adapt the learning rate, by factors of 1.5, to this KL of an epoch; usually 0.005 to 0.02; none: anneal it"""
    adam_eps: Epsilon = 1e-5
    """Adam's ε; usually 1e-8 to 1e-5"""
    adam_beta2: Annotated[float, Range(0, 0.999999)] = 0.999
    """Adam's decay of squared gradients; usually 0.99 to 0.999"""
    gae_lambda: Fraction = 0.95
    """trace decay λ of the advantage estimate, usually 0.9 to 1; 0 is one-step TD, 1 Monte Carlo"""
    clip: Scheduled[Positive] = 0.2
    """clip range ε of the probability ratio; usually 0.1 to 0.3"""
    clip_value: Scheduled[Positive] | None = None
    """clip range of the value around its old prediction; none: no clipping"""
    value_coef: NonNegative = 1.0
    """weight c₁ of the value loss; usually 0.25 to 1"""
    entropy_coef: Scheduled[NonNegative] = 0.0
    """weight c₂ of the entropy bonus; usually 0 to 0.01"""
    normalize_advantage: bool = True
    """standardize advantages within each minibatch"""
    max_grad_norm: Positive | None = 1.0
    """gradient clipping by global norm, usually 0.5 to 1; none: no clipping"""
    target_kl: Positive | None = None
    """end an update's epochs once the approximate KL exceeds this; usually 0.01 to 0.05"""
    recompute_advantages: bool = True
    """estimate the advantages again before each epoch, with the present value network"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_minibatch("minibatch_size")
        self._require_rows("normalize_advantage", self.minibatch_size)
        self._require_constant("learning_rate", adapted_by="desired_kl")


@dataclass(kw_only=True)
class State(OnPolicyState[ActorCritic]):
    """The training state of PPO."""

    optimizer: Adam
    learning_rate: float


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state, seeded by the run's seed."""
    networks = config.make_networks(spec, device)
    betas = (0.9, config.adam_beta2)
    return State(
        networks=networks,
        optimizer=Adam(networks, betas=betas, eps=config.adam_eps, max_grad_norm=config.max_grad_norm),
        learning_rate=linear(config.learning_rate, 1.0, progress=0.0),
        reward_scale=RewardScale(config.num_envs, config.gamma).to(device),
        rng=config.generators(device),
        learn=learn,
    )


@torch.no_grad()
def advantages(config: Config, networks: ActorCritic, rollout: Rollout, log_prob: Tensor | None = None) -> DrawnBatch:
    """The rows of a rollout with V(s), advantage (eq. 11), value target and log π_old(a|s), [B, …].

    `log_prob` is the last of these, of all rows, where it is known already.
    """
    value, next_value = networks.estimates(rollout.obs, rollout.next_obs)
    log_prob = networks.log_prob(rollout.obs, rollout.action) if log_prob is None else log_prob.view_as(value)
    gamma, lam = config.gamma, config.gae_lambda
    advantage, target = gae(rollout.reward, value, next_value, rollout.terminated, rollout.done, gamma=gamma, lam=lam)
    batch = DrawnBatch(rollout.obs, rollout.action, value, advantage, target, log_prob)
    return batch.flatten()  # [T, N, …] -> [B, …]


def loss(config: Config, networks: ActorCritic, batch: DrawnBatch) -> Loss:
    """The loss of a minibatch [M, …], the negative of eq. 9, and its metrics."""
    distribution, value = networks(batch.obs)
    log_ratio = distribution.log_prob(batch.action) - batch.log_prob  # log r_t(θ), above eq. 6
    policy_loss = clipped_surrogate(log_ratio, batch.advantage, config.clip)  # −L^CLIP, eq. 7
    critic_loss = value_loss(value, batch.target, batch.value, config.clip_value)  # L^VF, eq. 9
    entropy = distribution.entropy().mean()  # S, eq. 9
    total = policy_loss + config.value_coef * critic_loss - config.entropy_coef * entropy  # −L^CLIP+VF+S, eq. 9
    return total, {
        "losses/policy": policy_loss.detach(),
        "losses/value": critic_loss.detach(),
        "losses/entropy": entropy.detach(),
        **ratio_statistics(log_ratio.detach(), config.clip),
    }


def learn(config: Config, state: State, batch: DrawnBatch, minibatches: Tensor, advantage: Tensor) -> list[Metrics]:
    """A clipped gradient step on each minibatch, rows [K, M] of the batch, with its advantages [K, M]."""
    metrics = []
    for rows, its_advantage in zip(minibatches, advantage, strict=True):
        minibatch = replace(batch[rows], advantage=its_advantage)
        metrics.append(state.optimizer.step(partial(loss, config), minibatch))
    return metrics


def update(config: Config, state: State, rollout: Rollout) -> dict[str, Tensor | float]:
    """Some epochs of minibatch steps on one rollout (algorithm 1); returns the means of the metrics."""
    if config.desired_kl is None:
        state.learning_rate = linear(config.learning_rate, config.final_learning_rate, state.step / config.total_steps)
    config = state.apply_schedules(config) if config.schedules else config
    if config.scale_rewards:
        rollout = state.reward_scale.scale(rollout)
    batch = collected = advantages(config, state.networks, rollout)
    valid_rows, rows = rollout.valid_rows, rows_of(rollout, state.networks.piece_length)
    metrics: list[Metrics] = []
    for epoch in range(config.epochs):
        if config.recompute_advantages and epoch > 0:
            batch = advantages(config, state.networks, rollout, collected.log_prob)
        minibatches = epoch_minibatches(rows, rollout.num_rows, config.minibatch_size, state.rng.minibatch)
        advantage = batch.advantage[minibatches]
        if config.normalize_advantage:
            advantage = standardize(advantage.flatten(1)).view_as(advantage)
        state.optimizer.learning_rate = state.learning_rate
        metrics.append(means(state.learn(config, state, batch, minibatches, advantage)))
        kl = metrics[-1]["approx_kl"].item()
        if config.desired_kl is not None:
            state.learning_rate = adapt_to_kl(state.learning_rate, kl, config.desired_kl)
        if config.target_kl is not None and kl > config.target_kl:
            break
    state.networks.policy.observe(rollout.obs, rollout.valid)  # last: old and new probabilities share a normalizer
    state.step += config.num_steps * config.num_envs
    return {
        **means(metrics),
        **state.networks.policy.metrics(),
        "learning_rate": state.learning_rate,
        "explained_variance": explained_variance(collected.value[valid_rows], collected.target[valid_rows]),
    }


def train(config: Config, run: Run) -> State:
    """Algorithm 1: collect with π_old, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.networks.policy, config.num_steps, state.rng.action)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
