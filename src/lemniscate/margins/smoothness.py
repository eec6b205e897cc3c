"""The smoothness of actions, which motors and servos feel."""

import torch
from torch import Tensor

FAST = 10.0
"""Hz, beyond which actions are no part of a flight"""
EDGE = 0.999
"""of the size of an action, from which on it counts as saturated"""


def smoothness(actions: Tensor, period: float) -> dict[str, float]:
    """The smoothness of a policy's actions.

    Args:
        actions: [T, E, A] in [-1, 1], one every `period`.
        period: in seconds.

    Returns:
        `action_rate`, the root mean square of the change of an action in a second, where from one bound to the other is
        2; `fast_share`, the share of the power of the actions, their means apart, at frequencies above 10 Hz;
        `saturated_share`, the share of the actions at a bound.
    """
    rate = actions.diff(dim=0).square().mean().sqrt() / period
    power = torch.fft.rfft(actions - actions.mean(0), dim=0).abs().square().sum((1, 2))
    fast = torch.fft.rfftfreq(len(actions), period) > FAST
    return {
        "action_rate": rate.item(),
        "fast_share": (power[fast].sum() / power.sum().clamp(min=1e-12)).item(),
        "saturated_share": (actions.abs() >= EDGE).float().mean().item(),
    }
