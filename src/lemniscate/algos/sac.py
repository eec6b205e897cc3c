"""Soft Actor-Critic with a temperature that is learned: Haarnoja et al. 2018, arXiv:1812.05905.

Twin critics as in TD3; but the policy is random by itself, and is paid for being so.
Departures from the paper, and why: docs/notes/ddpg.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import torch
from torch import Generator, Tensor, nn

from lemniscate.data.action_noise import ActionNoise
from lemniscate.data.replay import ReplayBuffer
from lemniscate.envs.vec_env import VecEnv
from lemniscate.maths import linear, means, polyak, td_target, uniform, value_loss
from lemniscate.nn.actor_critic import ActorQ
from lemniscate.nn.critics import TwinQ
from lemniscate.nn.descent import Descent
from lemniscate.nn.joint import Joint
from lemniscate.run.config import Count, OffPolicyConfig, Positive, Range
from lemniscate.run.run import Run
from lemniscate.run.seeding import generator
from lemniscate.run.state import TrainState
from lemniscate.spec import Spec
from lemniscate.types import Transition


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """What SAC adds to the knobs of all that learn from memory."""

    policy_delay: Count = 1
    """gradient steps of Q for each of the policy, the temperature and the targets"""
    initial_temperature: Positive = 1.0
    """α at the start; it learns with the policy's step size"""
    target_entropy: Annotated[float, Range()] | None = None
    """H̄ in nats, which the temperature steers to, over actions in [-1, 1]^A; none is −A"""


@dataclass
class State(TrainState):
    """Everything a crash may not take from us."""

    networks: ActorQ
    targets: TwinQ
    """Q'₁ and Q'₂: copies that follow slowly"""
    actor_descent: Descent[nn.ModuleList]
    critic_descent: Descent[TwinQ]
    replay: ReplayBuffer
    action_noise: ActionNoise
    noise: Generator
    """what actions are drawn with"""
    draws: Generator
    """what minibatches are drawn with"""
    updates: int = 0
    """gradient steps of Q taken"""
    step: int = 0
    """environment steps taken"""

    def __post_init__(self) -> None:
        self.joint = Joint(learn, self.actor_descent, self.critic_descent)


def networks(config: Config, spec: Spec) -> ActorQ:
    """π, Q₁ and Q₂ for the spaces in `spec`."""
    layers = config.actor_layers, config.critic_layers
    return ActorQ(spec, *layers, config.normalize_observations, twin=True, temperature=config.initial_temperature)


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """Fresh networks, an empty memory, generators from the run's seed."""
    online = networks(config, spec).to(device)
    targets, actor = online.target().critic, online.actor
    copies, length = (config.num_envs, spec.bounded_box().size), spec.max_episode_steps or 1000
    return State(
        online,
        targets,
        Descent(actor, partial(actor_loss, config, online.critic), watch_as="gradient_norm/actor"),
        Descent(online.critic, partial(critic_loss, config, targets, actor), watch_as="gradient_norm/critic"),
        ReplayBuffer(spec, config.capacity, device),
        ActionNoise(config.noise, copies, length, device, time=config.noise_time, exponent=config.noise_exponent),
        noise=generator(config.seed, device, 2),
        draws=generator(config.seed, device, 3),
    )


@torch.no_grad()
def play(config: Config, state: State, env: VecEnv) -> None:
    """One step of every copy: a ~ π(·|s), or anything at all while warming up."""
    obs, noise = env.obs, state.action_noise(state.noise)
    warming_up = state.step < config.learning_starts
    action = uniform(noise) if warming_up else state.policy.act(obs, noise)
    step = env.step(action)
    state.replay.add(obs, action, step)
    state.action_noise.cut(step.terminated | step.truncated | ~step.valid)
    state.policy.observe(obs[step.valid])
    state.step += env.num_envs


def critic_loss(
    config: Config, targets: TwinQ, actor: nn.ModuleList, critic: TwinQ, batch: Transition, noise: Tensor
) -> tuple[Tensor, dict[str, Tensor]]:
    """Σ_i ½ (Q_i(s, a) − y)², y = r + γ (min_i Q'_i(s', a') − α log π(a'|s')), a' ~ π(·|s') (eq. 5 and 3)."""
    policy, temperature = actor
    next_action, log_prob = policy(batch.next_obs).sample_with_log_prob(noise)
    next_value = targets(batch.next_obs, next_action).amin(0) - temperature() * log_prob
    target = td_target(batch.reward, next_value, batch.terminated, gamma=config.gamma).detach()
    one, two = critic(batch.obs, batch.action)
    loss = value_loss(one, target) + value_loss(two, target)
    return loss, {"losses/critic": loss.detach(), "q": one.detach().mean()}


def actor_loss(
    config: Config, critic: TwinQ, actor: nn.ModuleList, batch: Transition, noise: Tensor
) -> tuple[Tensor, dict[str, Tensor]]:
    """α log π(a|s) − min_i Q_i(s, a), a ~ π(·|s) (eq. 7), and −α (log π(a|s) + H̄) (eq. 18)."""
    policy, temperature = actor
    action, log_prob = policy(batch.obs).sample_with_log_prob(noise)
    alpha, value = temperature(), critic(batch.obs, action).amin(0)
    policy_loss = (alpha.detach() * log_prob - value).mean()
    wanted = -action.shape[-1] if config.target_entropy is None else config.target_entropy
    temperature_loss = -(alpha * (log_prob.detach() + wanted)).mean()
    return policy_loss + temperature_loss, {
        "losses/actor": policy_loss.detach(),
        "losses/entropy": -log_prob.detach().mean(),
        "temperature": alpha.detach(),
    }


def learn(
    config: Config,
    state: State,
    turns: Sequence[bool],
    memory: Transition,
    parts: Tensor,
    next_noise: Tensor,
    noise: Tensor,
) -> list[dict[str, Tensor]]:
    """Gradient steps on the minibatches `parts` [K, M] of `memory` (algorithm 1); at its turns the policy moves too."""
    watched = []
    for k, rows in enumerate(parts):
        batch = memory[rows]
        watched.append(state.critic_descent.step(batch, next_noise[k]))
        if turns[k]:
            watched.append(state.actor_descent.step(batch, noise[k]))
            polyak(state.targets.parameters(), state.networks.critic.parameters(), config.tau)
    return watched


def update(config: Config, state: State) -> Mapping[str, Tensor]:
    """Draw what `learn` needs, and learn; returns the means of what was watched."""
    turns = [(state.updates + k) % config.policy_delay == 0 for k in range(1, config.num_updates + 1)]
    state.updates += config.num_updates
    fall = linear(1.0, config.final_learning_rate, state.step / config.total_steps)
    state.critic_descent.set_learning_rate(fall * config.critic_learning_rate)
    state.actor_descent.set_learning_rate(fall * config.actor_learning_rate)
    memory, parts = state.replay.transitions, state.replay.draw(len(turns), config.batch_size, state.draws)
    next_noise, noise = state.policy.noise((2, *parts.shape), state.noise)
    return state.joint(config, state, turns, memory, parts, next_noise, noise)


def train(config: Config, run: Run) -> State:
    """Algorithm 1: act, remember, learn, repeat."""
    state = run.restore(init(config, run.spec, run.env.device))
    for env in run.until(config.total_steps, state):
        watched: list[Mapping[str, Tensor]] = []
        for _ in range(config.num_steps):
            play(config, state, env)
            if state.step > config.learning_starts and state.step // env.num_envs % config.update_every == 0:
                watched.append(update(config, state))
        run.log(state, means(watched), env.take_episodes())
    return state
