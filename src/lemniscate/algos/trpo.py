"""Trust region policy optimization: Schulman et al. 2015, arXiv:1502.05477.

Collect a rollout, move the policy along the natural gradient as far as a bound on the KL allows, fit the critic.
Departures from the paper, and why: docs/notes/trpo.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Generator, Tensor
from torch.func import grad

from lemniscate.data.rollout import collect, minibatches, whole_batch
from lemniscate.maths import (
    backtrack,
    explained_variance,
    gae,
    linear,
    natural_step,
    standardize,
    surrogate,
    value_loss,
)
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.critics import Value
from lemniscate.nn.descent import Descent
from lemniscate.nn.flat import FlatPolicy
from lemniscate.nn.normalizer import RewardScale
from lemniscate.run.config import Count, Fraction, NonNegative, OnPolicyConfig, Positive, Range
from lemniscate.run.run import Run
from lemniscate.run.seeding import generator
from lemniscate.run.state import TrainState
from lemniscate.spec import Spec
from lemniscate.types import Batch, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(OnPolicyConfig):
    """What TRPO adds to the knobs of all that learn from rollouts."""

    max_kl: Positive = 0.01
    """δ: the mean KL from the old policy to the new that an update may reach"""
    line_search: bool = True
    """shorten the step until it keeps its promises; without it this is the natural policy gradient"""
    shrink: Annotated[float, Range(0.01, 0.99)] = 0.8
    """what a step that does not is multiplied by"""
    attempts: Count = 10
    """how many lengths are tried before the policy stays where it is"""
    cg_iterations: Count = 10
    """of the conjugate gradient"""
    damping: NonNegative = 0.1
    """added to the diagonal of the Fisher matrix"""
    gae_lambda: Fraction = 0.95
    """trace decay λ of the advantage estimate"""
    normalize_advantage: bool = True
    """standardize advantages within each rollout"""
    critic_epochs: Count = 10
    """passes of the critic over a rollout"""
    critic_minibatch_size: Count = 128
    """rows of each of its gradient steps"""
    critic_learning_rate: Positive = 1e-3
    """Adam's step size for the critic at the start"""
    final_critic_learning_rate: Fraction = 1.0
    """fraction of it that it falls to, linearly over the run"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_rows("normalize_advantage", self.num_rows)

    @property
    def gradient_steps(self) -> int:
        """Of the critic in the whole run."""
        return self.num_rollouts * self.critic_epochs * -(-self.num_rows // self.critic_minibatch_size)


@dataclass
class State(TrainState):
    """Everything a crash may not take from us."""

    networks: ActorCritic
    critic: Descent[Value]
    reward_scale: RewardScale
    noise: Generator
    """what actions are drawn with"""
    shuffle: Generator
    step: int = 0
    """environment steps taken"""

    def __post_init__(self) -> None:
        self.parameters = FlatPolicy(self.policy)  # θ


def networks(config: Config, spec: Spec) -> ActorCritic:
    """π and V for the spaces in `spec`."""
    return ActorCritic(spec, config.layers, config.initial_log_std, config.normalize_observations)


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """Fresh networks, a fresh optimizer for the critic, generators from the run's seed."""
    fresh = networks(config, spec).to(device)
    return State(
        fresh,
        Descent(fresh.value, critic_loss),
        RewardScale(config.num_envs, config.gamma).to(device),
        noise=generator(config.seed, device, 2),
        shuffle=generator(config.seed, device, 3),
    )


@torch.no_grad()
def advantages(config: Config, state: State, rollout: Rollout) -> Batch:
    """Row t's log π_old(a|s), V(s), A and value target (arXiv:1506.02438, eq. 16)."""
    value, next_value = state.networks.value(rollout.obs), state.networks.value(rollout.next_obs)
    log_prob = state.policy(rollout.obs).log_prob(rollout.action)
    outcome = (rollout.reward, value, next_value, rollout.terminated, rollout.done)
    advantage, target = gae(*outcome, gamma=config.gamma, lam=config.gae_lambda)
    return Batch(rollout.obs, rollout.action, log_prob, value, advantage, target).flatten()  # [T, N, …] -> [B, …]


def critic_loss(value: Value, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
    """½ (V(s) − target)²."""
    loss = value_loss(value(batch.obs), batch.target)
    return loss, {"losses/value": loss.detach()}


def improve(config: Config, state: State, batch: Batch, obs: Tensor) -> dict[str, Tensor | float]:
    """Maximize L(θ) subject to KL(θ_old ‖ θ) ≤ δ, to first and to second order (eq. 14, appendix C).

    L and the KL are means over `batch`; the Fisher matrix is that at `obs`, as many in every update.
    """
    here, pi = state.parameters.vector.clone(), state.parameters.at
    advantage = standardize(batch.advantage) if config.normalize_advantage else batch.advantage

    def loss(theta: Tensor) -> Tensor:
        return surrogate(pi(theta, batch.obs).log_prob(batch.action) - batch.log_prob, advantage)

    def kl(theta: Tensor) -> Tensor:
        return pi(here, batch.obs).kl(pi(theta, batch.obs)).mean()

    def fisher(vector: Tensor) -> Tensor:
        return state.parameters.fisher(vector, obs) + config.damping * vector

    gradient = grad(loss)(here)
    with torch.no_grad():
        step = natural_step(fisher, gradient, config.max_kl, iterations=config.cg_iterations)
        limits = {"max_kl": config.max_kl, "shrink": config.shrink, "attempts": config.attempts}
        there, fraction = here + step, 1.0
        if config.line_search:
            there, fraction = backtrack(lambda theta: (loss(theta), kl(theta)), here, step, **limits)
        entropy = pi(here, batch.obs).entropy().mean()
        watched = {"losses/policy": loss(there), "losses/entropy": entropy, "kl": kl(there)}
        state.parameters.vector.copy_(there)
    return {**watched, "gradient_norm": gradient.norm(), "step_fraction": fraction}


def update(config: Config, state: State, rollout: Rollout) -> Mapping[str, Tensor | float]:
    """One step of the policy, some epochs of the critic; returns what was watched."""
    rate = linear(config.critic_learning_rate, config.final_critic_learning_rate, state.step / config.total_steps)
    if config.scale_rewards:
        rollout = state.reward_scale.follow(rollout)
    batch = advantages(config, state, rollout)
    played = rollout.played
    obs = batch.obs[whole_batch(played, rollout.num_rows)[0]]
    watched = improve(config, state, batch[played], obs)
    for _ in range(config.critic_epochs):
        parts = minibatches(played, rollout.num_rows, config.critic_minibatch_size, state.shuffle)
        watched["losses/value"] = state.critic(batch, parts, rate)["losses/value"]
    state.policy.observe(rollout.obs[rollout.valid])  # afterwards: both probabilities are taken through one normalizer
    state.step += rollout.num_rows
    explained = explained_variance(batch.value[played], batch.target[played])
    return {**watched, **state.policy.watch(), "explained_variance": explained, "learning_rate": rate}


def train(config: Config, run: Run) -> State:
    """Algorithm 1: collect with π_old, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
