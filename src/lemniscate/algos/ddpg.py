"""Deep Deterministic Policy Gradient: Lillicrap et al. 2016, arXiv:1509.02971.

Act with noise, store every transition, and after each step move Q towards its target and the policy up Q.
Departures from the paper, and why: docs/notes/ddpg.md.
"""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from lemniscate.data.replay import interact
from lemniscate.maths import means, polyak, td_target, value_loss
from lemniscate.nn.actor_q import ActorQ
from lemniscate.nn.critics import Critics
from lemniscate.nn.policies import Policy
from lemniscate.optim.adam import Adam, linear
from lemniscate.run.config import NonNegative, Scheduled
from lemniscate.run.off_policy import OffPolicyConfig, OffPolicyState
from lemniscate.run.run import Run
from lemniscate.spec import Spec
from lemniscate.types import Flags, Loss, Metrics, Transition


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """The settings of DDPG."""

    noise_std: Scheduled[NonNegative] = 0.1
    """standard deviation of the action noise, in units of half the action range; usually 0.1 to 0.3"""

    def networks(self, spec: Spec) -> ActorQ:
        """New networks for the spaces in `spec`: μ and Q."""
        return ActorQ(spec, *self.network_settings, critics=1)


@dataclass(kw_only=True)
class State(OffPolicyState[ActorQ]):
    """The training state of DDPG; `targets` are μ' and Q'."""

    actor_optimizer: Adam
    critic_optimizer: Adam


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """A new state with an empty replay buffer, seeded by the run's seed."""
    networks = config.make_networks(spec, device)
    return State(
        networks=networks,
        targets=networks.target(),
        actor_optimizer=Adam(networks.policy, name="actor"),
        critic_optimizer=Adam(networks.critics, name="critic"),
        replay=config.make_replay(spec, device),
        action_noise=config.make_action_noise(spec, device),
        rng=config.generators(device),
        learn=learn,
    )


def critic_loss(config: Config, state: State, critics: Critics, batch: Transition) -> Loss:
    """½ (Q(s, a) − y)², y = r + γ Q'(s', μ'(s')) (section 2, eq. 4 and 5), and its metrics."""
    next_action = state.targets.policy(batch.next_obs).mode()
    next_value = state.targets.critics.first(batch.next_obs, next_action)
    target = td_target(batch.reward, next_value, batch.terminated, gamma=config.gamma)
    q = critics.first(batch.obs, batch.action)
    loss = value_loss(q, target)
    return loss, {"losses/critic": loss.detach(), "q": q.detach().mean()}


def actor_loss(state: State, policy: Policy, batch: Transition) -> Loss:
    """−Q(s, μ(s)), whose gradient is the deterministic policy gradient (section 3, eq. 6), and its metrics."""
    loss = -state.networks.critics.first(batch.obs, policy(batch.obs).mode()).mean()
    return loss, {"losses/actor": loss.detach()}


def learn(
    config: Config, state: State, replay: Transition, minibatches: Tensor, *, update_actor: Flags
) -> list[Metrics]:
    """A gradient step of Q on each minibatch, rows [K, M] of `replay`, and where `update_actor`, of μ."""
    metrics = []
    for k, rows in enumerate(minibatches):
        batch = replay[rows]
        metrics.append(state.critic_optimizer.step(partial(critic_loss, config, state), batch))
        if update_actor[k]:
            metrics.append(state.actor_optimizer.step(partial(actor_loss, state), batch))
            polyak([*state.targets.parameters()], [*state.networks.parameters()], config.tau)
    return metrics


def update(config: Config, state: State) -> Metrics:
    """The gradient steps after a step of the environments; returns the means of the metrics."""
    progress = state.step / config.total_steps
    state.critic_optimizer.learning_rate = linear(config.critic_learning_rate, config.final_learning_rate, progress)
    state.actor_optimizer.learning_rate = linear(config.actor_learning_rate, config.final_learning_rate, progress)
    minibatches = state.replay.sample_indices(config.num_updates, config.batch_size, state.rng.minibatch)
    update_actor = tuple((state.updates + k) % config.policy_delay == 0 for k in range(1, config.num_updates + 1))
    state.updates += config.num_updates
    return means(state.learn(config, state, state.replay.transitions, minibatches, update_actor=update_actor))


def train(config: Config, run: Run) -> State:
    """Algorithm 1: act, store, learn, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        metrics: list[Metrics] = []
        for _ in run.steps(config.log_every):
            policy, rng = state.networks.policy, state.rng.action
            random = state.step < config.learning_starts
            noise_std = linear(config.noise_std, 1.0, state.step / config.total_steps)
            interact(env, policy, state.replay, state.action_noise, rng, noise_std=noise_std, random=random)
            state.step += config.num_envs
            due = state.step % (config.num_envs * config.update_every) == 0
            if due and state.step > config.learning_starts and len(state.replay):
                metrics.append(update(config, state))
        run.log(state, means(metrics), env.take_episodes())
    return state
