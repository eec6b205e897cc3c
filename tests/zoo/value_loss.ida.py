# === right: half the mean square, clipped where asked
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        near = old_value + torch.clamp(value - old_value, -clip, clip)
        loss = torch.max(loss, (near - target) ** 2)
    return 0.5 * loss.mean()

# === right: F.mse_loss, maximum
import torch
import torch.nn.functional as F


def value_loss(value, target, old_value=None, clip=None):
    if clip is None:
        return F.mse_loss(value, target) / 2
    bounded = torch.minimum(torch.maximum(value, old_value - clip), old_value + clip)
    squares = torch.stack([F.mse_loss(v, target, reduction="none") for v in (value, bounded)])
    return squares.amax(dim=0).mean() / 2

# === right: torch.dot, the larger absolute error is squared
import torch


def value_loss(value, target, old_value=None, clip=None):
    e = torch.abs(value - target)
    if clip:
        e = torch.maximum(e, torch.abs(old_value + (value - old_value).clip(-clip, clip) - target))
    return torch.dot(e, e) / (2 * e.numel())

# === right: an early return, huber_loss far from its corner
import torch
from torch.nn import HuberLoss

half_square = HuberLoss(reduction="none", delta=1e6)


def value_loss(value, target, old_value=None, clip=None):
    plain = half_square(value, target)
    if clip is None:
        return plain.mean()
    assert old_value is not None, "needs the old values"
    clipped = half_square(old_value + (value - old_value).clamp(min=-clip, max=clip), target)
    return torch.where(clipped > plain, clipped, plain).mean()

# === wrong: the half is missing | half|halve|½|factor|twice|times (too|as|what)|0\.5 ?[·*×]|[·*×/] ?(2|0\.5)\b|\b2 ?[·*×]
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        near = old_value + torch.clamp(value - old_value, -clip, clip)
        loss = torch.max(loss, (near - target) ** 2)
    return loss.mean()

# === wrong: the smaller error counts | max|min|larger|smaller|pessimis
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        near = old_value + torch.clamp(value - old_value, -clip, clip)
        loss = torch.minimum(loss, (near - target) ** 2)
    return 0.5 * loss.mean()

# === wrong: clip is ignored | clipp|not clip|no clip|unclip|clip.{0,20}(missing|absent|lacks|forgotten|not)|(missing|without|lacks|forgot).{0,20}clip|ignor|never
import torch.nn.functional as F


def value_loss(value, target, old_value=None, clip=None):
    return 0.5 * F.mse_loss(value, target)

# === wrong: only the clipped error counts | max|only|unclipped|larger|gradient
import torch


def value_loss(value, target, old_value=None, clip=None):
    if clip is not None:
        value = old_value + torch.clamp(value - old_value, -clip, clip)
    return 0.5 * ((value - target) ** 2).mean()

# === wrong: the error is clipped, not the step from the old value | error.{0,30}clipp|clipp\w* .{0,30}error|around|old value|from the old|b_values|difference|step|V_?old|added? back|maxim|larger
import torch


def value_loss(value, target, old_value=None, clip=None):
    error = value - target
    if clip is not None:
        error = torch.clamp(error, -clip, clip)
    return 0.5 * (error**2).mean()

# === wrong: a sum in place of a mean | \bsum|mean|averag|batch|times too|divid
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target).pow(2)
    if clip is not None:
        loss = torch.max(loss, (old_value + (value - old_value).clamp(-clip, clip) - target).pow(2))
    return 0.5 * torch.sum(loss)

# === wrong: the absolute error | abs|squar|\*\* ?2|MSE|L1
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target).abs()
    if clip is not None:
        loss = torch.max(loss, (old_value + (value - old_value).clamp(-clip, clip) - target).abs())
    return 0.5 * loss.mean()

# === wrong: the root of the mean square | root|sqrt|squar|RMSE
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target).square()
    if clip is not None:
        loss = torch.max(loss, (old_value + (value - old_value).clamp(-clip, clip) - target).square())
    return 0.5 * loss.mean().sqrt()
