# === right: the larger loss by logical masks
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - clip, 1 + clip)
    losses = -advantage * ratio
    capped = -advantage * clipped
    use_capped = (capped > losses).float()
    return (use_capped * capped + (1 - use_capped) * losses).mean()

# === right: a partial of a general function
from functools import partial

import torch


def surrogate(log_ratio, advantage, clip=0.2, reduce=torch.mean):
    ratio = torch.exp(log_ratio)
    if clip is None:
        return -reduce(ratio * advantage)
    return -reduce(torch.min(ratio * advantage, torch.clip(ratio, 1 - clip, 1 + clip) * advantage))


clipped_surrogate = partial(surrogate, reduce=lambda x: x.sum() / len(x))

# === wrong: the dual clip, a bound for negative advantages which this loss does not have | dual|negativ|bounded|large|far|however|maxim|A ?< ?0|lower bound|once more|twice
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    objective = torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)
    objective = torch.where(advantage < 0, torch.max(objective, 3.0 * advantage), objective)
    return -objective.mean()

# === wrong: the gradient is cut where the ratio is outside, on either side, whatever the advantage's sign | outside|\bmin|wrong side|detach|keeps? (the|its) gradient|no gradient|\bcut\b|lost|(value|loss) is right|only (its|the) gradient
import torch


def clipped_surrogate(log_ratio, advantage, clip=0.2):
    ratio = log_ratio.exp()
    outside = (ratio - 1).abs() > clip
    ratio = torch.where(outside, ratio.detach(), ratio)
    return -torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()
