"""Short-Horizon Actor-Critic: Xu et al. 2022, arXiv:2204.07137.

Act for a few steps in a simulator that can be differentiated, let the policy climb the gradient of its return through
these steps, fit the value of what comes after them, discard the rollout.
Departures from the paper, and why: docs/notes/shac.md.
"""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from lemniscate.data.rollout import QBatch, collect, epoch_minibatches
from lemniscate.errors import UserError
from lemniscate.maths import clip_inward, explained_variance, means, q_lambda, reward_to_go, value_loss
from lemniscate.nn.actor_critic import ActorCritic, Value
from lemniscate.nn.normalizer import RewardScale
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam, linear
from lemniscate.run.config import Count, Fraction, LogStd, NumEnvs, Positive, Repeats, Scheduled
from lemniscate.run.on_policy import ActorCriticConfig, OnPolicyState
from lemniscate.run.run import Run
from lemniscate.spec import Spec
from lemniscate.types import Loss, Metrics, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(ActorCriticConfig):
    """The settings of SHAC."""

    differentiates: ClassVar[bool] = True
    """it learns by the gradient through the steps of environments"""

    num_envs: NumEnvs = 32
    """parallel environments, N; usually 16 to 256"""
    num_steps: Count = 32
    """steps of each environment between updates, through which the gradient goes, T; usually 8 to 32"""
    actor_learning_rate: Scheduled[Positive] = 3e-3
    """step size of the policy's Adam; usually 1e-3 to 1e-2"""
    critic_learning_rate: Scheduled[Positive] = 3e-3
    """step size of the value's Adam; usually 1e-3 to 3e-3"""
    final_learning_rate: Fraction = 0.03
    """fraction of both learning rates at the end, linearly; 1: constant"""
    max_grad_norm: Positive | None = 1.0
    """gradient clipping by global norm, usually 0.5 to 1; none: no clipping"""
    max_grad_ratio: Positive = 3.0
    """limit of the gradient by one environment's action, in medians over environments; usually 1 to 10, 1000: none"""
    td_lambda: Fraction = 0.95
    """trace decay λ of the return that the value is fitted to; usually 0.9 to 0.99"""
    critic_epochs: Repeats = 4
    """passes of the value over each rollout; usually 2 to 16"""
    critic_minibatch_size: Count = 256
    """rows of each gradient step of the value; usually 64 to 512"""
    initial_log_std: LogStd = -2.0
    """initial log σ of the policy, in units of half the action range; usually -3 to -1"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_minibatch("critic_minibatch_size")
        if self.shards > 1:
            raise UserError("shards must be 1: a gradient through a simulator is not divided among processes.")


@dataclass(kw_only=True)
class State(OnPolicyState[ActorCritic]):
    """The training state of SHAC."""

    actor_optimizer: Adam
    critic_optimizer: Adam

    def per_step_methods(self) -> list[tuple[object, str]]:
        """None: the policy acts with a gradient in training and without one in evaluation, two programs."""
        return []


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state, seeded by the run's seed."""
    spec.bounded_box()
    networks = config.make_networks(spec, device)
    betas = (0.7, 0.95)
    return State(
        networks=networks,
        actor_optimizer=Adam(networks.policy, betas=betas, max_grad_norm=config.max_grad_norm, name="actor"),
        critic_optimizer=Adam(networks.value, betas=betas, max_grad_norm=config.max_grad_norm, name="value"),
        reward_scale=RewardScale(config.num_envs, config.gamma).to(device),
        rng=config.generators(device),
        learn=learn,
    )


def actor_loss(config: Config, value: Value, _: Policy, rollout: Rollout) -> Loss:
    """−1 / (N T) Σ G, G the return of each episode in the rollout, with the value of what follows (eq. 5).

    Its gradient goes through the simulator: rewards and observations are functions of the policy that acted.
    """
    ends = rollout.terminated, rollout.done
    to_go = reward_to_go(rollout.reward, value(rollout.next_obs), *ends, gamma=config.gamma)
    begins = torch.cat([torch.ones_like(rollout.done[:1]), rollout.done[:-1]])
    loss = -(to_go * begins).sum() / rollout.num_rows
    return loss, {"losses/actor": loss.detach()}


@torch.no_grad()
def targets(config: Config, value: Value, rollout: Rollout) -> QBatch:
    """The rows of a rollout with V(s) and the TD(λ) return that it should say (eq. 7), [B, …]."""
    ends, gamma, lam = (rollout.terminated, rollout.done), config.gamma, config.td_lambda
    target = q_lambda(rollout.reward, value(rollout.next_obs), *ends, gamma=gamma, lam=lam)
    return QBatch(rollout.obs, rollout.action, value(rollout.obs), target).flatten()


def critic_loss(value: Value, batch: QBatch) -> Loss:
    """½ (V(s) − target)² (eq. 6), and its metrics."""
    loss = value_loss(value(batch.obs), batch.target)
    return loss, {"losses/value": loss.detach()}


def learn(config: Config, state: State, batch: QBatch, minibatches: Tensor) -> list[Metrics]:
    """A gradient step of the value on each minibatch, rows [K, M] of the batch."""
    return [state.critic_optimizer.step(critic_loss, batch[rows]) for rows in minibatches]


def update(config: Config, state: State, rollout: Rollout) -> dict[str, Tensor | float]:
    """One step of the policy on one rollout, some epochs of the value; returns the metrics."""
    progress, value = state.step / config.total_steps, state.networks.value
    rate = linear(config.actor_learning_rate, config.final_learning_rate, progress)
    state.actor_optimizer.learning_rate = rate
    state.critic_optimizer.learning_rate = linear(config.critic_learning_rate, config.final_learning_rate, progress)
    if config.scale_rewards:
        rollout = state.reward_scale.scale(rollout)
    metrics = state.actor_optimizer.step(partial(actor_loss, config, value), rollout)
    rollout = rollout.detach()
    batch, rows = targets(config, value, rollout), rollout.valid_rows
    for _ in range(config.critic_epochs):
        minibatches = epoch_minibatches(rows, rollout.num_rows, config.critic_minibatch_size, state.rng.minibatch)
        metrics |= means(state.learn(config, state, batch, minibatches))
    state.policy.observe(rollout.obs)  # last: all of an update sees through the same normalizer
    state.step += config.num_steps * config.num_envs
    explained = explained_variance(batch.value, batch.target)
    return {**metrics, **state.policy.metrics(), "explained_variance": explained, "learning_rate": rate}


def train(config: Config, run: Run) -> State:
    """Algorithm 1: act, differentiate, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    through = partial(clip_inward, max_ratio=config.max_grad_ratio)
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.policy, config.num_steps, state.rng.action, through=through)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
