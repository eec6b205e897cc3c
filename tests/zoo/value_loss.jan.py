# === right: targets first, with the names of Stable-Baselines
# call: f(target, value, old_value, clip)
import torch
import torch.nn.functional as F


def value_loss(returns, values, old_values=None, clip_range_vf=None):
    unclipped = F.mse_loss(returns, values, reduction="none")
    if clip_range_vf is None:
        return 0.5 * torch.mean(unclipped)
    values_pred = old_values + torch.clamp(values - old_values, -clip_range_vf, clip_range_vf)
    return 0.5 * torch.mean(torch.max(unclipped, F.mse_loss(returns, values_pred, reduction="none")))

# === right: a class with the loss as a method, the half as its attribute
# solution: Critic.value_loss
import torch


class Critic:
    coefficient = 0.5

    def errors(self, value, target):
        return torch.square(value - target)

    def value_loss(self, value, target, old_value=None, clip=None):
        errors = self.errors(value, target)
        if clip is not None:
            errors = torch.maximum(errors, self.errors(old_value + (value - old_value).clamp(-clip, clip), target))
        return self.coefficient * errors.mean()

# === right: row by row in a comprehension
import torch


def value_loss(value, target, old_value=None, clip=None):
    def row(i):
        e = (value[i] - target[i]) ** 2
        if clip is None:
            return e
        step = torch.clamp(value[i] - old_value[i], -clip, clip)
        return max(e, (old_value[i] + step - target[i]) ** 2)

    return sum(row(i) for i in range(len(value))) / len(value) / 2

# === right: the norm, and an overshoot that is taken off
import torch


def value_loss(value, target, old_value=None, clip=None):
    error = value - target
    if clip is not None:
        step = value - old_value
        over = torch.nn.functional.softshrink(step, clip)
        other = error - over
        error = torch.where(other**2 > error**2, other, error)
    return 0.5 * torch.linalg.vector_norm(error).pow(2) / error.numel()

# === right: variance and mean, the square by its moments, an extra argument
import torch


def value_loss(value, target, old_value=None, clip=None, coef=0.5):
    if clip is None:
        error = value - target.detach()
        return coef * (error.var(unbiased=False) + error.mean() ** 2)
    inside = torch.clamp(value, old_value - clip, old_value + clip)
    worst = torch.where((inside - target).abs() > (value - target).abs(), inside, value)
    error = worst - target.detach()
    return coef * (error.var(correction=0) + error.mean().square())

# === wrong: the clip goes around the target | around|old value|from the old|difference|step|V_?old|added? back
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        near = target + torch.clamp(value - target, -clip, clip)
        loss = torch.max(loss, (near - target) ** 2)
    return 0.5 * loss.mean()

# === wrong: old and new exchanged | exchang|swap|other way|revers|mixed up|confus|in place of|opposite|old (value )?and new|V_?old|around|from the old
# --- instead of
        near = target + torch.clamp(value - target, -clip, clip)
# --- here
        near = value + torch.clamp(old_value - value, -clip, clip)

# === wrong: the maximum of the two means | each|element|row|mean|before
import torch


def value_loss(value, target, old_value=None, clip=None):
    plain = ((value - target) ** 2).mean()
    if clip is None:
        return 0.5 * plain
    near = old_value + torch.clamp(value - old_value, -clip, clip)
    return 0.5 * torch.max(plain, ((near - target) ** 2).mean())

# === wrong: clipped from above only: wrong where the value has fallen | lower|below|fall|negativ|[-−] ?(clip|ε|eps)|both|down|one side|upper|above
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        near = old_value + torch.clamp(value - old_value, max=clip)
        loss = torch.max(loss, (near - target) ** 2)
    return 0.5 * loss.mean()

# === wrong: the value is detached, the critic does not learn | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia
def value_loss(value, target, old_value=None, clip=None):
    value = value.detach()
    loss = (value - target) ** 2
    if clip is not None:
        loss = loss.maximum((old_value + (value - old_value).clamp(-clip, clip) - target) ** 2)
    return 0.5 * loss.mean()

# === wrong: 1 - clip, 1 + clip, as for the ratio, by multiplication | multipl|1.{0,3}[-−±+].{0,3}(clip|ε|eps)|quotient|difference|old value|around|divi
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        near = torch.clamp(value / old_value, 1 - clip, 1 + clip) * old_value
        loss = torch.max(loss, (near - target) ** 2)
    return 0.5 * loss.mean()

# === wrong: the half stands twice, in mse and in front | half|halve|½|factor|twice|times (too|as|what)|0\.5 ?[·*×]|[·*×/] ?(2|0\.5)\b|\b2 ?[·*×]|0\.25|quarter
import torch


def value_loss(value, target, old_value=None, clip=None):
    half = 0.5 * (value - target) ** 2
    if clip is not None:
        near = old_value + torch.clamp(value - old_value, -clip, clip)
        half = torch.max(half, 0.5 * (near - target) ** 2)
    return 0.5 * half.mean()

# === wrong: not a scalar | mean|scalar|shape|averag
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        loss = torch.max(loss, (old_value + torch.clamp(value - old_value, -clip, clip) - target) ** 2)
    return 0.5 * loss

# === wrong: the sum of both errors, not the larger | max|larger|sum|both|add
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        loss = loss + (old_value + torch.clamp(value - old_value, -clip, clip) - target) ** 2
    return 0.5 * loss.mean()

# === wrong: mean over B - 1, as the unbiased variance | mean|B ?[-−] ?1|divid|unbiased|factor|times
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        loss = torch.max(loss, (old_value + torch.clamp(value - old_value, -clip, clip) - target) ** 2)
    return 0.5 * loss.sum() / (len(loss) - 1)

# === wrong: the branch without clip returns nothing | None|return|nothing
import torch


def value_loss(value, target, old_value=None, clip=None):
    loss = (value - target) ** 2
    if clip is not None:
        near = old_value + torch.clamp(value - old_value, -clip, clip)
        return 0.5 * torch.max(loss, (near - target) ** 2).mean()
