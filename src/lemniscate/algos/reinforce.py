"""REINFORCE: Williams 1992, "Simple statistical gradient-following algorithms"; Sutton & Barto 2018, chapter 13.

Collect, weight the log-probability of each action by the return that followed it, take one gradient step.
Departures, and why: docs/notes/reinforce.md.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal

import torch
from torch import Tensor

from lemniscate.data.rollout import collect, collect_episodes, epoch_minibatches, one_minibatch
from lemniscate.errors import UserError
from lemniscate.maths import (
    episode_return,
    explained_variance,
    kl_k3,
    means,
    policy_gradient,
    reward_to_go,
    standardize,
    value_loss,
)
from lemniscate.nn.actor_critic import ActorCritic, Value
from lemniscate.nn.normalizer import RewardScale
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam, linear
from lemniscate.run.config import Count, Fraction, LogStd, NonNegative, NumEnvs, Positive, Range, Repeats, Scheduled
from lemniscate.run.on_policy import ActorCriticConfig, OnPolicyState
from lemniscate.run.run import Run
from lemniscate.spec import Spec
from lemniscate.types import Batch, Loss, Metrics, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(ActorCriticConfig):
    """The settings of REINFORCE."""

    num_envs: NumEnvs = 8
    """number of parallel environments, N; usually 8 to 64"""
    num_steps: Count = 256
    """steps of each environment between updates, T; usually 128 to 2048"""
    initial_log_std: LogStd = 0.0
    """initial log σ of a Gaussian policy, in units of half the action range; usually -1 to 0"""
    scale_rewards: bool = False
    """divide rewards by the running standard deviation of the discounted return"""
    episodes: Annotated[int, Range(0, 10_000)] = 0
    """whole episodes of each environment between updates; 0: num_steps steps, bootstrapped where they end"""
    returns: Literal["episode", "to_go"] = "to_go"
    """return used as weight: of the whole episode, or the reward-to-go"""
    baseline: Literal["none", "mean", "value"] = "value"
    """baseline subtracted from the return: none, the mean of the batch, or a learned V(s)"""
    standardize: bool = True
    """standardize the weights within each batch; subtracting their mean is a baseline, too"""
    learning_rate: Scheduled[Positive] = 3e-3
    """initial step size of the policy's Adam; usually 1e-3 to 1e-2"""
    final_learning_rate: Fraction = 0.0
    """final learning rate as a fraction of the initial one, annealed linearly; 1: constant"""
    entropy_coef: Scheduled[NonNegative] = 0.0
    """weight of the entropy bonus; usually 0 to 0.01"""
    critic_epochs: Repeats = 10
    """passes of the value over each batch; usually 5 to 80"""
    critic_minibatch_size: Count = 128
    """rows of each gradient step of the value; usually 64 to 512"""
    critic_learning_rate: Scheduled[Positive] = 1e-3
    """step size of the value's Adam; usually 3e-4 to 3e-3"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.episodes and (self.returns, self.baseline) != ("to_go", "value"):
            cut = f"returns {self.returns}, baseline {self.baseline} need whole episodes, which num_steps cuts"
            raise UserError(f"{cut}: use episodes 1 or more, or returns to_go and baseline value.")
        if self.episodes and self.shards > 1:
            raise UserError("Batches of whole episodes differ in size and cannot be divided: shards must be 1.")
        if self.episodes and self.compile == "on":
            raise UserError("Batches of whole episodes differ in size and cannot be compiled: use --compile off.")
        if not self.episodes:
            self._require_minibatch("critic_minibatch_size")
            self._require_rows("standardize", self.num_rows)

    @property
    def gradient_steps(self) -> int:
        """The number of gradient steps of the whole run; 0 where batches differ in size and cannot be compiled for."""
        critic_steps = self.critic_epochs * -(-self.num_rows // self.critic_minibatch_size)
        return 0 if self.episodes else self.num_rollouts * (1 + critic_steps)


@dataclass(kw_only=True)
class State(OnPolicyState[ActorCritic]):
    """The training state of REINFORCE."""

    optimizer: Adam
    critic_optimizer: Adam


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state, seeded by the run's seed."""
    networks = config.make_networks(spec, device)
    return State(
        networks=networks,
        optimizer=Adam(networks.policy),
        critic_optimizer=Adam(networks.value, name="value"),
        reward_scale=RewardScale(config.num_envs, config.gamma).to(device),
        rng=config.generators(device),
        learn=learn,
    )


@torch.no_grad()
def weights(config: Config, networks: ActorCritic, rollout: Rollout) -> Batch:
    """The rows of a rollout with V(s), weight (return minus baseline) and value target, [B, …]."""
    value, next_value = networks.estimates(rollout.obs, rollout.next_obs)
    if config.baseline != "value":
        value, next_value = torch.zeros_like(value), torch.zeros_like(value)
    to_go = reward_to_go(rollout.reward, next_value, rollout.terminated, rollout.done, gamma=config.gamma)
    ended = rollout.done | ~rollout.valid
    weight = to_go if config.returns == "to_go" else episode_return(to_go, rollout.reward, ended, gamma=config.gamma)
    baseline = weight[rollout.valid].mean() if config.baseline == "mean" else value
    return Batch(rollout.obs, rollout.action, value, weight - baseline, to_go).flatten()


def policy_loss(config: Config, policy: Policy, batch: Batch) -> Loss:
    """−log π(a|s) (G − b(s)) (Sutton & Barto, eq. 13.11) less an entropy bonus, and its metrics."""
    distribution = policy(batch.obs)
    loss = policy_gradient(distribution.log_prob(batch.action), batch.advantage)
    entropy = distribution.entropy().mean()
    return loss - config.entropy_coef * entropy, {"losses/policy": loss.detach(), "losses/entropy": entropy.detach()}


def critic_loss(value: Value, batch: Batch) -> Loss:
    """½ (V(s) − G)², and its metrics."""
    loss = value_loss(value(batch.obs), batch.target)
    return loss, {"losses/value": loss.detach()}


def learn(config: Config, state: State, batch: Batch, minibatches: Tensor, *, update_policy: bool) -> list[Metrics]:
    """A gradient step on each minibatch, rows [K, M] of the batch: of the policy, or of the value."""
    if update_policy:
        return [state.optimizer.step(partial(policy_loss, config), batch[rows]) for rows in minibatches]
    return [state.critic_optimizer.step(critic_loss, batch[rows]) for rows in minibatches]


def update(config: Config, state: State, rollout: Rollout) -> dict[str, Tensor | float]:
    """One step of the policy on one rollout, some epochs of the baseline; returns the metrics."""
    rate = linear(config.learning_rate, config.final_learning_rate, state.step / config.total_steps)
    config = state.apply_schedules(config) if config.schedules else config
    state.optimizer.learning_rate, state.critic_optimizer.learning_rate = rate, config.critic_learning_rate
    if config.scale_rewards:
        rollout = state.reward_scale.scale(rollout)
    batch, valid_rows = weights(config, state.networks, rollout), rollout.valid_rows
    old_log_prob = state.networks.log_prob(rollout.obs, rollout.action).flatten()[valid_rows]
    size = len(valid_rows) if config.episodes else rollout.num_rows
    learned = batch[one_minibatch(valid_rows, size)[0]]
    if config.standardize:
        learned = replace(learned, advantage=standardize(learned.advantage))
    all_rows = torch.arange(size, device=batch.obs.device)[None]
    metrics = means(state.learn(config, state, learned, all_rows, update_policy=True))
    valid = batch[valid_rows]
    metrics["approx_kl"] = kl_k3(state.policy(valid.obs).log_prob(valid.action).detach() - old_log_prob)
    if config.baseline == "value":
        for _ in range(config.critic_epochs):
            minibatches = epoch_minibatches(valid_rows, size, config.critic_minibatch_size, state.rng.minibatch)
            metrics |= means(state.learn(config, state, batch, minibatches, update_policy=False))
        metrics["explained_variance"] = explained_variance(valid.value, valid.target)
    state.policy.observe(rollout.obs, rollout.valid)  # last: the actions were drawn through the normalizer before
    state.step += len(rollout.reward) * config.num_envs
    return {**metrics, **state.policy.metrics(), "learning_rate": rate}


def train(config: Config, run: Run) -> State:
    """Collect, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    gather, amount = (collect_episodes, config.episodes) if config.episodes else (collect, config.num_steps)
    for env in run.until(config.total_steps, state):
        rollout = gather(env, state.networks.policy, amount, state.rng.action)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
