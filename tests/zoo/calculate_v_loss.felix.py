# === right: the frame with an inherited constructor and a table of losses
# solution: PPOTrainer.calculate_v_loss
import torch


class BaseTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config
        self.losses = {False: self.plain, True: self.clipped}

    def plain(self, value, target, old):
        return (value - target).square()

    def clipped(self, value, target, old):
        c = self.config.clip_coef
        inside = torch.max(torch.min(value, old + c), old - c)
        return torch.maximum(self.plain(value, target, old), self.plain(inside, target, old))


class PPOTrainer(BaseTrainer):
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        return 0.5 * self.losses[bool(if_clip)](newvalue, b_returns[mb_inds], b_values[mb_inds]).mean()

# === right: huber_loss with a delta that is never reached, which is half the square
import torch
import torch.nn.functional as F

FAR = 1e6


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret = b_returns[mb_inds]
        loss = F.huber_loss(newvalue, ret, delta=FAR, reduction="none")
        if if_clip:
            delta = torch.clamp(newvalue - b_values[mb_inds], min=-self.config.clip_coef, max=self.config.clip_coef)
            loss = torch.max(loss, F.huber_loss(b_values[mb_inds] + delta, ret, delta=FAR, reduction="none"))
        return loss.mean()

# === right: a plain function with all as arguments
# call: f(newvalue, b_returns, b_values, mb_inds, if_clip, clip_coef)
import torch


def calculate_v_loss(newvalue, b_returns, b_values, mb_inds, if_clip=False, clip_coef=0.2):
    error = newvalue.flatten() - b_returns[mb_inds]
    if if_clip:
        change = newvalue.flatten() - b_values[mb_inds]
        overshoot = torch.relu(change - clip_coef) - torch.relu(-change - clip_coef)
        clipped_error = error - overshoot
        error = torch.where(clipped_error.abs() > error.abs(), clipped_error, error)
    return (error @ error) / (2 * len(error))

# === right: a static method that calls a nested function
# call: f(newvalue, b_returns, b_values, mb_inds, if_clip, clip_coef)
import torch


class PPOTrainer:
    @staticmethod
    def calculate_v_loss(newvalue, b_returns, b_values, mb_inds, if_clip=False, clip_coef=0.2):
        def half_square(v):
            return 0.5 * (v - b_returns[mb_inds]) ** 2

        losses = [half_square(newvalue)]
        if if_clip:
            old = b_values[mb_inds]
            losses.append(half_square(old + torch.clamp(newvalue - old, -clip_coef, clip_coef)))
        return torch.stack(losses).max(dim=0)[0].mean()

# === right: row by row over the indices
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        eps = self.config.get("clip_coef")
        losses = []
        for value, i in zip(newvalue, mb_inds):
            loss = (value - b_returns[i]) ** 2
            if if_clip:
                clipped = b_values[i] + torch.clamp(value - b_values[i], -eps, eps)
                loss = max(loss, (clipped - b_returns[i]) ** 2)
            losses.append(loss)
        return torch.stack(losses).mean() / 2

# === right: an nn.MSELoss made by the constructor, nn.Module
import torch
from torch import nn


class PPOTrainer(nn.Module):
    def __init__(self, config, wandb_log=False):
        super().__init__()
        self.config = config
        self.mse = nn.MSELoss(reduction="none")

    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        target = b_returns[mb_inds].detach()
        loss = self.mse(newvalue, target)
        if if_clip:
            old = b_values[mb_inds].detach()
            near = old + (newvalue - old).clamp(-self.config.clip_coef, self.config.clip_coef)
            loss = torch.max(loss, self.mse(near, target))
        return 0.5 * loss.mean()

# === right: the docstring of the course, in place on a tensor of its own
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip: bool = False) -> torch.Tensor:
        """Calculate the value function loss for PPO (clipped and unclipped)."""
        diff = newvalue - b_values[mb_inds]
        v_loss = newvalue.sub(b_returns[mb_inds]).square_()
        if if_clip:
            diff = diff.clamp_(-self.config.clip_coef, self.config.clip_coef)
            diff = diff.add_(b_values[mb_inds]).sub_(b_returns[mb_inds])
            v_loss = torch.max(v_loss, diff**2)
        v_loss = v_loss.mean()
        v_loss *= 0.5
        return v_loss

# === wrong: a sum in place of a mean | \bsum|mean|averag|batch|times too|divid
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        err = (newvalue - ret) ** 2
        if if_clip:
            err = torch.max(err, (old + torch.clamp(newvalue - old, -e, e) - ret) ** 2)
        return 0.5 * err.sum()

# === wrong: the maximum of the two means, not the mean of the maxima | each|element|row|mean|before
import torch
import torch.nn.functional as F


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        loss = F.mse_loss(newvalue, ret)
        if if_clip:
            loss = torch.max(loss, F.mse_loss(old + torch.clamp(newvalue - old, -e, e), ret))
        return 0.5 * loss

# === wrong: if_clip is ignored, always clipped | if_clip.{0,30}(ignor|not|always)|always|plain|unclipped|even|without if_clip|although|though|where it should not|not asked
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        clipped = old + torch.clamp(newvalue - old, -e, e)
        return 0.5 * torch.max((newvalue - ret) ** 2, (clipped - ret) ** 2).mean()

# === wrong: if_clip is ignored, never clipped | if_clip.{0,30}(ignor|not|never)|never|clipp|not clip|no clip|unclip|clip.{0,20}(missing|absent|lacks|forgotten|not)|(missing|without|lacks|forgot).{0,20}clip
import torch.nn.functional as F


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        return 0.5 * F.mse_loss(newvalue, b_returns[mb_inds])

# === wrong: clipped when if_clip is False and the other way round | exchang|swap|other way|revers|mixed up|confus|in place of|opposite|if_clip.{0,30}(ignor|not)|negat|inver|clipp|always|plain|clipp|not clip|no clip|unclip|clip.{0,20}(missing|absent|lacks|forgotten|not)|(missing|without|lacks|forgot).{0,20}clip
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.config = config

    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        if if_clip:
            return 0.5 * ((newvalue - ret) ** 2).mean()
        clipped = old + torch.clamp(newvalue - old, -e, e)
        return 0.5 * torch.max((newvalue - ret) ** 2, (clipped - ret) ** 2).mean()

# === wrong: old and new exchanged in the clipped value | exchang|swap|other way|revers|mixed up|confus|in place of|opposite|old (value )?and new|V_?old|around|from the old
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        err = (newvalue - ret) ** 2
        if if_clip:
            clipped = newvalue + torch.clamp(old - newvalue, -e, e)
            err = torch.max(err, (clipped - ret) ** 2)
        return 0.5 * err.mean()

# === right: another order of its arguments, told by their names
# call: f(newvalue, b_values, b_returns, mb_inds, if_clip)
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_values, b_returns, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        err = (newvalue - ret) ** 2
        if if_clip:
            err = torch.max(err, (old + torch.clamp(newvalue - old, -e, e) - ret) ** 2)
        return 0.5 * err.mean()

# === wrong: 1 - eps and 1 + eps, the range of the ratio, for the value | [-−±].{0,3}(clip|ε|eps)|range|bound|interval|clipp|around (0|zero|the old)
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        err = (newvalue - ret) ** 2
        if if_clip:
            err = torch.max(err, (old + torch.clamp(newvalue - old, 1 - e, 1 + e) - ret) ** 2)
        return 0.5 * err.mean()

# === wrong: newvalue is indexed by mb_inds, too | IndexError|out of bounds|already|twice|newvalue.{0,30}(index|row|inds)|wrong rows|other rows|first rows|\brows?\b|minibatch|(not|never|without).{0,20}(index|mb_inds)|mb_inds.{0,30}(not|ignor|unused|missing|used)|whole batch|shuffl
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        new, ret, old = newvalue[mb_inds], b_returns[mb_inds], b_values[mb_inds]
        err = (new - ret) ** 2
        if if_clip:
            near = old + torch.clamp(new - old, -self.config.clip_coef, self.config.clip_coef)
            err = torch.max(err, (near - ret) ** 2)
        return 0.5 * err.mean()

# === wrong: the new value is detached, the critic does not learn | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        with torch.no_grad():
            ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
            err = (newvalue - ret) ** 2
            if if_clip:
                err = torch.max(err, (old + torch.clamp(newvalue - old, -e, e) - ret) ** 2)
            return 0.5 * err.mean()

# === wrong: the error is squared after the mean | squar|mean|before|each|element|order
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        plain = (newvalue - ret).mean() ** 2
        if if_clip:
            near = (old + torch.clamp(newvalue - old, -e, e) - ret).mean() ** 2
            plain = torch.max(plain, near)
        return 0.5 * plain

# === wrong: the columns broadcast against the rows, every value with every return | broadcast|shape|outer|each|pair|B, ?1|column
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        newvalue = newvalue.reshape(-1, 1)
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        err = (newvalue - ret) ** 2
        if if_clip:
            err = torch.max(err, (old + torch.clamp(newvalue - old, -e, e) - ret) ** 2)
        return 0.5 * err.mean()

# === wrong: the old values of the batch are changed in place, the next epoch sees others | in.?place|chang|modif|overwrit|argument|input
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds].clone(), self.config.clip_coef
        loss = (newvalue - ret) ** 2
        if if_clip:
            b_values[mb_inds] = old + torch.clamp(newvalue.detach() - old, -e, e)
            loss = torch.max(loss, (old + torch.clamp(newvalue - old, -e, e) - ret) ** 2)
        return 0.5 * loss.mean()

# === wrong: v_loss is only assigned in one of the two branches | UnboundLocal|NameError|v_loss|assign|referenced
class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        if if_clip:
            pass
        else:
            v_loss = 0.5 * ((newvalue - b_returns[mb_inds]) ** 2).mean()
        return v_loss

# === wrong: a helper of the class is misspelt | AttributeError|has no|_cliped|attribute
import torch


class PPOTrainer:
    def _clipped(self, x):
        return torch.clamp(x, -self.config.clip_coef, self.config.clip_coef)

    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old = b_returns[mb_inds], b_values[mb_inds]
        err = (newvalue - ret) ** 2
        if if_clip:
            err = torch.max(err, (old + self._cliped(newvalue - old) - ret) ** 2)
        return 0.5 * err.mean()

# === wrong: a constant clip, not the config's | ignor|hard|constant|fixed|whatever|does not (depend|change|use|follow)|not used|unused|always|another (clip|coef|eps)|(clip|coef|epsilon|config).{0,30}(not|other|another)
import torch

CLIP = 0.1


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old = b_returns[mb_inds], b_values[mb_inds]
        err = (newvalue - ret) ** 2
        if if_clip:
            err = torch.max(err, (old + torch.clamp(newvalue - old, -CLIP, CLIP) - ret) ** 2)
        return 0.5 * err.mean()
