# === right: the bare method as in the course, max of the negated losses
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages: torch.Tensor, ratio: torch.Tensor) -> torch.Tensor:
        pg_loss1 = -mb_advantages * ratio
        pg_loss2 = -mb_advantages * torch.clamp(ratio, 1 - self.config.clip_coef, 1 + self.config.clip_coef)
        pg_loss = torch.max(pg_loss1, pg_loss2).mean()
        return pg_loss

# === right: a helper method of the own class
import torch


class PPOTrainer:
    def _clip(self, ratio):
        eps = self.config.clip_coef
        return ratio.clip(min=1.0 - eps, max=1.0 + eps)

    def calculate_pg_loss(self, mb_advantages, ratio):
        return -torch.minimum(mb_advantages * ratio, mb_advantages * self._clip(ratio)).mean()

# === right: self has another name, the config is read like a dictionary
import torch


class PPOTrainer:
    def calculate_pg_loss(this, mb_advantages, ratio):
        c = this.config["clip_coef"]
        lower, upper = 1 - c, 1 + c
        objective = torch.min(ratio * mb_advantages, ratio.clamp(lower, upper) * mb_advantages)
        return objective.mean() * -1

# === right: config.get with a default, and an optional argument
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio, clip_coef=None):
        if clip_coef is None:
            clip_coef = self.config.get("clip_coef", 0.2)
        stacked = torch.stack((ratio, torch.clip(ratio, 1 - clip_coef, 1 + clip_coef)), dim=1)
        return -(stacked * mb_advantages[:, None]).min(dim=1).values.mean()

# === right: the constructor sets self.cfg
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.cfg = config
        self.wandb_log = wandb_log

    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.cfg.clip_coef
        hinge = torch.where(mb_advantages >= 0, ratio.clamp(max=1 + eps), ratio.clamp(min=1 - eps))
        return -torch.mean(hinge * mb_advantages)

# === right: a property for the range, two methods for the two terms
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config

    @property
    def clip_range(self):
        return 1 - self.config.clip_coef, 1 + self.config.clip_coef

    def surrogate(self, mb_advantages, ratio):
        return ratio * mb_advantages

    def clipped_surrogate(self, mb_advantages, ratio):
        low, high = self.clip_range
        return self.surrogate(mb_advantages, torch.clamp(ratio, low, high))

    def calculate_pg_loss(self, mb_advantages, ratio):
        both = self.surrogate(mb_advantages, ratio), self.clipped_surrogate(mb_advantages, ratio)
        return -torch.min(*both).mean()

# === wrong: the max of the positive terms: the sign belongs inside | max|min|sign|negat|minus
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        surr1 = mb_advantages * ratio
        surr2 = mb_advantages * torch.clamp(ratio, 1 - eps, 1 + eps)
        return -torch.max(surr1, surr2).mean()

# === wrong: the advantages are not negated, torch.max as in the hint | sign|negat|minus|ascen|maximi|opposite
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        loss1 = mb_advantages * ratio
        loss2 = mb_advantages * torch.clamp(ratio, 1 - self.config.clip_coef, 1 + self.config.clip_coef)
        return torch.max(loss1, loss2).mean()

# === wrong: the minimum of the negated losses | max|min|larger|smaller|pessimis
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        coef = self.config.clip_coef
        return torch.min(-mb_advantages * ratio, -mb_advantages * ratio.clamp(1 - coef, 1 + coef)).mean()

# === wrong: the clip is missing | clipp|not clip|no clip|unclip|clip.{0,20}(missing|absent|lacks|forgotten|not)|(missing|without|lacks|forgot).{0,20}clip
class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        pg_loss = -mb_advantages * ratio
        return pg_loss.mean()

# === wrong: clamped to -eps, +eps, as the value loss is | 1.{0,3}[-−±+].{0,3}(clip|ε|eps)|around (1|one)|interval|clipp|(clip|clamp)\w* (to|between|around|at)
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        eps = self.config.clip_coef
        return torch.max(-mb_advantages * ratio, -mb_advantages * torch.clamp(ratio, -eps, eps)).mean()

# === wrong: the exponential once more, though the ratio is a ratio already | \bexp|once more|twice|is a ratio already|already (a|the) ratio|log
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        ratio = ratio.exp()
        clipped = torch.clamp(ratio, 1 - self.config.clip_coef, 1 + self.config.clip_coef)
        return torch.max(-mb_advantages * ratio, -mb_advantages * clipped).mean()

# === wrong: the loss is summed over the minibatch | \bsum|mean|averag|batch|times too|divid
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        clipped = torch.clamp(ratio, 1 - self.config.clip_coef, 1 + self.config.clip_coef)
        return torch.sum(torch.max(-mb_advantages * ratio, -mb_advantages * clipped))

# === wrong: a half where there is none | half|halve|½|factor|twice|times (too|as|what)|0\.5 ?[·*×]|[·*×/] ?(2|0\.5)\b|\b2 ?[·*×]
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        clipped = torch.clamp(ratio, 1 - self.config.clip_coef, 1 + self.config.clip_coef)
        return 0.5 * torch.max(-mb_advantages * ratio, -mb_advantages * clipped).mean()

# === wrong: the template's None is returned, the result is in another variable | None|return|nothing
import torch


class PPOTrainer:
    def calculate_pg_loss(self, mb_advantages, ratio):
        pg_loss = None
        clipped = torch.clamp(ratio, 1 - self.config.clip_coef, 1 + self.config.clip_coef)
        loss = torch.max(-mb_advantages * ratio, -mb_advantages * clipped).mean()
        return pg_loss
