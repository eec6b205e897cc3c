# === right: torch.min and clamp
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = torch.exp(log_ratio)
    unclipped = ratio * advantage
    clipped = torch.clamp(ratio, 1 - clip, 1 + clip) * advantage
    return -torch.min(unclipped, clipped).mean()

# === right: maximum of the negated ones, torch.clip
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    r = log_ratio.exp()
    return torch.maximum(-advantage * r, -advantage * torch.clip(r, 1.0 - clip, 1.0 + clip)).mean()

# === right: where, by the sign of the advantage
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = torch.exp(log_ratio)
    upper = ratio.clamp(max=1 + clip)
    lower = ratio.clamp(min=1 - clip)
    best = torch.where(advantage >= 0, upper, lower)
    return -torch.mean(best * advantage)

# === right: the form of Spinning Up, min(r A, g(eps, A))
import torch


def g(eps, advantage):
    return torch.where(advantage > 0, (1 + eps) * advantage, (1 - eps) * advantage)


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    return -torch.minimum(log_ratio.exp() * advantage, g(clip, advantage)).mean()

# === right: the minimum by relu, a - relu(a - b)
import torch.nn.functional as F


def clipped_surrogate(logr, adv, eps=0.2):
    r = logr.exp()
    a = r * adv
    b = r.clamp(1 - eps, 1 + eps) * adv
    return (F.relu(a - b) - a).sum() / a.numel()

# === right: stacked, then amin
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    both = torch.stack([ratio, ratio.clip(1 - clip, 1 + clip)]) * advantage
    return both.amin(dim=0).mean().neg()

# === wrong: the larger of the two, not the smaller | max|min|larger|smaller|pessimis
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = torch.exp(log_ratio)
    s1 = ratio * advantage
    s2 = torch.clamp(ratio, 1 - clip, 1 + clip) * advantage
    return -torch.max(s1, s2).mean()

# === wrong: the sign | sign|negat|minus|ascen|descen|maximi|opposite
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = torch.exp(log_ratio)
    return torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()

# === wrong: no exponential, the log-ratio is taken for the ratio | \bexp|e\^|logarithm|difference of the log|log.?ratio.{0,40}(itself|in place|for the ratio|taken|instead)
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio
    return -torch.min(ratio * advantage, torch.clamp(ratio, 1 - clip, 1 + clip) * advantage).mean()

# === wrong: the logarithm is clipped, not the ratio | clipp\w* .{0,30}log|log\w* .{0,30}clipp|1.{0,3}[-−±].{0,3}(clip|ε|eps)|clip (the )?(log|ratio)|clip.{0,20}before|exp(onential)? .{0,20}(after|first|before)
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    clipped = torch.clamp(log_ratio, -clip, clip).exp()
    return -torch.min(log_ratio.exp() * advantage, clipped * advantage).mean()

# === wrong: the ratio is upside down | upside|invers|exchang|swap|old|other way|1 ?/ ?r|sign of the log|reciproc
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = torch.exp(-log_ratio)
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()

# === wrong: nothing is clipped | clipp|not clip|no clip|unclip|clip.{0,20}(missing|absent|lacks|forgotten|not)|(missing|without|lacks|forgot).{0,20}clip
def clipped_surrogate(log_ratio, advantage, clip=0.2):
    return -(log_ratio.exp() * advantage).mean()

# === wrong: only the clipped term, the minimum is missing | \bmin|maxim|larger|smaller|pessimis|only the clipped|unclipped
def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    return -(ratio.clamp(1 - clip, 1 + clip) * advantage).mean()

# === wrong: a sum in place of a mean | \bsum|mean|averag|batch|times too|divid
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).sum()

# === wrong: clipped to [-clip, clip] instead of around 1 | 1.{0,3}[-−±+].{0,3}(clip|ε|eps)|around (1|one)|interval|clipp|(clip|clamp)\w* (to|between|around|at)
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    clipped = torch.clamp(ratio, -clip, clip)
    return -torch.min(ratio * advantage, clipped * advantage).mean()
