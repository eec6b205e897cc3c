"""Soft Actor-Critic with a learned temperature: Haarnoja et al. 2018, arXiv:1812.05905.

Two critics as in TD3; the policy is stochastic, and its entropy is rewarded at the price of a temperature.
Departures from the paper, and why: docs/notes/ddpg.md.
"""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from lemniscate.data.replay import interact
from lemniscate.errors import UserError
from lemniscate.maths import means, polyak, td_target
from lemniscate.nn.actor_q import SoftActorQ
from lemniscate.nn.critics import Bins, Critics, Temperature, normalize_units
from lemniscate.nn.normalizer import RewardScale
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam, linear
from lemniscate.run.config import Finite, Positive
from lemniscate.run.off_policy import OffPolicyConfig, OffPolicyState
from lemniscate.run.run import Run
from lemniscate.run.state import ScaledState
from lemniscate.spec import Spec
from lemniscate.types import Flags, Loss, Metrics, Step, Transition


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """The settings of SAC."""

    initial_temperature: Positive = 1.0
    """initial α; it is learned with actor_learning_rate"""
    target_entropy: Finite | None = None
    """H̄ in nats, at which the temperature aims, over actions in [-1, 1]^A; none: −A"""
    value_range: Positive | None = None
    """half-width of Q's bins in std of the return, usually 5 to 20; none: Q is a number"""
    unit_weights: bool = False
    """keep each unit's weights in Q at length 1"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.unit_weights and not (self.value_range and self.network == "layer_norm" and self.critic_hidden):
            raise UserError("unit_weights needs a value_range, network layer_norm and hidden layers of the critics.")

    def networks(self, spec: Spec) -> SoftActorQ:
        """New networks for the spaces in `spec`: π, Q₁, Q₂ and α."""
        bins = None if self.value_range is None else Bins(self.value_range, scaled=True)
        own = {"critics": 2, "initial_temperature": self.initial_temperature, "bins": bins}
        return SoftActorQ(spec, *self.network_settings, **own)


@dataclass(kw_only=True)
class State(OffPolicyState[SoftActorQ], ScaledState[SoftActorQ]):
    """The training state of SAC; `targets` are Q'₁ and Q'₂."""

    actor_optimizer: Adam
    critic_optimizer: Adam
    temperature_optimizer: Adam

    def move_bins(self, bins: Bins, step: Step) -> None:
        """Let the bins of Q follow the rewards of one more step of the environments."""
        rows = step.reward, step.terminated | step.truncated, step.valid
        self.reward_scale.update(*(row[None] for row in rows))
        bins.observe(self.reward_scale)

    def on_warm_start(self) -> None:
        """Copy the loaded networks into the targets, and go on with the scale of their bins."""
        super().on_warm_start()
        if self.networks.bins is not None:
            scale = self.reward_scale
            scale.mean, scale.var, scale.count = self.networks.bins.moments.clone().unbind()


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state with an empty replay buffer, seeded by the run's seed."""
    networks = config.make_networks(spec, device)
    if config.unit_weights:
        normalize_units(networks.critics)
    return State(
        networks=networks,
        targets=networks.target(),
        actor_optimizer=Adam(networks.policy, name="actor"),
        critic_optimizer=Adam(networks.critics, name="critic"),
        temperature_optimizer=Adam(networks.temperature, name="temperature"),
        replay=config.make_replay(spec, device),
        action_noise=config.make_action_noise(spec, device),
        reward_scale=RewardScale(config.num_envs, config.gamma).to(device),
        rng=config.generators(device),
        learn=learn,
    )


def critic_loss(config: Config, state: State, critics: Critics, batch: Transition, noise: Tensor) -> Loss:
    """Σ_i of the loss of Q_i(s, a), y = r + γ (min_i Q'_i(s', a') − α log π(a'|s')), a' ~ π(·|s') (eq. 5 and 3)."""
    next_action, log_prob = state.networks.policy(batch.next_obs).sample_with_log_prob(noise)
    next_value = state.targets(batch.next_obs, next_action).amin(0) - state.networks.temperature() * log_prob
    target = td_target(batch.reward, next_value, batch.terminated, gamma=config.gamma).detach()
    (loss_1, q), (loss_2, _) = (each.loss(batch.obs, batch.action, target) for each in critics.members)
    loss = loss_1 + loss_2
    return loss, {"losses/critic": loss.detach(), "q": q.detach().mean()}


def actor_loss(state: State, policy: Policy, batch: Transition, noise: Tensor) -> Loss:
    """α log π(a|s) − min_i Q_i(s, a), a ~ π(·|s) (eq. 7), and its metrics."""
    action, log_prob = policy(batch.obs).sample_with_log_prob(noise)
    loss = (state.networks.temperature().detach() * log_prob - state.networks.critics(batch.obs, action).amin(0)).mean()
    return loss, {"losses/actor": loss.detach(), "losses/entropy": -log_prob.detach().mean()}


def temperature_loss(config: Config, temperature: Temperature, entropy: Tensor, size: int) -> Loss:
    """α (H − H̄), H the policy's entropy on the minibatch, over A = `size` coordinates (eq. 18), and its metrics."""
    target_entropy = -size if config.target_entropy is None else config.target_entropy
    alpha = temperature()
    return alpha * (entropy - target_entropy), {"temperature": alpha.detach()}


def learn(
    config: Config, state: State, replay: Transition, minibatches: Tensor, noise: Tensor, *, update_actor: Flags
) -> list[Metrics]:
    """A gradient step of both Q on each minibatch, rows [K, M] of `replay`; where `update_actor`, of π and α."""
    metrics = []
    for k, rows in enumerate(minibatches):
        batch = replay[rows]
        metrics.append(state.critic_optimizer.step(partial(critic_loss, config, state), batch, noise[k, 0]))
        if update_actor[k]:
            actor = state.actor_optimizer.step(partial(actor_loss, state), batch, noise[k, 1])
            entropy, size = actor["losses/entropy"], batch.action.shape[-1]
            metrics += [actor, state.temperature_optimizer.step(partial(temperature_loss, config), entropy, size)]
            polyak([*state.targets.parameters()], [*state.networks.critics.parameters()], config.tau)
    return metrics


def update(config: Config, state: State) -> Metrics:
    """The gradient steps after a step of the environments; returns the means of the metrics."""
    progress = state.step / config.total_steps
    state.critic_optimizer.learning_rate = linear(config.critic_learning_rate, config.final_learning_rate, progress)
    state.actor_optimizer.learning_rate = linear(config.actor_learning_rate, config.final_learning_rate, progress)
    state.temperature_optimizer.learning_rate = linear(config.actor_learning_rate, config.final_learning_rate, progress)
    minibatches = state.replay.sample_indices(config.num_updates, config.batch_size, state.rng.minibatch)
    noise = state.networks.policy.draw_noise((2, *minibatches.shape), state.rng.action).transpose(0, 1)  # [K, 2, M, A]
    update_actor = tuple((state.updates + k) % config.policy_delay == 0 for k in range(1, config.num_updates + 1))
    state.updates += config.num_updates
    metrics = state.learn(config, state, state.replay.transitions, minibatches, noise, update_actor=update_actor)
    if config.unit_weights:
        normalize_units(state.networks.critics)
    return means(metrics)


def train(config: Config, run: Run) -> State:
    """Algorithm 1: act, store, learn, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        metrics: list[Metrics] = []
        for _ in run.steps(config.log_every):
            policy, random = state.networks.policy, state.step < config.learning_starts
            step = interact(env, policy, state.replay, state.action_noise, state.rng.action, random=random)
            if bins := state.networks.bins:
                state.move_bins(bins, step)
            state.step += config.num_envs
            due = state.step % (config.num_envs * config.update_every) == 0
            if due and state.step > config.learning_starts and len(state.replay):
                metrics.append(update(config, state))
        run.log(state, means(metrics), env.take_episodes())
    return state
