# === right: the bare method as in the course
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        newvalue = newvalue.view(-1)
        if if_clip:
            v_loss_unclipped = (newvalue - b_returns[mb_inds]) ** 2
            v_clipped = b_values[mb_inds] + torch.clamp(
                newvalue - b_values[mb_inds], -self.config.clip_coef, self.config.clip_coef
            )
            v_loss_clipped = (v_clipped - b_returns[mb_inds]) ** 2
            v_loss = 0.5 * torch.max(v_loss_unclipped, v_loss_clipped).mean()
        else:
            v_loss = 0.5 * ((newvalue - b_returns[mb_inds]) ** 2).mean()
        return v_loss

# === right: F.mse_loss for both
import torch
import torch.nn.functional as F


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        targets, old = b_returns[mb_inds], b_values[mb_inds]
        if not if_clip:
            return F.mse_loss(newvalue, targets) / 2
        eps = self.config["clip_coef"]
        near = torch.clamp(newvalue, old - eps, old + eps)
        errors = torch.maximum(
            F.mse_loss(newvalue, targets, reduction="none"), F.mse_loss(near, targets, reduction="none")
        )
        return errors.mean() / 2

# === right: helper methods, the larger of the absolute errors, then squared
import torch


class PPOTrainer:
    def _rows(self, buffer, mb_inds):
        return buffer.index_select(0, torch.as_tensor(mb_inds, dtype=torch.long))

    def _half_mse(self, error):
        return error.pow(2).sum() / (2 * error.numel())

    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        target = self._rows(b_returns, mb_inds)
        error = (newvalue - target).abs()
        if if_clip:
            old = self._rows(b_values, mb_inds)
            step = (newvalue - old).clip(-self.config.clip_coef, self.config.clip_coef)
            error = torch.max(error, (old + step - target).abs())
        return self._half_mse(error)

# === right: self.cfg and self.eps set by the constructor, one return at the end
import torch


class PPOTrainer:
    def __init__(self, config, wandb_log=False):
        self.cfg = config
        self.eps = self.cfg.clip_coef

    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        returns = b_returns[mb_inds]
        losses = torch.square(newvalue - returns)
        if if_clip is True:
            values = b_values[mb_inds]
            moved = torch.where((newvalue - values).abs() <= self.eps, newvalue, values + self.eps * torch.sign(newvalue - values))
            losses = torch.stack([losses, torch.square(moved - returns)]).amax(0)
        return torch.mean(losses).mul(0.5)

# === wrong: the half is missing | half|halve|½|factor|twice|times (too|as|what)|0\.5 ?[·*×]|[·*×/] ?(2|0\.5)\b|\b2 ?[·*×]
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        newvalue = newvalue.view(-1)
        unclipped = (newvalue - b_returns[mb_inds]) ** 2
        if not if_clip:
            return unclipped.mean()
        v = b_values[mb_inds] + torch.clamp(newvalue - b_values[mb_inds], -self.config.clip_coef, self.config.clip_coef)
        return torch.max(unclipped, (v - b_returns[mb_inds]) ** 2).mean()

# === wrong: the half is missing in the clipped case only | half|halve|½|factor|twice|times (too|as|what)|0\.5 ?[·*×]|[·*×/] ?(2|0\.5)\b|\b2 ?[·*×]
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old = b_returns[mb_inds], b_values[mb_inds]
        if if_clip:
            e = self.config.clip_coef
            v_clip = old + torch.clamp(newvalue - old, -e, e)
            v_loss = torch.max((newvalue - ret).pow(2), (v_clip - ret).pow(2)).mean()
        else:
            v_loss = 0.5 * (newvalue - ret).pow(2).mean()
        return v_loss

# === wrong: the smaller of the two errors | max|min|larger|smaller|pessimis
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        error = (newvalue - ret) ** 2
        if if_clip:
            error = torch.min(error, (old + (newvalue - old).clamp(-e, e) - ret) ** 2)
        return 0.5 * error.mean()

# === wrong: only the clipped error, without the maximum | max|only|unclipped|larger|gradient
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        value = newvalue
        if if_clip:
            eps = self.config.clip_coef
            value = b_values[mb_inds] + torch.clamp(newvalue - b_values[mb_inds], -eps, eps)
        return 0.5 * torch.mean((value - b_returns[mb_inds]) ** 2)

# === wrong: the rows of the minibatch are the first ones, mb_inds is not used | wrong rows|other rows|first rows|\brows?\b|minibatch|(not|never|without).{0,20}(index|mb_inds)|mb_inds.{0,30}(not|ignor|unused|missing|used)|whole batch|shuffl
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        n = newvalue.shape[0]
        returns, values = b_returns[:n], b_values[:n]
        loss = (newvalue - returns) ** 2
        if if_clip:
            eps = self.config.clip_coef
            loss = torch.max(loss, (values + torch.clamp(newvalue - values, -eps, eps) - returns) ** 2)
        return loss.mean() * 0.5

# === wrong: the whole batch against the minibatch, mb_inds is not used | wrong rows|other rows|first rows|\brows?\b|minibatch|(not|never|without).{0,20}(index|mb_inds)|mb_inds.{0,30}(not|ignor|unused|missing|used)|whole batch|shuffl|size|shape|RuntimeError
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        v_loss = ((newvalue - b_returns) ** 2).mean() * 0.5
        return v_loss

# === wrong: clipping goes around the return, not around the old value | around|old value|from the old|difference|step|V_?old|added? back
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        r = b_returns[mb_inds]
        loss = (newvalue - r) ** 2
        if if_clip:
            eps = self.config.clip_coef
            clipped = b_values[mb_inds] + torch.clamp(newvalue - r, -eps, eps)
            loss = torch.max(loss, (clipped - r) ** 2)
        return 0.5 * loss.mean()

# === wrong: the old value is not added back | around|old value|from the old|difference|step|V_?old|added? back
# --- instead of
            clipped = b_values[mb_inds] + torch.clamp(newvalue - r, -eps, eps)
            loss = torch.max(loss, (clipped - r) ** 2)
# --- here
            v_clip = torch.clamp(newvalue - b_values[mb_inds], -eps, eps)
            loss = torch.max(loss, (v_clip - r) ** 2)

# === wrong: the value itself is clipped to plus or minus eps | itself|around|old value|from the old|difference|step|V_?old|added? back
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        loss = (newvalue - b_returns[mb_inds]) ** 2
        if if_clip:
            eps = self.config.clip_coef
            loss = torch.max(loss, (torch.clamp(newvalue, -eps, eps) - b_returns[mb_inds]) ** 2)
        return 0.5 * loss.mean()

# === wrong: the absolute error, not the square | abs|squar|\*\* ?2|MSE|L1
import torch


class PPOTrainer:
    def calculate_v_loss(self, newvalue, b_returns, b_values, mb_inds, if_clip=False):
        ret, old, e = b_returns[mb_inds], b_values[mb_inds], self.config.clip_coef
        error = torch.abs(newvalue - ret)
        if if_clip:
            error = torch.max(error, torch.abs(old + (newvalue - old).clamp(-e, e) - ret))
        return 0.5 * error.mean()
