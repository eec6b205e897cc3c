"""Relative Entropy Pathwise Policy Optimization: Voelcker et al. 2025, arXiv:2507.11019.

Collect a rollout, let Q learn its soft λ-returns, let the policy climb Q within a KL bound, discard the rollout.
Departures from the paper, and why: docs/notes/reppo.md.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from lemniscate.data.rollout import SoftBatch, collect, epoch_minibatches, rows_of
from lemniscate.maths import cross_entropy, explained_variance, hl_gauss, means, soft_lambda_return
from lemniscate.nn.actor_q import ActorCategoricalQ, Multipliers
from lemniscate.nn.critics import CategoricalQ
from lemniscate.nn.networks import Activation
from lemniscate.nn.normalizer import RewardScale
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam, linear
from lemniscate.run.config import Count, Finite, Fraction, NumEnvs, Positive, Repeats, Scheduled, SquashedLogStd, Width
from lemniscate.run.on_policy import OnPolicyState, RecurrentConfig
from lemniscate.run.run import Run
from lemniscate.spec import Spec
from lemniscate.types import Loss, Metrics, Rollout


@dataclass(frozen=True, kw_only=True)
class Config(RecurrentConfig):
    """The settings of REPPO."""

    num_envs: NumEnvs = 64
    """parallel environments, N; usually 32 to 1024"""
    num_steps: Count = 64
    """steps of each environment between updates, T; usually 32 to 128"""
    gamma: Fraction = 0.98
    """discount factor γ; usually 0.97 to 0.995"""
    epochs: Repeats = 8
    """passes over each rollout; usually 4 to 8"""
    minibatch_size: Count = 256
    """rows of each gradient step, M; at most N · T, usually 256 to 2048"""
    learning_rate: Scheduled[Positive] = 1e-3
    """Adam's initial step size, of all networks; usually 3e-4 to 1e-3"""
    final_learning_rate: Fraction = 0.1
    """final learning rate as a fraction of the initial one, annealed linearly; 1: constant"""
    max_grad_norm: Positive | None = 0.5
    """gradient clipping by global norm, usually 0.5 to 1; none: no clipping"""
    td_lambda: Fraction = 0.95
    """trace decay λ of the soft return, usually 0.9 to 0.99; 0 is one-step TD, 1 Monte Carlo"""
    max_kl: Scheduled[Positive] = 0.2
    """ε, the KL from the policy that collected beyond which a row only brings it back; usually 0.1 to 0.5"""
    target_entropy: Finite | None = None
    """H̄ in nats, the entropy that the temperature aims at, over actions in [-1, 1]^A; none: −A"""
    min_temperature: Fraction = 0.0
    """the least α, what a nat of entropy is worth even above H̄, in units of scaled rewards; usually 0 to 0.003"""
    value_range: Positive = 10.0
    """the bins of Q's distribution cover [-value_range, value_range], in units of scaled rewards; usually 5 to 20"""
    hidden: tuple[Width, ...] = (128, 128)
    """widths of the policy's hidden layers; usually 2 or 3 of 64 to 512"""
    initial_log_std: SquashedLogStd = -1.0
    """initial log σ of the policy before its tanh; usually -1.5 to -0.5"""
    activation: Activation = "silu"
    """activation function between the layers"""
    symmetry: Literal["auto", "on", "off"] = "off"
    """also learn from mirrored steps; auto: where robots can be mirrored"""
    network: str = "layer_norm"
    """mlp, layer_norm, simba, gru (with a memory), or module:Class"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_minibatch("minibatch_size")

    def networks(self, spec: Spec) -> ActorCategoricalQ:
        """New networks for the spaces in `spec`: π, Q, α and β."""
        memory = self.piece_length, self.shared_memory
        return ActorCategoricalQ(spec, *self.network_settings, self.initial_log_std, self.value_range, *memory)


@dataclass(kw_only=True)
class State(OnPolicyState[ActorCategoricalQ]):
    """The training state of REPPO."""

    actor_optimizer: Adam
    critic_optimizer: Adam
    multiplier_optimizer: Adam


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state, seeded by the run's seed."""
    networks = config.make_networks(spec, device)
    return State(
        networks=networks,
        actor_optimizer=Adam(networks.policy, max_grad_norm=config.max_grad_norm, name="actor"),
        critic_optimizer=Adam(networks.critic, max_grad_norm=config.max_grad_norm, name="critic"),
        multiplier_optimizer=Adam(networks.multipliers, name="multipliers"),
        reward_scale=RewardScale(config.num_envs, config.gamma).to(device),
        rng=config.generators(device),
        learn=learn,
    )


@torch.no_grad()
def targets(config: Config, state: State, rollout: Rollout) -> SoftBatch:
    """The rows of a rollout with Q(s, a), the soft λ-return that it should say, and π_old(·|s), [B, …]."""
    noise = state.policy.draw_noise(rollout.reward.shape, state.rng.action)
    q, next_q, next_log_prob, *old = state.networks.estimates(rollout.obs, rollout.next_obs, rollout.action, noise)
    bonus = -state.networks.multipliers()[0] * next_log_prob
    ends, gamma, lam = (rollout.terminated, rollout.done), config.gamma, config.td_lambda
    target = soft_lambda_return(rollout.reward, next_q, bonus, *ends, gamma=gamma, lam=lam)
    return SoftBatch(rollout.obs, rollout.action, q, target, *old).flatten()  # [B, …]


def critic_loss(critic: CategoricalQ, batch: SoftBatch) -> Loss:
    """Cross-entropy of the target's probabilities and Q's, over the bins."""
    loss = cross_entropy(critic.logits(batch.obs, batch.action), hl_gauss(batch.target, critic.bins.edges))
    return loss, {"losses/critic": loss.detach()}


def actor_loss(config: Config, state: State, policy: Policy, batch: SoftBatch, noise: Tensor) -> Loss:
    """Row by row α log π(a|s) − Q(s, a), a ~ π(·|s), where KL(π_old ‖ π) < ε; elsewhere β KL. And its metrics."""
    distribution = policy(batch.obs)
    action, log_prob = distribution.sample_with_log_prob(noise)
    kl = batch.kl_to(distribution)
    alpha, beta = state.networks.multipliers().detach()
    soft_value = state.networks.critic(batch.obs, action) - alpha * log_prob
    loss = torch.where(kl < config.max_kl, -soft_value, beta * kl).mean()
    metrics = {"losses/actor": loss.detach(), "losses/entropy": -log_prob.detach().mean(), "kl": kl.detach().mean()}
    return loss, {**metrics, "beyond_max_kl": (kl.detach() >= config.max_kl).float().mean()}


def multiplier_loss(config: Config, multipliers: Multipliers, entropy: Tensor, kl: Tensor, size: int) -> Loss:
    """α (H − H̄) + β (ε − KL), H and KL of the minibatch, over A = `size` coordinates, and its metrics."""
    target_entropy = -size if config.target_entropy is None else config.target_entropy
    alpha, beta = multipliers()
    loss = alpha * (entropy - target_entropy) + beta * (config.max_kl - kl)
    return loss, {"temperature": alpha.detach(), "kl_weight": beta.detach()}


def learn(config: Config, state: State, batch: SoftBatch, minibatches: Tensor, noise: Tensor) -> list[Metrics]:
    """A gradient step of Q, of π, and of α and β, on each minibatch, rows [K, M] of the batch, noise [K, M, A]."""
    metrics = []
    for rows, its_noise in zip(minibatches, noise, strict=True):
        minibatch = batch[rows]
        critic = state.critic_optimizer.step(critic_loss, minibatch)
        actor = state.actor_optimizer.step(partial(actor_loss, config, state), minibatch, its_noise)
        reached = actor["losses/entropy"], actor["kl"], minibatch.action.shape[-1]
        multipliers = state.multiplier_optimizer.step(partial(multiplier_loss, config), *reached)
        state.networks.multipliers.keep_temperature_above(config.min_temperature)
        metrics.append({**critic, **actor, **multipliers})
    return metrics


def update(config: Config, state: State, rollout: Rollout) -> dict[str, Tensor | float]:
    """Some epochs of minibatch steps on one rollout; returns the means of the metrics."""
    rate = linear(config.learning_rate, config.final_learning_rate, state.step / config.total_steps)
    for optimizer in state.optimizers():
        optimizer.learning_rate = rate
    config = state.apply_schedules(config) if config.schedules else config
    if config.scale_rewards:
        rollout = state.reward_scale.scale(rollout)
    batch, rows, metrics = targets(config, state, rollout), rows_of(rollout, state.networks.piece_length), []
    for _ in range(config.epochs):
        minibatches = epoch_minibatches(rows, rollout.num_rows, config.minibatch_size, state.rng.minibatch)
        noise = state.policy.draw_noise(minibatches.shape, state.rng.action)  # [K, M, A]
        metrics.append(means(state.learn(config, state, batch, minibatches, noise)))
    state.policy.observe(rollout.obs, rollout.valid)  # last: the KL compares policies behind the same normalizer
    state.step += config.num_steps * config.num_envs
    explained = explained_variance(batch.value[rollout.valid_rows], batch.target[rollout.valid_rows])
    return {**means(metrics), "explained_variance": explained, "learning_rate": rate}


def train(config: Config, run: Run) -> State:
    """Collect with π_old, update, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        rollout = collect(env, state.networks.policy, config.num_steps, state.rng.action)
        run.log(state, update(config, state, rollout), env.take_episodes())
    return state
