"""REINFORCE: Williams 1992, "Simple statistical gradient-following algorithms"; Sutton & Barto 2018, chapter 13.

Play, weigh the log-probability of each action by what came of it, take one step.
Departures, and why: docs/notes/reinforce.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from torch import Generator, Tensor

from lemniscate.data.rollout import collect, collect_episodes, minibatches, whole_batch
from lemniscate.errors import UserError
from lemniscate.maths import (
    episode_return,
    explained_variance,
    kl_k3,
    linear,
    policy_gradient,
    reward_to_go,
    standardize,
    value_loss,
)
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.critics import Value
from lemniscate.nn.descent import Descent
from lemniscate.nn.normalizer import RewardScale
from lemniscate.nn.policies import Policy
from lemniscate.run.config import Count, Fraction, Natural, NonNegative, OnPolicyConfig, Positive
from lemniscate.run.run import Run
from lemniscate.run.seeding import generator
from lemniscate.run.state import TrainState
from lemniscate.spec import Spec
from lemniscate.types import Batch, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(OnPolicyConfig):
    """What REINFORCE adds to the knobs of all that learn from rollouts."""

    episodes: Natural = 0
    """whole episodes of each copy between updates; 0 takes num_steps of each, and bootstraps where that cuts one"""
    returns: Literal["whole", "to_go"] = "to_go"
    """what an action is paid with: all that its episode brought, or what followed it"""
    baseline: Literal["none", "mean", "value"] = "value"
    """what is taken off: nothing, the mean of the batch, or a learned V(s)"""
    standardize: bool = True
    """scale what is left to mean 0 and standard deviation 1 within each batch: a mean is a baseline, too"""
    learning_rate: Positive = 3e-3
    """Adam's step size for the policy at the start"""
    final_learning_rate: Fraction = 0.0
    """fraction of learning_rate that it falls to, linearly over the run; 1 keeps it constant"""
    entropy_coef: NonNegative = 0.0
    """weight of an entropy bonus"""
    critic_epochs: Count = 10
    """passes of V over a batch"""
    critic_minibatch_size: Count = 128
    """rows of each of its gradient steps"""
    critic_learning_rate: Positive = 1e-3
    """Adam's step size for V"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.episodes and (self.returns, self.baseline) != ("to_go", "value"):
            raise UserError(
                "A batch of num_steps cuts episodes, and what would have followed only a learned value can say. Choose"
                f" episodes 1 or more, or returns to_go and baseline value, not {self.returns} and {self.baseline}."
            )
        if self.episodes and self.engine == "native":
            raise UserError("Batches of whole episodes differ in size, which the native engine cannot take: use eager.")
        if not self.episodes:
            self._require_rows("standardize", self.num_rows)

    @property
    def gradient_steps(self) -> int:
        """Of the whole run, both networks' together; 0 where batches differ in size and cannot be compiled for."""
        if self.episodes:
            return 0
        return self.num_rollouts * (1 + self.critic_epochs * -(-self.num_rows // self.critic_minibatch_size))


@dataclass
class State(TrainState):
    """Everything a crash may not take from us."""

    networks: ActorCritic
    optimizer: Descent[Policy]
    critic: Descent[Value]
    reward_scale: RewardScale
    noise: Generator
    """what actions are drawn with"""
    shuffle: Generator
    step: int = 0
    """environment steps taken"""


def networks(config: Config, spec: Spec) -> ActorCritic:
    """π and V for the spaces in `spec`."""
    return ActorCritic(spec, config.layers, config.initial_log_std, config.normalize_observations)


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """Fresh networks, fresh optimizers, generators from the run's seed."""
    fresh = networks(config, spec).to(device)
    return State(
        fresh,
        Descent(fresh.policy, partial(policy_loss, config)),
        Descent(fresh.value, critic_loss),
        RewardScale(config.num_envs, config.gamma).to(device),
        noise=generator(config.seed, device, 2),
        shuffle=generator(config.seed, device, 3),
    )


@torch.no_grad()
def outcomes(config: Config, state: State, rollout: Rollout) -> Batch:
    """Row t's log π(a|s), V(s), what weighs it (return minus baseline) and what V should have said."""
    value, next_value = torch.zeros_like(rollout.reward), torch.zeros_like(rollout.reward)
    if config.baseline == "value":
        value, next_value = state.networks.value(rollout.obs), state.networks.value(rollout.next_obs)
    to_go = reward_to_go(rollout.reward, next_value, rollout.terminated, rollout.done, gamma=config.gamma)
    paid = to_go
    if config.returns == "whole":
        paid = episode_return(to_go, rollout.reward, rollout.done | ~rollout.valid, gamma=config.gamma)
    baseline = paid[rollout.valid].mean() if config.baseline == "mean" else value
    log_prob = state.policy(rollout.obs).log_prob(rollout.action)
    return Batch(rollout.obs, rollout.action, log_prob, value, paid - baseline, to_go).flatten()


def policy_loss(config: Config, policy: Policy, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
    """−log π(a|s) (G − b(s)) (Sutton & Barto, eq. 13.11), with an entropy bonus if wanted."""
    distribution = policy(batch.obs)
    weight = standardize(batch.advantage) if config.standardize else batch.advantage
    loss = policy_gradient(distribution.log_prob(batch.action), weight)
    entropy = distribution.entropy().mean()
    return loss - config.entropy_coef * entropy, {"losses/policy": loss.detach(), "losses/entropy": entropy.detach()}


def critic_loss(value: Value, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
    """½ (V(s) − G)²."""
    loss = value_loss(value(batch.obs), batch.target)
    return loss, {"losses/value": loss.detach()}


def update(config: Config, state: State, rollout: Rollout) -> Mapping[str, Tensor | float]:
    """One step of the policy, some epochs of the baseline; returns what was watched."""
    rate = linear(config.learning_rate, config.final_learning_rate, state.step / config.total_steps)
    if config.scale_rewards:
        rollout = state.reward_scale.follow(rollout)
    batch = outcomes(config, state, rollout)
    played = rollout.played
    size = len(played) if config.episodes else rollout.num_rows
    watched = state.optimizer(batch, whole_batch(played, size), rate)
    with torch.no_grad():
        moved = state.policy(batch.obs[played]).log_prob(batch.action[played]) - batch.log_prob[played]
        watched["approx_kl"] = kl_k3(moved)
    for _ in range(config.critic_epochs if config.baseline == "value" else 0):
        parts = minibatches(played, size, config.critic_minibatch_size, state.shuffle)
        watched["losses/value"] = state.critic(batch, parts, config.critic_learning_rate)["losses/value"]
    if config.baseline == "value":
        watched["explained_variance"] = explained_variance(batch.value[played], batch.target[played])
    state.policy.observe(rollout.obs[rollout.valid])  # afterwards: the actions were drawn through the normalizer before
    state.step += rollout.num_rows
    return {**watched, **state.policy.watch(), "learning_rate": rate}


def train(config: Config, run: Run) -> State:
    """Play, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        if config.episodes:
            rollout = collect_episodes(env, state.policy, config.episodes, state.noise)
        else:
            rollout = collect(env, state.policy, config.num_steps, state.noise)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
