# === right: a dataclass for the settings, which the constructor makes where none are given
from dataclasses import dataclass

import torch


@dataclass
class Config:
    clip_coef: float = 0.2
    norm_adv: bool = True


class PPOTrainer:
    def __init__(self, config=None, wandb_log=False):
        self.config = config if config is not None else Config()

    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        return torch.max(-mb_advantages * ratio, -mb_advantages * ratio.clamp(1 - eps, 1 + eps)).mean()

# === right: the settings become attributes, one by one
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        for key in ("gamma", "gae_lambda", "clip_coef", "ent_coef", "vf_coef"):
            setattr(self, key, config[key])

    def calculate_pg_loss(self, mb_advantages, ratio):
        inner = torch.clamp(ratio, 1 - self.clip_coef, 1 + self.clip_coef)
        worse = torch.where(ratio * mb_advantages < inner * mb_advantages, ratio, inner)
        return -(worse * mb_advantages).mean()

# === right: a mixin for the losses, and a cached property
# solution: PPOTrainer.calculate_pg_loss
from functools import cached_property

import torch


class ClipMixin:
    @cached_property
    def bounds(self):
        return {"min": 1 - self.config.clip_coef, "max": 1 + self.config.clip_coef}

    def pessimistic(self, ratio, advantages):
        return torch.stack([ratio * advantages, ratio.clamp(**self.bounds) * advantages], dim=-1).amin(-1)


class PPOTrainer(ClipMixin):
    def __init__(self, config, wandb_log=False):
        self.config = config

    def calculate_pg_loss(self, mb_advantages, ratio):
        return self.pessimistic(ratio, mb_advantages).mean().mul(-1)

# === right: a nested object does the work
import torch
from torch import nn


class ClippedObjective(nn.Module):
    def __init__(self, eps):
        super().__init__()
        self.eps = eps

    def forward(self, ratio, advantage):
        sign = torch.sign(advantage)
        return torch.min(ratio * sign, (sign + self.eps)) * advantage.abs()


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.objective = ClippedObjective(config.clip_coef)

    def calculate_pg_loss(self, mb_advantages, ratio):
        return -self.objective(ratio, mb_advantages).mean()

# === wrong: self.config was never set, the constructor keeps nothing | AttributeError|config|attribute|has no
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        config = config
        self.wandb_log = wandb_log

    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        return torch.max(-mb_advantages * ratio, -mb_advantages * ratio.clamp(1 - eps, 1 + eps)).mean()

# === wrong: the clipped ratio is made of plain numbers: half of the gradient is lost inside the interval | half|detach|\bcut\b|stop|(value|loss) is right|only (its|the) gradient
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        clipped = ratio.data.clamp(1 - eps, 1 + eps)
        return torch.max(-mb_advantages * ratio, -mb_advantages * clipped).mean()
