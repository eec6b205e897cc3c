# === right: the whole frame of ppo.py, W&B optional, buffers, an optimizer
import random

import numpy as np
import torch
import torch.nn as nn

try:
    import wandb
except ImportError:
    wandb = None


def set_seeds(seed: int):
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.benchmark = False


def make_envs(env_name, n_envs, n_eval_envs, train_device):
    import gymnasium

    return tuple(gymnasium.make_vec(env_name, num_envs=n, freq=50) for n in (n_envs, n_eval_envs))


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        self.critic = nn.Linear(envs.single_observation_space.shape[0], 1)
        self.actor_mean = nn.Linear(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])

    def value(self, x):
        return self.critic(x)


class PPOTrainer:
    def __init__(self, config, wandb_log: bool = False):
        self.config = config
        self.wandb_log = wandb_log
        if wandb_log:
            wandb.init(project="ARLDM-Exercise-PPO", config=None)
        set_seeds(self.config.seed)
        self.train_envs, self.eval_envs = make_envs("DroneFigureEightTrajectory-v0", config.n_envs, config.n_eval_envs, config.device)
        self.agent = Agent(self.train_envs).to(self.config.device)
        self.optimizer = torch.optim.AdamW(self.agent.parameters(), lr=self.config.learning_rate, eps=1e-5)
        shape = (self.config.n_steps, self.config.n_envs)
        self.rewards_buffer = torch.zeros(shape)
        self.values_buffer = torch.zeros(shape)
        self.terminated_buffer = torch.zeros(shape)

    def clip_value(self, new, old):
        return old + torch.clamp(new - old, -self.config.clip_coef, self.config.clip_coef)

    def calculate_v_loss(
        self,
        newvalue: torch.Tensor,
        b_returns: torch.Tensor,
        b_values: torch.Tensor,
        mb_inds: np.ndarray,
        if_clip: bool = False,
    ) -> torch.Tensor:
        newvalue = newvalue.view(-1)
        l_unclip = (newvalue - b_returns[mb_inds]) ** 2
        if not if_clip:
            return 0.5 * l_unclip.mean()
        l_clip = (self.clip_value(newvalue, b_values[mb_inds]) - b_returns[mb_inds]) ** 2
        return 0.5 * torch.max(l_unclip, l_clip).mean()

    def learn(self, obs):
        raise NotImplementedError

# === right: a class method with the coefficient as an argument of its own
# call: f(newvalue, b_returns, b_values, mb_inds, if_clip, clip_coef)
import torch


class PPOTrainer:
    HALF = 0.5

    @classmethod
    def calculate_v_loss(cls, newvalue, b_returns, b_values, mb_inds, if_clip=False, clip_coef=0.2):
        returns, values = (torch.as_tensor(buffer)[mb_inds] for buffer in (b_returns, b_values))
        candidates = [newvalue]
        if if_clip:
            candidates.append(values + torch.clip(newvalue - values, -clip_coef, clip_coef))
        squares = torch.stack([torch.square(c - returns) for c in candidates])
        return cls.HALF * squares.max(0).values.mean()

# === wrong: the clipped error is detached: half of the gradient is lost inside the interval | half|detach|\bcut\b|stop|(value|loss) is right|only (its|the) gradient
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        err = (newvalue - ret) ** 2
        if if_clip:
            err = torch.max(err, ((old + torch.clamp(newvalue - old, -e, e) - ret) ** 2).detach())
        return 0.5 * err.mean()

# === wrong: the indices are shifted by one, the next row's return | wrong rows|other rows|first rows|\brows?\b|minibatch|(not|never|without).{0,20}(index|mb_inds)|mb_inds.{0,30}(not|ignor|unused|missing|used)|whole batch|shuffl|off by one|shift|next
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        rows = (mb_inds + 1) % len(b_returns)
        ret, old, e = b_returns[rows], b_values[mb_inds], self.config.clip_coef
        err = (newvalue - ret) ** 2
        if if_clip:
            err = torch.max(err, (old + torch.clamp(newvalue - old, -e, e) - ret) ** 2)
        return 0.5 * err.mean()

# === wrong: b_values of the first rows, b_returns of the right ones | wrong rows|other rows|first rows|\brows?\b|minibatch|(not|never|without).{0,20}(index|mb_inds)|mb_inds.{0,30}(not|ignor|unused|missing|used)|whole batch|shuffl|old value
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config

    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[: len(mb_inds)], self.config.clip_coef
        err = (newvalue - ret) ** 2
        if if_clip:
            err = torch.max(err, (old + torch.clamp(newvalue - old, -e, e) - ret) ** 2)
        return 0.5 * err.mean()
