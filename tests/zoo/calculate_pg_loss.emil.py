# === right: the whole frame of ppo.py, its environments not written yet
import random

import numpy as np
import torch
import torch.nn as nn
from torch.distributions.normal import Normal
from torch.optim import AdamW


def set_seeds(seed: int):
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def make_envs(env_name, n_envs, n_eval_envs, train_device):
    raise NotImplementedError("TODO: task 4")


def layer_init(layer, std=np.sqrt(2), bias_const=0.0):
    torch.nn.init.orthogonal_(layer.weight, std)
    torch.nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    def __init__(self, envs):
        super().__init__()
        n_obs = int(np.prod(envs.single_observation_space.shape))
        n_act = int(np.prod(envs.single_action_space.shape))
        self.critic = nn.Sequential(layer_init(nn.Linear(n_obs, 64)), nn.Tanh(), layer_init(nn.Linear(64, 1), std=1.0))
        self.actor_mean = nn.Sequential(layer_init(nn.Linear(n_obs, 64)), nn.Tanh(), layer_init(nn.Linear(64, n_act), std=0.01))
        self.actor_logstd = nn.Parameter(torch.zeros(1, n_act))

    def value(self, x):
        return self.critic(x)

    def action_and_value(self, x, action=None, deterministic=False):
        mean = self.actor_mean(x)
        dist = Normal(mean, self.actor_logstd.expand_as(mean).exp())
        if action is None:
            action = mean if deterministic else dist.sample()
        return action, dist.log_prob(action).sum(1), dist.entropy().sum(1), self.critic(x)


class PPOTrainer:
    def __init__(self, config, wandb_log: bool = False):
        self.config = config
        self.wandb_log = wandb_log
        set_seeds(self.config.seed)
        self.train_envs, self.eval_envs = make_envs("DroneFigureEightTrajectory-v0", self.config.n_envs, self.config.n_eval_envs, self.config.device)
        self.config.batch_size = self.config.n_envs * self.config.n_steps
        self.config.minibatch_size = self.config.batch_size // self.config.n_minibatches
        self.agent = Agent(self.train_envs).to(self.config.device)
        self.optimizer = AdamW(self.agent.parameters(), lr=self.config.learning_rate, eps=1e-5)
        self.rewards_buffer = torch.zeros((self.config.n_steps, self.config.n_envs)).to(self.config.device)
        self.values_buffer = torch.zeros((self.config.n_steps, self.config.n_envs)).to(self.config.device)
        self.terminated_buffer = torch.zeros((self.config.n_steps, self.config.n_envs)).to(self.config.device)
        self.global_step = 0

    def calculate_advantages(self, next_value):
        raise NotImplementedError

    def calculate_pg_loss(self, mb_advantages: torch.Tensor, ratio: torch.Tensor) -> torch.Tensor:
        clip = self.config.clip_coef
        surrogate = -mb_advantages * ratio
        clipped = -mb_advantages * torch.clamp(ratio, 1 - clip, 1 + clip)
        return torch.max(surrogate, clipped).mean()

    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        raise NotImplementedError

# === right: the frame with gymnasium.make_vec and a device, the clip kept by the constructor after the environments
import gymnasium
import torch
from torch import nn


def make_envs(env_name, n_envs, n_eval_envs, train_device):
    train = gymnasium.make_vec(env_name, num_envs=n_envs, freq=50, device="cpu")
    evaluation = gymnasium.make_vec(env_name, num_envs=n_eval_envs, freq=50, device="cpu")
    return train, evaluation


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.device = torch.device(config.device)
        self.train_envs, self.eval_envs = make_envs("DroneFigureEightTrajectory-v0", config.n_envs, config.n_eval_envs, config.device)
        self.agent = nn.Linear(self.train_envs.single_observation_space.shape[0], 1).to(self.device)
        self.optimizer = torch.optim.AdamW(self.agent.parameters(), lr=config.learning_rate)
        self.eps = config.clip_coef

    def calculate_pg_loss(self, mb_advantages, ratio):
        adv = mb_advantages.to(self.device)
        lower, upper = 1.0 - self.eps, 1.0 + self.eps
        return torch.maximum(-adv * ratio, -adv * ratio.clamp(lower, upper)).mean()

# === right: the method is inherited, the constructor is the child's
# solution: PPOTrainer.calculate_pg_loss
import torch


class PPOLosses:
    def limited(self, ratio):
        return torch.clamp(ratio, 1 - self.epsilon(), 1 + self.epsilon())

    def calculate_pg_loss(self, mb_advantages, ratio):
        return -torch.min(ratio * mb_advantages, self.limited(ratio) * mb_advantages).mean()

    def epsilon(self):
        return self.config.clip_coef


class PPOTrainer(PPOLosses):
    def __init__(self, config, wandb_log=False):
        super().__init__()
        self.config = config

# === right: a base class with the constructor, the child overrides and calls super().__init__
# solution: PPOTrainer.calculate_pg_loss
import abc

import torch


class Trainer(abc.ABC):
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.history = []

    @abc.abstractmethod
    def calculate_pg_loss(self, mb_advantages, ratio): ...


class PPOTrainer(Trainer):
    def __init__(self, config, wandb_log=False):
        super().__init__(config, wandb_log)
        self.clip_min = 1 - self.config.clip_coef
        self.clip_max = 1 + self.config.clip_coef

    def calculate_pg_loss(self, mb_advantages, ratio):
        loss = torch.max(-mb_advantages * ratio, -mb_advantages * ratio.clamp(self.clip_min, self.clip_max))
        self.history.append(loss.detach().mean().item())
        return loss.mean()

# === right: a static method with clip_coef as an argument
# call: f(mb_advantages, ratio, clip_coef)
import torch


class PPOTrainer:
    @staticmethod
    def calculate_pg_loss(mb_advantages, ratio, clip_coef):
        a = mb_advantages * ratio
        b = mb_advantages * ratio.clamp(1 - clip_coef, 1 + clip_coef)
        return torch.relu(a - b).sub(a).mean()

# === right: a plain function with a default, the amount by which the ratio is too far taken off
# call: f(mb_advantages, ratio, clip_coef)
import torch


def calculate_pg_loss(mb_advantages, ratio, clip_coef=0.2):
    above = torch.relu(ratio - (1 + clip_coef)) * (mb_advantages > 0)
    below = torch.relu((1 - clip_coef) - ratio) * (mb_advantages < 0)
    return -((ratio - above + below) * mb_advantages).mean()

# === right: a class method
# call: f(mb_advantages, ratio, clip_coef)
import torch


class PPOTrainer:
    @classmethod
    def _clip(cls, ratio, eps):
        return torch.clamp(ratio, 1 - eps, 1 + eps)

    @classmethod
    def calculate_pg_loss(cls, mb_advantages, ratio, clip_coef=0.2):
        return -torch.min(mb_advantages * ratio, mb_advantages * cls._clip(ratio, clip_coef)).mean()

# === right: the trainer is an nn.Module, eps is a buffer
import torch
from torch import nn


class PPOTrainer(nn.Module):
    def __init__(self, config, wandb_log=False):
        super().__init__()
        self.config = config
        self.register_buffer("eps", torch.tensor(float(config.clip_coef)))

    def calculate_pg_loss(self, mb_advantages, ratio):
        clipped = torch.clamp(ratio, 1 - self.eps, 1 + self.eps)
        return -torch.fmin(mb_advantages * ratio, mb_advantages * clipped).mean()

# === right: a dataclass as trainer, a decorator without wraps
from dataclasses import dataclass
from typing import Any

import torch


def timed(method):
    def inner(*args, **kwargs):
        result = method(*args, **kwargs)
        return result

    return inner


@dataclass
class PPOTrainer:
    config: Any
    wandb_log: bool = False

    @timed
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = getattr(self.config, "clip_coef")
        return torch.max(-mb_advantages * ratio, -mb_advantages * ratio.clamp(1 - eps, 1 + eps)).mean()

# === right: NumPy decides where the clip acts, torch computes; with prints
import numpy as np
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        r, a = ratio.detach().numpy(), mb_advantages.numpy()
        acts = np.logical_or(np.logical_and(a > 0, r > 1 + eps), np.logical_and(a < 0, r < 1 - eps))
        print("clipped:", acts.mean())
        limit = torch.from_numpy(np.clip(r, 1 - eps, 1 + eps))
        used = torch.where(torch.from_numpy(acts), limit, ratio)
        return -(used * mb_advantages).sum() / len(mb_advantages)

# === wrong: in the frame of ppo.py the wrong name of the config, clip_coeff | AttributeError|clip_coeff|has no|KeyError|attribute
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config

    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coeff
        return torch.max(-mb_advantages * ratio, -mb_advantages * ratio.clamp(1 - eps, 1 + eps)).mean()

# === wrong: gae_lambda for clip_coef, the neighbour in the config | ignor|hard|constant|fixed|whatever|does not (depend|change|use|follow)|not used|unused|always|another (clip|coef|eps)|(clip|coef|epsilon|config).{0,30}(not|other|another)|gae_lambda|too (wide|far)|interval|clipp|not clip|no clip|unclip|clip.{0,20}(missing|absent|lacks|forgotten|not)|(missing|without|lacks|forgot).{0,20}clip
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.eps = config.gae_lambda

    def calculate_pg_loss(self, mb_advantages, ratio):
        return torch.max(-mb_advantages * ratio, -mb_advantages * ratio.clamp(1 - self.eps, 1 + self.eps)).mean()

# === wrong: the helper clips from above only, wrong for negative advantages | negativ|lower|below|1.?[-−].?(clip|ε|eps)|both
# solution: PPOTrainer.calculate_pg_loss
import torch


class Base:
    def clip(self, ratio):
        return torch.minimum(ratio, torch.tensor(1 + self.config.clip_coef))


class PPOTrainer(Base):
    def __init__(self, config, wandb_log=False):
        self.config = config

    def calculate_pg_loss(self, mb_advantages, ratio):
        return torch.max(-mb_advantages * ratio, -mb_advantages * self.clip(ratio)).mean()

# === wrong: the advantages are normalised here once more | normali|standard|mean|std|deviation
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        if self.config.norm_adv:
            mb_advantages = (mb_advantages - mb_advantages.mean()) / (mb_advantages.std() + 1e-8)
        eps = self.config.clip_coef
        return torch.max(-mb_advantages * ratio, -mb_advantages * torch.clamp(ratio, 1 - eps, 1 + eps)).mean()

# === wrong: the advantages are clipped, the ratio is not | advantages? (is |are |was |were )?clipp|clipp\w* .{0,20}(advantage|wrong)|clipp|not clip|no clip|unclip|clip.{0,20}(missing|absent|lacks|forgotten|not)|(missing|without|lacks|forgot).{0,20}clip
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        clipped = torch.clamp(mb_advantages, 1 - eps, 1 + eps)
        return torch.max(-mb_advantages * ratio, -clipped * ratio).mean()

# === right: another order of its arguments, told by their names
# call: f(ratio, mb_advantages)
import torch


class PPOTrainer:
    def calculate_pg_loss(self, ratio, mb_advantages):
        eps = self.config.clip_coef
        return torch.max(-mb_advantages * ratio, -mb_advantages * torch.clamp(ratio, 1 - eps, 1 + eps)).mean()

# === wrong: the maximum of the two means, not the mean of the maxima | each|element|row|mean|before
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        loss1 = (-mb_advantages * ratio).mean()
        loss2 = (-mb_advantages * torch.clamp(ratio, 1 - eps, 1 + eps)).mean()
        return torch.stack([loss1, loss2]).max()

# === wrong: a method of the class is called without self | without self|NameError|not defined|clip_ratio
import torch


class PPOTrainer:
    def clip_ratio(self, ratio):
        return torch.clamp(ratio, 1 - self.config.clip_coef, 1 + self.config.clip_coef)

    def calculate_pg_loss(self, mb_advantages, ratio):
        return torch.max(-mb_advantages * ratio, -mb_advantages * clip_ratio(ratio)).mean()

# === wrong: self is forgotten in the parameters | TypeError|argument|self|takes
import torch


class PPOTrainer:
    def calculate_pg_loss(mb_advantages, ratio):
        return torch.max(-mb_advantages * ratio, -mb_advantages * torch.clamp(ratio, 0.75, 1.25)).mean()

# === wrong: NumPy's maximum, the gradient is lost | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia|numpy
import numpy as np
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        a, r = mb_advantages.numpy(), ratio.detach().numpy()
        return torch.as_tensor(np.maximum(-a * r, -a * np.clip(r, 1 - eps, 1 + eps)).mean())

# === wrong: the ratio is capped from above whatever the advantage's sign, and there is no minimum | \bmin|maxim|larger|smaller|pessimis|only the clipped|unclipped|negativ|lower|below|\bsign
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        top = 1 + self.config.clip_coef
        kept = torch.where(ratio > top, torch.full_like(ratio, top), ratio)
        return -(kept * mb_advantages).mean()

# === wrong: a syntax error: the colon is missing | syntax|colon|expected|line
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio)
        return torch.max(-mb_advantages * ratio, -mb_advantages * torch.clamp(ratio, 0.8, 1.2)).mean()

# === wrong: the difference to one is clipped and the one is forgotten | 1.{0,3}[-−±+].{0,3}(clip|ε|eps)|around (1|one)|interval|clipp|(clip|clamp)\w* (to|between|around|at)|difference|add(ed)? (back|1|one)|\+ ?1
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        clipped = torch.clamp(ratio - 1, -eps, eps)
        return torch.max(-mb_advantages * ratio, -mb_advantages * clipped).mean()

# === wrong: the entropy bonus, which is added in learn, is added here too | entropy|bonus|extra|add|term
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        loss = torch.max(-mb_advantages * ratio, -mb_advantages * torch.clamp(ratio, 1 - eps, 1 + eps)).mean()
        entropy = -(ratio * ratio.log()).mean()
        return loss - self.config.ent_coef * entropy
