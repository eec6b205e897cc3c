"""Advantage actor-critic: Mnih et al. 2016, arXiv:1602.01783, synchronous.

Collect a short rollout, take one gradient step on it, discard it.
Departures from the paper, and why: docs/notes/a2c.md.
"""

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from lemniscate.data.rollout import collect, one_minibatch, rows_of
from lemniscate.maths import explained_variance, gae, means, policy_gradient, standardize, value_loss
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.normalizer import RewardScale
from lemniscate.optim.adam import Adam, linear
from lemniscate.run.config import Count, Epsilon, Fraction, LogStd, NonNegative, Positive, Scheduled
from lemniscate.run.on_policy import OnPolicyState, RecurrentConfig
from lemniscate.run.run import Run
from lemniscate.spec import Spec
from lemniscate.types import Batch, Loss, Metrics, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(RecurrentConfig):
    """The settings of A2C."""

    num_steps: Count = 16
    """steps of each environment between updates, T; usually 5 to 32"""
    initial_log_std: LogStd = -1.0
    """initial log σ of a Gaussian policy, in units of half the action range; usually -1 to 0"""
    learning_rate: Scheduled[Positive] = 1e-3
    """Adam's initial step size; usually 3e-4 to 3e-3"""
    final_learning_rate: Fraction = 0.0
    """final learning rate as a fraction of the initial one, annealed linearly; 1: constant"""
    adam_eps: Epsilon = 1e-5
    """Adam's ε; usually 1e-8 to 1e-5"""
    gae_lambda: Fraction = 0.95
    """trace decay λ of the advantage estimate; 1 is the paper's n-step return, 0 the one-step TD error"""
    normalize_advantage: bool = True
    """standardize advantages within each batch"""
    value_coef: NonNegative = 0.5
    """weight of the value loss; usually 0.25 to 1"""
    entropy_coef: Scheduled[NonNegative] = 0.0
    """weight β of the entropy bonus; usually 0 to 0.01"""
    max_grad_norm: Positive | None = 0.5
    """gradient clipping by global norm, usually 0.5 to 1; none: no clipping"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_rows("normalize_advantage", self.num_rows)


@dataclass(kw_only=True)
class State(OnPolicyState[ActorCritic]):
    """The training state of A2C."""

    optimizer: Adam


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state, seeded by the run's seed."""
    networks = config.make_networks(spec, device)
    return State(
        networks=networks,
        optimizer=Adam(networks, eps=config.adam_eps, max_grad_norm=config.max_grad_norm),
        reward_scale=RewardScale(config.num_envs, config.gamma).to(device),
        rng=config.generators(device),
        learn=learn,
    )


@torch.no_grad()
def advantages(config: Config, networks: ActorCritic, rollout: Rollout) -> Batch:
    """The rows of a rollout with V(s), advantage and value target (section 4; with λ: arXiv:1506.02438, eq. 16)."""
    value, next_value = networks.estimates(rollout.obs, rollout.next_obs)
    gamma, lam = config.gamma, config.gae_lambda
    advantage, target = gae(rollout.reward, value, next_value, rollout.terminated, rollout.done, gamma=gamma, lam=lam)
    batch = Batch(rollout.obs, rollout.action, value, advantage, target)
    return batch.flatten()  # [T, N, …] -> [B, …]


def loss(config: Config, networks: ActorCritic, batch: Batch) -> Loss:
    """−log π(a|s) A − β H + c ½ (V − target)² (section 4), and its metrics."""
    distribution, value = networks(batch.obs)
    policy_loss = policy_gradient(distribution.log_prob(batch.action), batch.advantage)
    critic_loss = value_loss(value, batch.target)
    entropy = distribution.entropy().mean()
    total = policy_loss + config.value_coef * critic_loss - config.entropy_coef * entropy
    return total, {
        "losses/policy": policy_loss.detach(),
        "losses/value": critic_loss.detach(),
        "losses/entropy": entropy.detach(),
    }


def learn(config: Config, state: State, batch: Batch, minibatches: Tensor, advantage: Tensor) -> list[Metrics]:
    """A clipped gradient step on each minibatch, rows [K, M] of the batch; in A2C there is one, the whole batch."""
    metrics = []
    for rows, its_advantage in zip(minibatches, advantage, strict=True):
        minibatch = replace(batch[rows], advantage=its_advantage)
        metrics.append(state.optimizer.step(partial(loss, config), minibatch))
    return metrics


def update(config: Config, state: State, rollout: Rollout) -> dict[str, Tensor | float]:
    """One gradient step on one rollout (algorithm S3, without the threads); returns the metrics."""
    networks = state.networks
    rate = linear(config.learning_rate, config.final_learning_rate, state.step / config.total_steps)
    state.optimizer.learning_rate = rate
    config = state.apply_schedules(config) if config.schedules else config
    if config.scale_rewards:
        rollout = state.reward_scale.scale(rollout)
    batch = advantages(config, networks, rollout)
    valid_rows = rollout.valid_rows
    rows = one_minibatch(rows_of(rollout, networks.piece_length), rollout.num_rows)
    advantage = batch.advantage[rows]
    if config.normalize_advantage:
        advantage = standardize(advantage.flatten(1)).view_as(advantage)
    metrics = means(state.learn(config, state, batch, rows, advantage))
    networks.policy.observe(rollout.obs, rollout.valid)  # last: the actions were drawn through the normalizer before
    state.step += config.num_steps * config.num_envs
    explained = explained_variance(batch.value[valid_rows], batch.target[valid_rows])
    return {**metrics, **networks.policy.metrics(), "explained_variance": explained, "learning_rate": rate}


def train(config: Config, run: Run) -> State:
    """Algorithm S3: collect, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.networks.policy, config.num_steps, state.rng.action)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
