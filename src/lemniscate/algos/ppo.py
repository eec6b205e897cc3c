"""Proximal Policy Optimization: Schulman et al. 2017, arXiv:1707.06347.

Collect a rollout, estimate advantages, take a few epochs of clipped minibatch steps, throw the rollout away.
Departures from the paper, and why: docs/notes/ppo.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Generator, Tensor

from lemniscate.data.rollout import collect, minibatches
from lemniscate.maths import (
    adapt_to_kl,
    clipped_surrogate,
    explained_variance,
    gae,
    linear,
    means,
    ratio_statistics,
    standardize,
    value_loss,
)
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.descent import Descent
from lemniscate.nn.normalizer import RewardScale
from lemniscate.run.config import Count, Fraction, NonNegative, OnPolicyConfig, Positive
from lemniscate.run.run import Run
from lemniscate.run.seeding import generator
from lemniscate.run.state import TrainState
from lemniscate.spec import Spec
from lemniscate.types import Batch, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(OnPolicyConfig):
    """What PPO adds to the knobs of all that learn from rollouts; by default the paper's for MuJoCo (table 3)."""

    epochs: Count = 10
    """passes over a rollout, K"""
    minibatch_size: Count = 64
    """rows of each gradient step, M; at most N · T"""
    learning_rate: Positive = 3e-4
    """Adam's step size at the start"""
    final_learning_rate: Fraction = 0.0
    """fraction of learning_rate that it falls to, linearly over the run; 1 keeps it constant"""
    desired_kl: Positive | None = None
    """adapt the learning rate, by a factor of 1.5, to updates of about this KL; takes the place of the fall"""
    adam_eps: Positive = 1e-5
    """Adam's ε"""
    adam_beta2: Fraction = 0.999
    """Adam's memory of squared gradients; shorter follows a fast run better"""
    gae_lambda: Fraction = 0.95
    """trace decay λ of the advantage estimate; 0 is one-step TD, 1 Monte Carlo"""
    clip: Positive = 0.2
    """ε: how far the probability ratio may move before its gradient stops"""
    clip_value: Positive | None = None
    """how far a value may move from where it was at collection; none leaves it free"""
    value_coef: NonNegative = 0.5
    """c₁, the weight of the value loss"""
    entropy_coef: NonNegative = 0.0
    """c₂, the weight of the entropy bonus"""
    normalize_advantage: bool = True
    """standardize advantages within each minibatch"""
    max_grad_norm: Positive | None = 0.5
    """global gradient norm that is clipped to; none leaves it free"""
    target_kl: Positive | None = None
    """stop the epochs of an update once the approximate KL has passed this"""
    recompute_advantages: bool = False
    """estimate advantages anew before each epoch, with the value network as it is by then"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_rows("normalize_advantage", min(self.minibatch_size, self.num_rows))

    @property
    def gradient_steps(self) -> int:
        """Of the whole run."""
        return self.num_rollouts * self.epochs * -(-self.num_rows // self.minibatch_size)


@dataclass
class State(TrainState):
    """Everything a crash may not take from us."""

    networks: ActorCritic
    optimizer: Descent[ActorCritic]
    reward_scale: RewardScale
    noise: Generator
    """what actions are drawn with"""
    shuffle: Generator
    learning_rate: float
    step: int = 0
    """environment steps taken"""


def networks(config: Config, spec: Spec) -> ActorCritic:
    """π and V for the spaces in `spec`."""
    return ActorCritic(spec, config.layers, config.initial_log_std, config.normalize_observations)


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """Fresh networks, a fresh optimizer, generators from the run's seed."""
    fresh = networks(config, spec).to(device)
    betas, limit = (0.9, config.adam_beta2), config.max_grad_norm
    return State(
        fresh,
        Descent(fresh, partial(loss, config), betas=betas, eps=config.adam_eps, max_grad_norm=limit),
        RewardScale(config.num_envs, config.gamma).to(device),
        noise=generator(config.seed, device, 2),
        shuffle=generator(config.seed, device, 3),
        learning_rate=config.learning_rate,
    )


@torch.no_grad()
def advantages(config: Config, state: State, rollout: Rollout) -> Batch:
    """Row t's log π_old(a|s), V(s), A (eq. 11) and value target."""
    value, next_value = state.networks.value(rollout.obs), state.networks.value(rollout.next_obs)
    log_prob = state.policy(rollout.obs).log_prob(rollout.action)
    outcome = (rollout.reward, value, next_value, rollout.terminated, rollout.done)
    advantage, target = gae(*outcome, gamma=config.gamma, lam=config.gae_lambda)
    return Batch(rollout.obs, rollout.action, log_prob, value, advantage, target).flatten()  # [T, N, …] -> [B, …]


def loss(config: Config, networks: ActorCritic, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of one minibatch, eq. 9 with its sign turned, and what to watch of it."""
    distribution = networks.policy(batch.obs)
    log_ratio = distribution.log_prob(batch.action) - batch.log_prob  # log r_t(θ), below eq. 6
    advantage = standardize(batch.advantage) if config.normalize_advantage else batch.advantage
    policy_loss = clipped_surrogate(log_ratio, advantage, config.clip)  # −L^CLIP, eq. 7
    critic_loss = value_loss(networks.value(batch.obs), batch.target, batch.value, config.clip_value)  # L^VF, eq. 9
    entropy = distribution.entropy().mean()  # S, eq. 9
    total = policy_loss + config.value_coef * critic_loss - config.entropy_coef * entropy  # −L^CLIP+VF+S, eq. 9
    return total, {
        "losses/policy": policy_loss.detach(),
        "losses/value": critic_loss.detach(),
        "losses/entropy": entropy.detach(),
        **ratio_statistics(log_ratio.detach(), config.clip),
    }


def update(config: Config, state: State, rollout: Rollout) -> Mapping[str, Tensor | float]:
    """K epochs of minibatch steps on one rollout (algorithm 1); returns the means of what was watched."""
    if config.desired_kl is None:
        state.learning_rate = linear(config.learning_rate, config.final_learning_rate, state.step / config.total_steps)
    if config.scale_rewards:
        rollout = state.reward_scale.follow(rollout)
    batch = collected = advantages(config, state, rollout)
    played = rollout.played
    watched: list[Mapping[str, Tensor]] = []
    for epoch in range(config.epochs):
        if config.recompute_advantages and epoch > 0:
            batch = replace(advantages(config, state, rollout), log_prob=collected.log_prob)
        parts = minibatches(played, rollout.num_rows, config.minibatch_size, state.shuffle)
        watched.append(state.optimizer(batch, parts, state.learning_rate))
        kl = watched[-1]["approx_kl"].item()
        if config.desired_kl is not None:
            state.learning_rate = adapt_to_kl(state.learning_rate, kl, config.desired_kl)
        if config.target_kl is not None and kl > config.target_kl:
            break
    state.policy.observe(rollout.obs[rollout.valid])  # afterwards: both probabilities are taken through one normalizer
    state.step += rollout.num_rows
    seen = means(watched) | state.policy.watch() | {"learning_rate": state.learning_rate}
    return seen | {"explained_variance": explained_variance(collected.value[played], collected.target[played])}


def train(config: Config, run: Run) -> State:
    """Algorithm 1: collect with π_old, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
