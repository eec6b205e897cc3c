# The whole file ppo.py, as it is handed in: environments, agent, buffers, and the method among the others.

# === right: the whole file, the course's own loop with delta filled in
import random
import time

import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn
from torch.distributions.normal import Normal


def set_seeds(seed):
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    torch.cuda.manual_seed_all(seed)
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.benchmark = False


def make_envs(n_envs, n_eval_envs, train_device):
    train_envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=n_envs, freq=50)
    eval_envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=n_eval_envs, freq=50)
    return train_envs, eval_envs


def layer_init(layer, std=np.sqrt(2), bias_const=0.0):
    torch.nn.init.orthogonal_(layer.weight, std)
    torch.nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        obs_dim = int(np.prod(envs.single_observation_space.shape))
        act_dim = int(np.prod(envs.single_action_space.shape))
        self.critic = nn.Sequential(layer_init(nn.Linear(obs_dim, 64)), nn.Tanh(), layer_init(nn.Linear(64, 1), std=1.0))
        self.actor_mean = nn.Sequential(layer_init(nn.Linear(obs_dim, 64)), nn.Tanh(), layer_init(nn.Linear(64, act_dim), std=0.01))
        self.actor_logstd = nn.Parameter(torch.zeros(1, act_dim))

    def value(self, x):
        return self.critic(x)

    def action_and_value(self, x, action=None, deterministic=False):
        mean = self.actor_mean(x)
        dist = Normal(mean, self.actor_logstd.expand_as(mean).exp())
        if action is None:
            action = mean if deterministic else dist.sample()
        return action, dist.log_prob(action).sum(1), dist.entropy().sum(1), self.critic(x)


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.wandb_log = wandb_log
        if wandb_log:
            import wandb

            wandb.init(project="ARLDM-Exercise-PPO", config=dict(config))
        self.train_envs, self.eval_envs = make_envs(config.n_envs, config.n_eval_envs, config.device)
        self.agent = Agent(self.train_envs).to(config.device)
        self.optimizer = torch.optim.AdamW(self.agent.parameters(), lr=config.learning_rate, eps=1e-5)
        shape = (config.n_steps, config.n_envs)
        self.obs_buffer = torch.zeros(shape + self.train_envs.single_observation_space.shape)
        self.actions_buffer = torch.zeros(shape + self.train_envs.single_action_space.shape)
        self.logprobs_buffer = torch.zeros(shape)
        self.rewards_buffer = torch.zeros(shape)
        self.values_buffer = torch.zeros(shape)
        self.terminated_buffer = torch.zeros(shape)
        self.dones_buffer = torch.zeros(shape)
        self.global_step = 0
        self.start_time = time.time()

    def calculate_advantages(self, next_value):
        advantages = torch.zeros_like(self.rewards_buffer).to(self.config.device)
        lastgaelam = 0
        for t in reversed(range(self.config.n_steps)):
            if t == self.config.n_steps - 1:
                next_not_terminated = 1.0 - self.terminated_buffer[-1]
                nextvalues = next_value
            else:
                next_not_terminated = 1.0 - self.terminated_buffer[t + 1]
                nextvalues = self.values_buffer[t + 1]
            delta = self.rewards_buffer[t] + self.config.gamma * nextvalues * next_not_terminated - self.values_buffer[t]
            advantages[t] = lastgaelam = (
                delta + self.config.gamma * self.config.gae_lambda * next_not_terminated * lastgaelam
            )
        returns = advantages + self.values_buffer
        return returns, advantages

    def calculate_pg_loss(self, mb_advantages, ratio):
        raise NotImplementedError

    def train(self):
        n_iterations = self.config.total_timesteps // (self.config.n_envs * self.config.n_steps)
        for iteration in range(n_iterations):
            print(f"Iter {iteration}/{n_iterations}")

# === right: a trainer that makes its parts in methods of its own, delta in a helper
import gymnasium as gym
import torch
from torch import nn


class PPOTrainer:
    """PPO on many drones."""

    def __init__(self, config, wandb_log=False):
        self.config = config
        self.wandb_log = wandb_log
        self.device = torch.device(config.device)
        self._make_envs()
        self._make_agent()
        self._make_buffers()

    def _make_envs(self):
        self.train_envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=self.config.n_envs)
        self.eval_envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=self.config.n_eval_envs)

    def _make_agent(self):
        obs_dim = self.train_envs.single_observation_space.shape[0]
        self.agent = nn.ModuleDict({"critic": nn.Linear(obs_dim, 1), "actor": nn.Linear(obs_dim, 4)})
        self.optimizer = torch.optim.AdamW(self.agent.parameters(), lr=self.config.learning_rate)

    def _make_buffers(self):
        T, N = self.config.n_steps, self.config.n_envs
        for name in ("rewards", "values", "terminated", "dones", "logprobs"):
            setattr(self, f"{name}_buffer", torch.zeros(T, N, device=self.device))

    def _td_error(self, t, next_value):
        following = next_value.squeeze(0) if t == len(self.rewards_buffer) - 1 else self.values_buffer[t + 1]
        alive = 1 - self.terminated_buffer[t]
        return self.rewards_buffer[t] + self.config.gamma * alive * following - self.values_buffer[t]

    def calculate_advantages(self, next_value):
        advantages = torch.zeros_like(self.rewards_buffer)
        gae = torch.zeros_like(self.rewards_buffer[0])
        for t in range(len(self.rewards_buffer) - 1, -1, -1):
            decay = self.config.gamma * self.config.gae_lambda * (1 - self.terminated_buffer[t])
            gae = self._td_error(t, next_value) + decay * gae
            advantages[t] = gae
        return advantages + self.values_buffer, advantages

# === right: a constructor that runs as it stands, with an attribute of its own for gamma lambda
import gymnasium as gym
import torch
from torch import nn


def make_envs(n_envs):
    return gym.make_vec("CartPole-v1", num_envs=n_envs)


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.wandb_log = wandb_log
        self.train_envs = make_envs(config["n_envs"])
        self.agent = nn.Linear(4, 3)
        self.optimizer = torch.optim.Adam(self.agent.parameters(), lr=3e-4)
        self.discount = config["gamma"]
        self.decay = config["gamma"] * config["gae_lambda"]
        shape = (config["n_steps"], config["n_envs"])
        self.rewards_buffer = torch.zeros(shape)
        self.values_buffer = torch.zeros(shape)
        self.terminated_buffer = torch.zeros(shape)
        self.dones_buffer = torch.zeros(shape)

    def calculate_advantages(self, next_value):
        values = torch.cat([self.values_buffer, next_value], dim=0)
        goes_on = 1.0 - self.terminated_buffer
        deltas = self.rewards_buffer + self.discount * goes_on * values[1:] - values[:-1]
        rows = []
        running = torch.zeros_like(deltas[0])
        for delta, c in zip(deltas.flip(0), goes_on.flip(0)):
            running = delta + self.decay * c * running
            rows.append(running)
        advantages = torch.stack(rows[::-1])
        return advantages + self.values_buffer, advantages

# === right: the method is inherited from a trainer of all algorithms on rollouts
# solution: PPOTrainer.calculate_advantages
import gymnasium as gym
import torch


class OnPolicyTrainer:
    def __init__(self, config):
        self.config = config
        self.train_envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=config.n_envs)

    @property
    def horizon(self):
        return self.rewards_buffer.shape[0]

    @property
    def trace_decay(self):
        return self.config.gamma * self.config.gae_lambda

    @torch.no_grad()
    def calculate_advantages(self, next_value):
        bootstrap = torch.vstack((self.values_buffer[1:], next_value))
        not_dead = torch.ones_like(self.terminated_buffer) - self.terminated_buffer
        adv = self.rewards_buffer + self.config.gamma * bootstrap * not_dead - self.values_buffer
        for t in reversed(range(self.horizon - 1)):
            adv[t] += self.trace_decay * not_dead[t] * adv[t + 1]
        return adv + self.values_buffer, adv


class PPOTrainer(OnPolicyTrainer):
    def __init__(self, config, wandb_log=False):
        super().__init__(config)
        self.wandb_log = wandb_log

# === right: the trainer is an nn.Module, the settings are a dataclass
from dataclasses import dataclass

import gymnasium as gym
import torch
import torch.nn as nn


@dataclass
class TrainConfig:
    n_envs: int = 1024
    n_steps: int = 16
    gamma: float = 0.90
    gae_lambda: float = 0.95
    learning_rate: float = 1.5e-3
    device: str = "cpu"


class PPOTrainer(nn.Module):
    def __init__(self, config: TrainConfig, wandb_log: bool = False):
        super().__init__()
        self.config = config
        self.wandb_log = wandb_log
        self.envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=config.n_envs)
        self.critic = nn.Linear(self.envs.single_observation_space.shape[0], 1)
        self.register_buffer("rewards_buffer", torch.zeros(config.n_steps, config.n_envs))
        self.register_buffer("values_buffer", torch.zeros(config.n_steps, config.n_envs))
        self.register_buffer("terminated_buffer", torch.zeros(config.n_steps, config.n_envs))

    def calculate_advantages(self, next_value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        T = self.rewards_buffer.size(0)
        gamma, lam = self.config.gamma, self.config.gae_lambda
        advantages = self.rewards_buffer.new_zeros(self.rewards_buffer.shape)
        following_value, following_adv = next_value[0], 0.0
        for t in reversed(range(T)):
            cont = 1.0 - self.terminated_buffer[t].float()
            advantages[t] = (
                self.rewards_buffer[t]
                - self.values_buffer[t]
                + gamma * cont * (following_value + lam * following_adv)
            )
            following_value, following_adv = self.values_buffer[t], advantages[t]
        returns = advantages + self.values_buffer
        return returns, advantages

# === wrong: the whole file with the course's own loop, delta without - V(s) | V\(s|value|baseline|minus|subtract|delta|δ
import gymnasium as gym
import numpy as np
import torch
import torch.nn as nn


def make_envs(n_envs, n_eval_envs, train_device):
    make = lambda n: gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=n, freq=50)
    return make(n_envs), make(n_eval_envs)


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.wandb_log = wandb_log
        self.train_envs, self.eval_envs = make_envs(config.n_envs, config.n_eval_envs, config.device)
        obs_dim = int(np.prod(self.train_envs.single_observation_space.shape))
        self.agent = nn.Linear(obs_dim, 5).to(config.device)
        self.optimizer = torch.optim.AdamW(self.agent.parameters(), lr=config.learning_rate, eps=1e-5)
        self.rewards_buffer = torch.zeros((config.n_steps, config.n_envs))
        self.values_buffer = torch.zeros((config.n_steps, config.n_envs))
        self.terminated_buffer = torch.zeros((config.n_steps, config.n_envs))
        self.dones_buffer = torch.zeros((config.n_steps, config.n_envs))

    def calculate_advantages(self, next_value):
        advantages = torch.zeros_like(self.rewards_buffer)
        lastgaelam = 0
        for t in reversed(range(self.config.n_steps)):
            if t == self.config.n_steps - 1:
                next_not_terminated = 1.0 - self.terminated_buffer[-1]
                nextvalues = next_value
            else:
                next_not_terminated = 1.0 - self.terminated_buffer[t + 1]
                nextvalues = self.values_buffer[t + 1]
            delta = self.rewards_buffer[t] + self.config.gamma * nextvalues * next_not_terminated
            advantages[t] = lastgaelam = (
                delta + self.config.gamma * self.config.gae_lambda * next_not_terminated * lastgaelam
            )
        returns = advantages + self.values_buffer
        return returns, advantages

# === wrong: the course's own loop, delta without gamma | γ|gamma|discount
import gymnasium as gym
import torch
import torch.nn as nn


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.train_envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=config.n_envs)
        self.agent = nn.Linear(43, 5)
        self.rewards_buffer = torch.zeros((config.n_steps, config.n_envs))
        self.values_buffer = torch.zeros((config.n_steps, config.n_envs))
        self.terminated_buffer = torch.zeros((config.n_steps, config.n_envs))

    def calculate_advantages(self, next_value):
        advantages = torch.zeros_like(self.rewards_buffer)
        lastgaelam = 0
        for t in reversed(range(self.config.n_steps)):
            if t == self.config.n_steps - 1:
                next_not_terminated = 1.0 - self.terminated_buffer[-1]
                nextvalues = next_value
            else:
                next_not_terminated = 1.0 - self.terminated_buffer[t + 1]
                nextvalues = self.values_buffer[t + 1]
            delta = self.rewards_buffer[t] + nextvalues * next_not_terminated - self.values_buffer[t]
            advantages[t] = lastgaelam = (
                delta + self.config.gamma * self.config.gae_lambda * next_not_terminated * lastgaelam
            )
        returns = advantages + self.values_buffer
        return returns, advantages

# === wrong: the course's own loop, delta without the mask | mask|terminat|death|bootstrap
# --- instead of
import torch.nn as nn
# --- here
# --- instead of
        self.agent = nn.Linear(43, 5)
# --- here
# --- instead of
            delta = self.rewards_buffer[t] + nextvalues * next_not_terminated - self.values_buffer[t]
# --- here
            delta = self.rewards_buffer[t] + self.config.gamma * nextvalues - self.values_buffer[t]

# === wrong: the course's own loop, delta with V(s_t) in place of V(s_{t+1}): nextvalues is never used | V\(s|next_?values?|successor|next row|next step|bootstrap
import gymnasium as gym
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.wandb_log = wandb_log
        self.train_envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=config.n_envs)
        self.rewards_buffer = torch.zeros((config.n_steps, config.n_envs))
        self.values_buffer = torch.zeros((config.n_steps, config.n_envs))
        self.terminated_buffer = torch.zeros((config.n_steps, config.n_envs))

    def calculate_advantages(self, next_value):
        advantages = torch.zeros_like(self.rewards_buffer)
        lastgaelam = 0
        for t in reversed(range(self.config.n_steps)):
            if t == self.config.n_steps - 1:
                next_not_terminated = 1.0 - self.terminated_buffer[-1]
                nextvalues = next_value
            else:
                next_not_terminated = 1.0 - self.terminated_buffer[t + 1]
                nextvalues = self.values_buffer[t + 1]
            delta = (
                self.rewards_buffer[t]
                + self.config.gamma * self.values_buffer[t] * next_not_terminated
                - self.values_buffer[t]
            )
            advantages[t] = lastgaelam = (
                delta + self.config.gamma * self.config.gae_lambda * next_not_terminated * lastgaelam
            )
        returns = advantages + self.values_buffer
        return returns, advantages

# === wrong: the course's own loop with delta left as it was given: None | TypeError|None|delta|unsupported|fill
# --- instead of
            delta = (
                self.rewards_buffer[t]
                + self.config.gamma * self.values_buffer[t] * next_not_terminated
                - self.values_buffer[t]
            )
# --- here
            # TODO: implement delta
            delta = None

# === wrong: the frame has no method body yet: NotImplementedError | NotImplemented|not (been )?(written|filled|implemented)|empty|yet
import gymnasium as gym
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.train_envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=config.n_envs)
        self.rewards_buffer = torch.zeros((config.n_steps, config.n_envs))

    def calculate_advantages(self, next_value):
        raise NotImplementedError("Task 9")

# === wrong: dones_buffer in place of terminated_buffer: a time-out is taken for a death | time-?out|truncat|dones_buffer|\bdones?\b|terminated_buffer
import gymnasium as gym
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.train_envs = gym.make_vec("DroneFigureEightTrajectory-v0", num_envs=config.n_envs)
        shape = (config.n_steps, config.n_envs)
        self.rewards_buffer, self.values_buffer = torch.zeros(shape), torch.zeros(shape)
        self.terminated_buffer, self.dones_buffer = torch.zeros(shape), torch.zeros(shape)

    def calculate_advantages(self, next_value):
        advantages = torch.zeros_like(self.rewards_buffer)
        gae = 0.0
        for t in reversed(range(self.config.n_steps)):
            following = next_value[0] if t == self.config.n_steps - 1 else self.values_buffer[t + 1]
            mask = 1.0 - self.dones_buffer[t]
            delta = self.rewards_buffer[t] + self.config.gamma * following * mask - self.values_buffer[t]
            gae = delta + self.config.gamma * self.config.gae_lambda * mask * gae
            advantages[t] = gae
        return advantages + self.values_buffer, advantages

# === wrong: the method of the base class is inherited, the mask is of the child and turned round | mask|invert|turned|inverse|opposite|negat|terminat
# solution: PPOTrainer.calculate_advantages
import torch


class Trainer:
    def __init__(self, config, wandb_log=False):
        self.config = config

    def mask(self, t):
        raise NotImplementedError

    def calculate_advantages(self, next_value):
        advantages = torch.zeros_like(self.rewards_buffer)
        values = torch.cat([self.values_buffer, next_value])
        gae = 0.0
        for t in reversed(range(len(advantages))):
            delta = self.rewards_buffer[t] + self.config.gamma * values[t + 1] * self.mask(t) - values[t]
            gae = delta + self.config.gamma * self.config.gae_lambda * self.mask(t) * gae
            advantages[t] = gae
        return advantages + self.values_buffer, advantages


class PPOTrainer(Trainer):
    def mask(self, t):
        return self.terminated_buffer[t]
