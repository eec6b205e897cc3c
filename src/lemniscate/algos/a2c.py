"""Advantage actor-critic: Mnih et al. 2016, arXiv:1602.01783, its copies in step with each other.

Collect a short rollout, take one gradient step on it, throw it away.
Departures from the paper, and why: docs/notes/a2c.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Generator, Tensor

from lemniscate.data.rollout import collect, whole_batch
from lemniscate.maths import explained_variance, gae, linear, policy_gradient, standardize, value_loss
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
    """What A2C adds to the knobs of all that learn from rollouts."""

    num_steps: Count = 8
    """steps of each copy between updates, T"""
    learning_rate: Positive = 7e-4
    """Adam's step size at the start"""
    final_learning_rate: Fraction = 0.0
    """fraction of learning_rate that it falls to, linearly over the run; 1 keeps it constant"""
    adam_eps: Positive = 1e-5
    """Adam's ε"""
    gae_lambda: Fraction = 1.0
    """trace decay λ of the advantage estimate; 1 is the paper's n-step return, 0 the one-step TD error"""
    normalize_advantage: bool = False
    """standardize advantages within each batch"""
    value_coef: NonNegative = 0.5
    """weight of the value loss"""
    entropy_coef: NonNegative = 0.0
    """β, the weight of the entropy bonus"""
    max_grad_norm: Positive | None = 0.5
    """global gradient norm that is clipped to; none leaves it free"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_rows("normalize_advantage", self.num_rows)

    @property
    def gradient_steps(self) -> int:
        """Of the whole run."""
        return self.num_rollouts


@dataclass
class State(TrainState):
    """Everything a crash may not take from us."""

    networks: ActorCritic
    optimizer: Descent[ActorCritic]
    reward_scale: RewardScale
    noise: Generator
    """what actions are drawn with"""
    step: int = 0
    """environment steps taken"""


def networks(config: Config, spec: Spec) -> ActorCritic:
    """π and V for the spaces in `spec`."""
    return ActorCritic(spec, config.layers, config.initial_log_std, config.normalize_observations)


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """Fresh networks, a fresh optimizer, a generator from the run's seed."""
    fresh = networks(config, spec).to(device)
    return State(
        fresh,
        Descent(fresh, partial(loss, config), eps=config.adam_eps, max_grad_norm=config.max_grad_norm),
        RewardScale(config.num_envs, config.gamma).to(device),
        noise=generator(config.seed, device, 2),
    )


@torch.no_grad()
def advantages(config: Config, state: State, rollout: Rollout) -> Batch:
    """Row t's log π(a|s), V(s), A and value target (section 4, with λ: arXiv:1506.02438, eq. 16)."""
    value, next_value = state.networks.value(rollout.obs), state.networks.value(rollout.next_obs)
    log_prob = state.policy(rollout.obs).log_prob(rollout.action)
    outcome = (rollout.reward, value, next_value, rollout.terminated, rollout.done)
    advantage, target = gae(*outcome, gamma=config.gamma, lam=config.gae_lambda)
    return Batch(rollout.obs, rollout.action, log_prob, value, advantage, target).flatten()  # [T, N, …] -> [B, …]


def loss(config: Config, networks: ActorCritic, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
    """−log π(a|s) A − β H + c ½ (V − target)² (section 4), and what to watch of it."""
    distribution = networks.policy(batch.obs)
    advantage = standardize(batch.advantage) if config.normalize_advantage else batch.advantage
    policy_loss = policy_gradient(distribution.log_prob(batch.action), advantage)
    critic_loss = value_loss(networks.value(batch.obs), batch.target)
    entropy = distribution.entropy().mean()
    total = policy_loss + config.value_coef * critic_loss - config.entropy_coef * entropy
    return total, {
        "losses/policy": policy_loss.detach(),
        "losses/value": critic_loss.detach(),
        "losses/entropy": entropy.detach(),
    }


def update(config: Config, state: State, rollout: Rollout) -> Mapping[str, Tensor | float]:
    """One gradient step on one rollout (algorithm S3, without the threads); returns what was watched."""
    rate = linear(config.learning_rate, config.final_learning_rate, state.step / config.total_steps)
    if config.scale_rewards:
        rollout = state.reward_scale.follow(rollout)
    batch = advantages(config, state, rollout)
    played = rollout.played
    seen = state.optimizer(batch, whole_batch(played, rollout.num_rows), rate)
    state.policy.observe(rollout.obs[rollout.valid])  # afterwards: the actions were drawn through the normalizer before
    state.step += rollout.num_rows
    explained = explained_variance(batch.value[played], batch.target[played])
    return {**seen, **state.policy.watch(), "explained_variance": explained, "learning_rate": rate}


def train(config: Config, run: Run) -> State:
    """Algorithm S3: collect, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
