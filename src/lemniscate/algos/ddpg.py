"""Deep Deterministic Policy Gradient: Lillicrap et al. 2016, arXiv:1509.02971.

Act with noise, remember every transition, and after each step move Q towards its target and the policy up Q.
Departures from the paper, and why: docs/notes/ddpg.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Generator, Tensor, nn

from lemniscate.data.action_noise import ActionNoise
from lemniscate.data.replay import ReplayBuffer
from lemniscate.envs.vec_env import VecEnv
from lemniscate.maths import linear, means, polyak, td_target, uniform, value_loss
from lemniscate.nn.actor_critic import ActorQ
from lemniscate.nn.descent import Descent
from lemniscate.nn.joint import Joint
from lemniscate.nn.policies import Policy
from lemniscate.run.config import Count, NonNegative, OffPolicyConfig
from lemniscate.run.run import Run
from lemniscate.run.seeding import generator
from lemniscate.run.state import TrainState
from lemniscate.spec import Spec
from lemniscate.types import Transition


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """What DDPG adds to the knobs of all that learn from memory."""

    policy_delay: Count = 1
    """gradient steps of Q for each of the policy and of the targets"""
    noise_std: NonNegative = 0.1
    """standard deviation of the noise on actions, in units of half the action range"""


@dataclass
class State(TrainState):
    """Everything a crash may not take from us."""

    networks: ActorQ
    targets: ActorQ
    """μ' and Q': copies that follow slowly"""
    actor_descent: Descent[Policy]
    critic_descent: Descent[nn.Module]
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
    """μ and Q for the spaces in `spec`."""
    layers = config.actor_layers, config.critic_layers
    return ActorQ(spec, *layers, config.normalize_observations, twin=False)


def init(config: Config, spec: Spec, device: torch.device) -> State:
    """Fresh networks, an empty memory, generators from the run's seed."""
    online = networks(config, spec).to(device)
    targets = online.target()
    copies, length = (config.num_envs, spec.bounded_box().size), spec.max_episode_steps or 1000
    return State(
        online,
        targets,
        Descent(online.policy, partial(actor_loss, online.critic), watch_as="gradient_norm/actor"),
        Descent(online.critic, partial(critic_loss, config, targets), watch_as="gradient_norm/critic"),
        ReplayBuffer(spec, config.capacity, device),
        ActionNoise(config.noise, copies, length, device, time=config.noise_time, exponent=config.noise_exponent),
        noise=generator(config.seed, device, 2),
        draws=generator(config.seed, device, 3),
    )


@torch.no_grad()
def play(config: Config, state: State, env: VecEnv) -> None:
    """One step of every copy: a = μ(s) + noise (section 3, eq. 7), or anything at all while warming up."""
    obs, noise = env.obs, state.action_noise(state.noise)
    warming_up = state.step < config.learning_starts
    action = uniform(noise) if warming_up else state.policy.act(obs, config.noise_std * noise)
    step = env.step(action)
    state.replay.add(obs, action, step)
    state.action_noise.cut(step.terminated | step.truncated | ~step.valid)
    state.policy.observe(obs[step.valid])
    state.step += env.num_envs


def critic_loss(
    config: Config, targets: ActorQ, critic: nn.Module, batch: Transition
) -> tuple[Tensor, dict[str, Tensor]]:
    """½ (Q(s, a) − y)², y = r + γ Q'(s', μ'(s')) (section 2, eq. 4 and 5)."""
    next_action = targets.policy(batch.next_obs).mode()
    target = td_target(batch.reward, targets.critic(batch.next_obs, next_action), batch.terminated, gamma=config.gamma)
    value = critic(batch.obs, batch.action)
    loss = value_loss(value, target)
    return loss, {"losses/critic": loss.detach(), "q": value.detach().mean()}


def actor_loss(critic: nn.Module, policy: Policy, batch: Transition) -> tuple[Tensor, dict[str, Tensor]]:
    """−Q(s, μ(s)), whose gradient is the deterministic policy gradient (section 3, eq. 6)."""
    loss = -critic(batch.obs, policy(batch.obs).mode()).mean()
    return loss, {"losses/actor": loss.detach()}


def learn(
    config: Config, state: State, turns: Sequence[bool], memory: Transition, parts: Tensor
) -> list[dict[str, Tensor]]:
    """Gradient steps on the minibatches `parts` [K, M] of `memory` (algorithm 1); at its turns the policy moves too."""
    watched = []
    for k, rows in enumerate(parts):
        batch = memory[rows]
        watched.append(state.critic_descent.step(batch))
        if turns[k]:
            watched.append(state.actor_descent.step(batch))
            polyak(state.targets.parameters(), state.networks.parameters(), config.tau)
    return watched


def update(config: Config, state: State) -> Mapping[str, Tensor]:
    """Draw what `learn` needs, and learn; returns the means of what was watched."""
    turns = [(state.updates + k) % config.policy_delay == 0 for k in range(1, config.num_updates + 1)]
    state.updates += config.num_updates
    fall = linear(1.0, config.final_learning_rate, state.step / config.total_steps)
    state.critic_descent.set_learning_rate(fall * config.critic_learning_rate)
    state.actor_descent.set_learning_rate(fall * config.actor_learning_rate)
    memory, parts = state.replay.transitions, state.replay.draw(len(turns), config.batch_size, state.draws)
    return state.joint(config, state, turns, memory, parts)


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
