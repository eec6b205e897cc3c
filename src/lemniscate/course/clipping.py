"""The well-known mistakes in PPO's clipped loss, each as a function of (log ratio [B], advantage [B], ε)."""

import torch

from lemniscate import maths
from lemniscate.course.exercise import Function

MISTAKES: dict[str, Function] = {
    "the sign: optimizers descend": lambda x, a, clip: -maths.clipped_surrogate(x, a, clip),
    "the larger objective is taken; of the negative losses it is the larger, of the objectives the smaller": (
        lambda x, a, clip: -maths.clipped_surrogate(x, -a, clip)
    ),
    "only the clipped ratio counts, so what went the wrong way has no gradient": lambda x, a, clip: (
        -(x.exp().clamp(1 - clip, 1 + clip) * a).mean()
    ),
    "nothing is clipped": lambda x, a, clip: maths.surrogate(x, a),
    "the sum in place of the mean": lambda x, a, clip: maths.clipped_surrogate(x, a, clip) * len(x),
}

RATIO_MISTAKES: dict[str, Function] = {
    "the ratio is exp of the difference of log-probabilities": lambda x, a, clip: (
        -torch.min(x * a, x.clamp(1 - clip, 1 + clip) * a).mean()
    ),
    "the ratio is upside down: π_old / π": lambda x, a, clip: maths.clipped_surrogate(-x, a, clip),
}
"""of those who compute the ratio themselves"""
