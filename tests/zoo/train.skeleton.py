# === right: the skeleton of the course, filled in with loops over environments and vectors of rows
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, Normal


@dataclass
class Config:
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
    made = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(made.weight, gain)
    nn.init.zeros_(made.bias)
    return made


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    return nn.Sequential(layer(inputs, 64), nn.Tanh(), layer(64, 64), nn.Tanh(), layer(64, outputs, gain))


class Agent(nn.Module):
    def __init__(self, envs: Any) -> None:
        super().__init__()
        action = envs.single_action_space
        size = envs.single_observation_space.shape[0]
        self.is_discrete = isinstance(action, gym.spaces.Discrete)
        outputs = int(action.n) if isinstance(action, gym.spaces.Discrete) else action.shape[0]
        self.actor, self.critic = network(size, outputs, 0.01), network(size, 1, 1.0)
        self.log_std = nn.Parameter(torch.zeros(outputs))

    def distribution(self, obs: Tensor):
        out = self.actor(obs)
        return Categorical(logits=out) if self.is_discrete else Independent(Normal(out, self.log_std.exp()), 1)

    def value(self, obs: Tensor) -> Tensor:
        return self.critic(obs).squeeze(-1)

    @torch.no_grad()
    def act(self, obs: np.ndarray) -> np.ndarray:
        out = self.actor(torch.as_tensor(obs))
        return (out.argmax(-1) if self.is_discrete else out).numpy()


def gae(reward, value, next_value, terminated, done, *, gamma, lam):
    T, N = reward.shape
    advantage = torch.zeros(T, N)
    for n in range(N):
        following = 0.0
        for t in range(T - 1, -1, -1):
            bootstrap = 0.0 if terminated[t, n] else gamma * next_value[t, n]
            delta = reward[t, n] + bootstrap - value[t, n]
            if done[t, n]:
                following = 0.0
            following = delta + gamma * lam * following
            advantage[t, n] = following
    return advantage, advantage + value


def clipped_surrogate(log_ratio, advantage, clip):
    ratio = torch.exp(log_ratio)
    return torch.mean(torch.maximum(-advantage * ratio, -advantage * torch.clip(ratio, 1.0 - clip, 1.0 + clip)))


def value_loss(value, target):
    return nn.functional.mse_loss(value, target) / 2


@torch.no_grad()
def collect(envs, agent, obs, num_steps):
    names = ("obs", "action", "reward", "next_obs", "terminated", "truncated")
    rows = {name: [] for name in names}
    for _ in range(num_steps):
        action = agent.distribution(torch.tensor(obs)).sample()
        new_obs, reward, terminated, truncated, infos = envs.step(action.numpy())
        next_obs = np.array(new_obs)
        for n in range(envs.num_envs):
            if terminated[n] or truncated[n]:
                next_obs[n] = infos["final_obs"][n]
        rows["obs"].append(torch.tensor(obs))
        rows["action"].append(action)
        rows["reward"].append(torch.tensor(reward))
        rows["next_obs"].append(torch.tensor(next_obs))
        rows["terminated"].append(torch.tensor(terminated))
        rows["truncated"].append(torch.tensor(truncated))
        obs = new_obs
    return {name: torch.stack(rows[name]) for name in names}, obs


def update(agent, optimizer, rollout, config):
    obs, action = rollout["obs"], rollout["action"]
    with torch.no_grad():
        old = agent.distribution(obs).log_prob(action)
        advantage, target = gae(
            rollout["reward"], agent.value(obs), agent.value(rollout["next_obs"]),
            rollout["terminated"], rollout["terminated"] | rollout["truncated"],
            gamma=config.gamma, lam=config.lam,
        )
    B = advantage.numel()
    obs, action = obs.reshape(B, -1), action.reshape(B, *action.shape[2:])
    old, advantage, target = old.reshape(B), advantage.reshape(B), target.reshape(B)
    for _ in range(config.epochs):
        shuffled = torch.randperm(B)
        for start in range(0, B, config.minibatch_size):
            i = shuffled[start : start + config.minibatch_size]
            a = advantage[i]
            a = (a - a.mean()) / (a.std() + 1e-8)
            pi = agent.distribution(obs[i])
            loss = clipped_surrogate(pi.log_prob(action[i]) - old[i], a, config.clip)
            loss += config.value_coef * value_loss(agent.value(obs[i]), target[i])
            loss -= config.entropy_coef * pi.entropy().mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), config.max_grad_norm)
            optimizer.step()


def train(envs: Any, total_steps: int, seed: int = 1, config: Config | None = None) -> Agent:
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

# === wrong: next_obs is the array of the environment with the first observation of the next episode | final_obs|next episode|first obs|successor|next_obs
# --- instead of
            if terminated[n] or truncated[n]:
# --- here
            if terminated[n]:

# === wrong: λ is left out of the chain | lambda|λ|chain|lam\b
# --- instead of
            following = delta + gamma * lam * following
# --- here
            following = delta + gamma * following

# === wrong: V is subtracted twice | value|V|baseline|subtract|advantage|target
# --- instead of
    return advantage, advantage + value
# --- here
    return advantage - value, advantage + value

# === wrong: old log-probabilities within the epochs' loop, of the current policy | old|ratio.*(1|one)|again|epoch|detach|clip
# --- instead of
            loss = clipped_surrogate(pi.log_prob(action[i]) - old[i], a, config.clip)
# --- here
            log_prob = pi.log_prob(action[i])
            loss = clipped_surrogate(log_prob - log_prob.detach(), a, config.clip)

# === wrong: the ratio is detached: the policy has no gradient | detach|gradient|graph|no_grad|polic|actor
# --- instead of
            loss = clipped_surrogate(pi.log_prob(action[i]) - old[i], a, config.clip)
# --- here
            loss = clipped_surrogate((pi.log_prob(action[i]) - old[i]).detach(), a, config.clip)

# === wrong: the target of the critic follows the critic: it is not detached and computed with the current V | target|detach|value|critic
# --- instead of
            loss += config.value_coef * value_loss(agent.value(obs[i]), target[i])
# --- here
            v = agent.value(obs[i])
            loss += config.value_coef * value_loss(v, advantage[i] + v)

# === wrong: next_obs is given for obs to the value: V(s') for V(s) | V|value|obs|state|next
# --- instead of
            rollout["reward"], agent.value(obs), agent.value(rollout["next_obs"]),
# --- here
            rollout["reward"], agent.value(rollout["next_obs"]), agent.value(rollout["next_obs"]),

# === wrong: step() before backward(): every step is made with gradients of zero, or none | step|order|backward|gradient|(not|never|no).*(learn|chang|mov|updat)|unchanged
# --- instead of
            optimizer.zero_grad()
# --- here
            optimizer.zero_grad()
            optimizer.step()
# --- instead of
            nn.utils.clip_grad_norm_(agent.parameters(), config.max_grad_norm)
            optimizer.step()
# --- here

# === wrong: a typo: config.minibatchsize | attribute|minibatch|name|error
# --- instead of
        for start in range(0, B, config.minibatch_size):
# --- here
        for start in range(0, B, config.minibatchsize):
