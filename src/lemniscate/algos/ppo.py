"""Proximal Policy Optimization: Schulman et al. 2017, arXiv:1707.06347.

Collect a rollout, estimate advantages, take a few epochs of clipped minibatch steps, throw the rollout away.
Departures from the paper, and why: docs/notes/ppo.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Generator, Tensor
from torch.optim import Adam

from lemniscate.data.rollout import collect, minibatches
from lemniscate.errors import UserError
from lemniscate.maths import (
    clip_fraction,
    clipped_surrogate,
    explained_variance,
    gae,
    kl_k1,
    kl_k3,
    standardize,
    value_loss,
)
from lemniscate.nn.descent import descend
from lemniscate.nn.networks import Activation
from lemniscate.nn.policies import GaussianPolicy, Policy, Value, policy_and_value
from lemniscate.run.config import Count, Fraction, NonNegative, Positive, Range, RunConfig
from lemniscate.run.run import Run
from lemniscate.run.seeding import generator
from lemniscate.types import Batch, Rollout, Spec


@dataclass(frozen=True, kw_only=True)
class Config(RunConfig):
    """Every knob of PPO. The defaults are those of the paper's MuJoCo experiments (table 3), for 8 environments."""

    num_steps: Count = 256
    """steps of each copy between updates, T"""
    epochs: Count = 10
    """passes over a rollout, K"""
    num_minibatches: Count = 32
    """equal parts that a rollout is cut into in each epoch"""
    minibatch_size: Count | None = None
    """rows of a minibatch; takes the place of num_minibatches"""
    learning_rate: Positive = 3e-4
    """Adam's step size at the start"""
    final_learning_rate: Fraction = 0.0
    """fraction of learning_rate that it falls to, linearly over the run; 1 keeps it constant"""
    adam_eps: Positive = 1e-5
    """Adam's ε"""
    adam_beta2: Fraction = 0.999
    """Adam's memory of squared gradients; shorter follows a fast run better"""
    gamma: Fraction = 0.99
    """discount γ"""
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
    max_grad_norm: Positive = 0.5
    """global gradient norm that is clipped to"""
    target_kl: Positive | None = None
    """stop the epochs of an update once the approximate KL has passed this"""
    hidden: tuple[Count, ...] = (64, 64)
    """widths of the hidden layers, the same for policy and value"""
    activation: Activation = "tanh"
    """between the layers"""
    initial_log_std: Annotated[float, Range(-10, 5)] = 0.0
    """log σ at the start, in units of half the action range"""
    normalize_observations: bool = True
    """a running normalizer inside the policy"""

    def __post_init__(self) -> None:
        super().__post_init__()
        name = "num_minibatches" if self.minibatch_size is None else "minibatch_size"
        rows, cut = self.num_envs * self.num_steps, getattr(self, name)
        if rows % cut:
            raise UserError(f"{name} must divide num_envs · num_steps = {rows}, and {cut} does not.")
        if rows == self.parts and self.normalize_advantage:
            raise UserError("normalize_advantage needs minibatches of 2 rows or more; these have 1.")

    @property
    def parts(self) -> int:
        """Minibatches in an epoch."""
        return self.num_envs * self.num_steps // self.minibatch_size if self.minibatch_size else self.num_minibatches


@dataclass
class State:
    """Everything a crash may not take from us."""

    policy: Policy
    value: Value
    optimizer: Adam
    noise: Generator
    """what actions are drawn with"""
    shuffle: Generator
    """what minibatches are drawn with"""
    step: int = 0
    """environment steps taken"""


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """Fresh networks, a fresh optimizer, generators from the run's seed."""
    policy, value = policy_and_value(
        spec,
        config.hidden,
        config.activation,
        initial_log_std=config.initial_log_std,
        normalize_observations=config.normalize_observations,
    )
    policy.to(device)
    value.to(device)
    parameters = [*policy.parameters(), *value.parameters()]
    betas = (0.9, config.adam_beta2)
    optimizer = Adam(parameters, lr=config.learning_rate, betas=betas, eps=config.adam_eps, fused=True)
    return State(policy, value, optimizer, generator(config.seed, device, 2), generator(config.seed, device, 3))


@torch.no_grad()
def advantages(config: Config, state: State, rollout: Rollout) -> Batch:
    """Row t's log π_old(a|s), V(s), A (eq. 11) and value target; only the rows that were really played."""
    value, next_value = state.value(rollout.obs), state.value(rollout.next_obs)
    log_prob = state.policy(rollout.obs).log_prob(rollout.action)
    ends = rollout.terminated, rollout.done
    advantage, target = gae(rollout.reward, value, next_value, *ends, gamma=config.gamma, lam=config.gae_lambda)
    return Batch(rollout.obs, rollout.action, log_prob, value, advantage, target)[rollout.valid]  # [T, N] -> [B]


def loss(config: Config, state: State, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of one minibatch, eq. 9 with its sign turned, and what to watch of it."""
    distribution = state.policy(batch.obs)
    log_ratio = distribution.log_prob(batch.action) - batch.log_prob  # log r_t(θ), below eq. 6
    advantage = standardize(batch.advantage) if config.normalize_advantage else batch.advantage
    policy_loss = clipped_surrogate(log_ratio, advantage, config.clip)  # −L^CLIP, eq. 7
    critic_loss = value_loss(state.value(batch.obs), batch.target, batch.value, config.clip_value)  # L^VF, eq. 9
    entropy = distribution.entropy().mean()  # S, eq. 9
    total = policy_loss + config.value_coef * critic_loss - config.entropy_coef * entropy  # −L^CLIP+VF+S, eq. 9
    log_ratio = log_ratio.detach()
    return total, {
        "losses/policy": policy_loss.detach(),
        "losses/value": critic_loss.detach(),
        "losses/entropy": entropy.detach(),
        "approx_kl": kl_k3(log_ratio),
        "old_approx_kl": kl_k1(log_ratio),
        "clip_fraction": clip_fraction(log_ratio, config.clip),
    }


def update(config: Config, state: State, rollout: Rollout) -> Mapping[str, Tensor | float]:
    """K epochs of minibatch steps on one rollout (algorithm 1); returns the means of what was watched."""
    batch = advantages(config, state, rollout)
    parameters = [*state.policy.parameters(), *state.value.parameters()]
    learning_rate = anneal(config, state.step)
    for group in state.optimizer.param_groups:
        group["lr"] = learning_rate
    watched: list[dict[str, Tensor]] = []
    for parts in minibatches(len(batch), config.parts, config.epochs, state.shuffle):
        for rows in parts:
            total, metrics = loss(config, state, batch[rows])
            norm = descend(state.optimizer, parameters, total, config.max_grad_norm)
            watched.append({**metrics, "gradient_norm": norm})
        if config.target_kl is not None and watched[-1]["approx_kl"] > config.target_kl:
            break
    state.policy.observe(batch.obs)  # afterwards: old and new probabilities are taken through the same normalizer
    state.step += rollout.num_steps
    means = {name: torch.stack([row[name] for row in watched]).mean() for name in watched[0]}
    if isinstance(state.policy, GaussianPolicy):
        means["policy_std"] = state.policy.log_std.detach().exp().mean()
    explained = explained_variance(batch.value, batch.target)
    return {**means, "explained_variance": explained, "learning_rate": learning_rate}


def anneal(config: Config, step: int) -> float:
    """The learning rate at `step`: linear from learning_rate to its final fraction."""
    progress = min(1.0, step / config.total_steps)
    return config.learning_rate * (1 - (1 - config.final_learning_rate) * progress)


def train(config: Config, run: Run) -> State:
    """Algorithm 1: collect with π_old, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.policy, config.num_steps, state.noise)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
