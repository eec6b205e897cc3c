"""PPO from scratch, in one file: Schulman et al. 2017, arXiv:1707.06347.

Fill in each function that raises NotImplementedError; `course.check(gae)`, `course.check(clipped_surrogate)` and
`course.check(value_loss)` judge three of them alone. Then

    python ppo.py

trains on small worlds that each punish one mistake, then on CartPole-v1, and says what was found.
T steps of N environments, O observations, A actions, B = T · N rows, M of them in a minibatch.
"""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent, Normal


@dataclass
class Config:
    """The settings; the check expects these."""

    num_steps: int = 32  # T
    epochs: int = 10
    minibatch_size: int = 64  # M
    learning_rate: float = 1e-3
    gamma: float = 0.98
    lam: float = 0.9
    clip: float = 0.2
    value_coef: float = 0.5
    entropy_coef: float = 0.0
    max_grad_norm: float = 0.5


def layer(inputs: int, outputs: int, gain: float = 2**0.5) -> nn.Linear:
    """A layer with orthogonal weights and zero biases."""
    made = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(made.weight, gain)
    nn.init.zeros_(made.bias)
    return made


def network(inputs: int, outputs: int, last_gain: float) -> nn.Sequential:
    """Two hidden layers of 64."""
    return nn.Sequential(layer(inputs, 64), nn.Tanh(), layer(64, 64), nn.Tanh(), layer(64, outputs, last_gain))


class Agent(nn.Module):
    """A policy and a value, in networks of their own; for Discrete and Box actions."""

    def __init__(self, envs: Any) -> None:
        super().__init__()
        size, action = envs.single_observation_space.shape[0], envs.single_action_space
        self.is_discrete = isinstance(action, gym.spaces.Discrete)
        outputs = int(action.n) if isinstance(action, gym.spaces.Discrete) else action.shape[0]
        self.actor, self.critic = network(size, outputs, 0.01), network(size, 1, 1.0)
        self.log_std = nn.Parameter(torch.zeros(outputs))

    def distribution(self, obs: Tensor) -> Distribution:
        """π(·|s) for observations [B, O]; its log_prob and entropy are [B]."""
        out = self.actor(obs)
        return Categorical(logits=out) if self.is_discrete else Independent(Normal(out, self.log_std.exp()), 1)

    def value(self, obs: Tensor) -> Tensor:
        """V(s) for observations [B, O], [B]."""
        return self.critic(obs).squeeze(-1)

    @torch.no_grad()
    def act(self, obs: np.ndarray) -> np.ndarray:
        """The most probable action at each observation [N, O], for `envs.step`."""
        out = self.actor(torch.as_tensor(obs))
        return (out.argmax(-1) if self.is_discrete else out).numpy()


def gae(
    reward: Tensor, value: Tensor, next_value: Tensor, terminated: Tensor, done: Tensor, *, gamma: float, lam: float
) -> tuple[Tensor, Tensor]:
    """(advantage, target), each [T, N].

    A death (`terminated`) ends the value; any end (`done`: a death or a time-out) ends the chain.
    """
    # <solution>
    advantage, trace = torch.zeros_like(reward), torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        delta = reward[t] + gamma * next_value[t] * ~terminated[t] - value[t]
        trace = delta + gamma * lam * trace * ~done[t]
        advantage[t] = trace
    return advantage, advantage + value
    # </solution>


def clipped_surrogate(log_ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """−L^CLIP (eq. 7) of log π(a|s) − log π_old(a|s), a scalar."""
    # <solution>
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()
    # </solution>


def value_loss(value: Tensor, target: Tensor) -> Tensor:
    """½ E[(V − target)²], a scalar."""
    # <solution>
    return 0.5 * (value - target).square().mean()
    # </solution>


@torch.no_grad()
def collect(envs: Any, agent: Agent, obs: np.ndarray, num_steps: int) -> tuple[dict[str, Tensor], np.ndarray]:
    """T steps, and the observation to go on from.

    The rows are [T, N, …]: obs, action, reward, next_obs, terminated, truncated. Where an episode has ended,
    `envs.step` returns the first observation of the next one; the true successor is in infos["final_obs"].
    """
    rows: dict[str, list[Any]] = {
        name: [] for name in ("obs", "action", "reward", "next_obs", "terminated", "truncated")
    }
    for _ in range(num_steps):
        # <solution>
        action = agent.distribution(torch.as_tensor(obs)).sample().numpy()
        following, reward, terminated, truncated, infos = envs.step(action)
        next_obs = following.copy()
        for i in np.flatnonzero(terminated | truncated):
            next_obs[i] = infos["final_obs"][i]
        step = (obs, action, reward, next_obs, terminated, truncated)
        for column, part in zip(rows.values(), step, strict=True):
            column.append(torch.as_tensor(part))
        obs = following
        # </solution>
    return {name: torch.stack(column) for name, column in rows.items()}, obs


def update(agent: Agent, optimizer: torch.optim.Optimizer, rollout: dict[str, Tensor], config: Config) -> None:
    """Some epochs of minibatch steps on one rollout (algorithm 1)."""
    obs, action, terminated = rollout["obs"], rollout["action"], rollout["terminated"]
    # <solution>
    with torch.no_grad():
        value, next_value = agent.value(obs), agent.value(rollout["next_obs"])
        done = terminated | rollout["truncated"]
        discounts = {"gamma": config.gamma, "lam": config.lam}
        advantage, target = gae(rollout["reward"], value, next_value, terminated, done, **discounts)
        old_log_prob = agent.distribution(obs).log_prob(action)
    columns = [column.flatten(0, 1) for column in (obs, action, advantage, target, old_log_prob)]  # [B, …]
    for _ in range(config.epochs):
        for rows in torch.randperm(len(columns[0])).split(config.minibatch_size):
            x, a, adv, goal, old = (column[rows] for column in columns)
            adv = (adv - adv.mean()) / (adv.std() + 1e-8)
            distribution = agent.distribution(x)
            policy_loss = clipped_surrogate(distribution.log_prob(a) - old, adv, config.clip)
            loss = policy_loss + config.value_coef * value_loss(agent.value(x), goal)
            loss = loss - config.entropy_coef * distribution.entropy().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), config.max_grad_norm)
            optimizer.step()
    # </solution>


def train(envs: Any, total_steps: int, seed: int = 1, config: Config | None = None) -> Agent:
    """Collect, update, repeat; the learning rate falls to 0."""
    config = config or Config()
    torch.manual_seed(seed)
    agent = Agent(envs)
    optimizer = torch.optim.Adam(agent.parameters(), lr=config.learning_rate, eps=1e-5)
    obs, _ = envs.reset(seed=seed)
    updates = total_steps // (config.num_steps * envs.num_envs)
    for done in range(updates):
        optimizer.param_groups[0]["lr"] = config.learning_rate * (1 - done / updates)
        rollout, obs = collect(envs, agent, obs, config.num_steps)
        update(agent, optimizer, rollout, config)
    return agent


if __name__ == "__main__":
    from lemniscate import course

    course.check(train)
