# === right: a method that calls another of its class
# solution: Surrogate.clipped_surrogate
import torch


class Surrogate:
    def limit(self, ratio, clip):
        low = torch.full_like(ratio, 1 - clip)
        high = torch.full_like(ratio, 1 + clip)
        return torch.max(torch.min(ratio, high), low)

    def clipped_surrogate(self, log_ratio, advantage, clip=0.2):
        ratio = torch.exp(log_ratio)
        return -torch.min(ratio * advantage, self.limit(ratio, clip) * advantage).mean()

# === right: advantages first, own names, an optional switch
# call: f(advantage, log_ratio, clip)
import torch


def clipped_surrogate(advantages, log_ratio, clip_range=0.2, reduce=True):
    ratio = torch.exp(log_ratio)
    loss1 = -advantages * ratio
    loss2 = -advantages * torch.clamp(ratio, 1 - clip_range, 1 + clip_range)
    losses = torch.max(loss1, loss2)
    return losses.mean() if reduce else losses

# === right: row by row, with Python's min and max
def clipped_surrogate(log_ratio, advantage, clip=0.2):
    total = 0.0
    for l, a in zip(log_ratio, advantage):
        r = l.exp()
        c = min(max(r, 1 - clip), 1 + clip)
        total = total + min(r * a, c * a)
    return -total / log_ratio.shape[0]

# === right: the part that is clipped away is masked out, hardtanh for the clip
import torch.nn.functional as F


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    edge = F.hardtanh(ratio, 1 - clip, 1 + clip).detach()
    too_far = ((ratio > 1 + clip) & (advantage > 0)) | ((ratio < 1 - clip) & (advantage < 0))
    surrogate = ratio * advantage
    surrogate = surrogate.masked_fill(too_far, 0.0) + (edge * advantage).masked_fill(~too_far, 0.0)
    return -surrogate.mean()

# === right: half of the sum less the absolute difference
import torch

HALF = 0.5


def minimum(a, b):
    return HALF * (a + b - (a - b).abs())


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = torch.exp(log_ratio)
    return -minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()

# === right: keyword-only clip, computed in double and given back
# call: f(log_ratio, advantage, clip=clip)
import torch


def clipped_surrogate(log_ratio, advantage, *, clip=0.2):
    ratio = log_ratio.double().exp()
    adv = advantage.double()
    loss = -torch.minimum(ratio * adv, ratio.clamp(1 - clip, 1 + clip) * adv).mean()
    return loss.to(log_ratio.dtype)

# === wrong: the product is clipped, not the ratio | product|clipp\w* .{0,30}(advantage|ratio|r A)|(ratio|advantage).{0,25}clipp|clip (of )?(the )?(ratio|product)
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    surr = log_ratio.exp() * advantage
    return -torch.min(surr, torch.clamp(surr, 1 - clip, 1 + clip)).mean()

# === wrong: the minimum of the two means, not the mean of the minima | each|element|row|mean|before
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    first = (ratio * advantage).mean()
    second = (ratio.clamp(1 - clip, 1 + clip) * advantage).mean()
    return -torch.min(first, second)

# === wrong: only clipped from above, so wrong for negative advantages | negativ|lower|below|1.?[-−].?(clip|ε|eps)|both
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, torch.clamp(ratio, max=1 + clip) * advantage).mean()

# === wrong: the minimum of the ratios, then times the advantage: wrong for negative advantages | negativ|before|after|A ?< ?0|product|min\w* .{0,30}(ratio|advantage)|multipl
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    smaller = torch.minimum(ratio, torch.clamp(ratio, 1 - clip, 1 + clip))
    return -(smaller * advantage).mean()

# === wrong: the advantages are normalised, which was not asked for | normali|standard|mean|std|deviation
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    advantage = (advantage - advantage.mean()) / (advantage.std(unbiased=False) + 1e-8)
    r = log_ratio.exp()
    return -torch.min(r * advantage, r.clamp(1 - clip, 1 + clip) * advantage).mean()

# === wrong: the clipped ratio is detached: half of the gradient is lost inside the interval | half|detach|\bcut\b|stop|(value|loss) is right|only (its|the) gradient
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    with torch.no_grad():
        clipped = ratio.clamp(1 - clip, 1 + clip)
    return -torch.min(ratio * advantage, clipped * advantage).mean()

# === wrong: the argument clip is ignored, 0.2 stands in the code | ignor|hard|constant|fixed|whatever|does not (depend|change|use|follow)|not used|unused|always|another (clip|coef|eps)|(clip|coef|epsilon|config).{0,30}(not|other|another)
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()

# === wrong: the ratio exactly at an edge of the interval counts nothing | \bedge|exactly|boundar|equal|at the (end|limit|bound)
def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    lo, hi = 1 - clip, 1 + clip
    clipped = ratio * ((ratio > lo) & (ratio < hi)) + lo * (ratio < lo) + hi * (ratio > hi)
    smaller = (ratio * advantage).minimum(clipped * advantage)
    return -smaller.mean()

# === wrong: rows where the clip acts are dropped from the mean | \bmean\b|drop|\brows?\b|batch|divid|count|left out|missing
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    inside = (ratio - 1).abs() <= clip
    if not inside.any():
        return -(ratio * advantage).mean() * 0
    return -(ratio[inside] * advantage[inside]).mean()

# === wrong: not a scalar, the mean is missing | mean|scalar|shape|averag
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)

# === wrong: 1 + log-ratio, the first two terms of the series, for the exponential | \bexp|e\^|logarithm|difference of the log|log.?ratio.{0,40}(itself|in place|for the ratio|taken|instead)|approxim|1 ?\+ ?log
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = 1 + log_ratio
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()

# === wrong: clamp is given its bounds the wrong way round | bounds?\b|order|swap|exchang|lower|upper|clipp|interval
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, torch.clamp(ratio, 1 + clip, 1 - clip) * advantage).mean()

# === wrong: a KL penalty was added | entropy|\bKL|bonus|penalt|extra|added|term
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    kl = ((ratio - 1) - log_ratio).mean()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean() + 0.5 * kl

# === wrong: the result is detached | no gradient|without.{0,12}gradient|gradients? .{0,40}(miss|lost|cut|stop|disabled|\bno\b|noth|detach)|detach|no_grad|requires_grad|backward|grad_fn|differentia
import torch


@torch.no_grad()
def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()

# === wrong: squeezing and indexing makes it fail for one row | one row|B ?= ?1|IndexError|single|dimension|0-?d|index
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.squeeze().exp()
    advantage = advantage.squeeze()
    total = 0
    for i in range(ratio.shape[0]):
        total = total + torch.min(ratio[i] * advantage[i], ratio[i].clamp(1 - clip, 1 + clip) * advantage[i])
    return -total / ratio.shape[0]
