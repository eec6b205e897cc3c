"""A proportional-derivative controller that flies a drone along a previewed reference: the classical baseline.

Wished acceleration = kp · position error + kd · velocity error + the reference's acceleration + gravity. The drone
turns its thrust axis there, without yaw, and pushes as hard as that takes: Mellinger and Kumar 2011, section III,
without their attitude loop, which the drone has itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lemniscate.maths import Deterministic
from lemniscate.spec import Box

GRAVITY = 9.81
GAINS = {
    "so_rpy": (37.7, 9.6, 79.2, 16.0),
    "so_rpy_rotor": (47.4, 11.6, 74.8, 22.6),
    "so_rpy_rotor_drag": (50.2, 14.4, 66.3, 24.0),
    "first_principles": (17.8, 9.3, 27.9, 11.8),
}
"""kp (1/s²) and kd (1/s) of the horizontal axes, then of the vertical one: in each dynamics the best of 60, by the
return from 192 starts of the figure eight (`benchmarks/air.py --gains`)"""


@dataclass(frozen=True)
class PD:
    """The controller, as a function of flat observations.

    Attributes:
        gains: kp, kd, kp_z, kd_z.
        mass: that it believes in, kg.
        action: the bounds of roll, pitch, yaw (rad) and thrust (N).
        reference: where the observation has the reference less the position, at least three points, x, y, z each (m).
        velocity: where it has the velocity (m/s).
        preview: seconds from one point to the next.
    """

    gains: Sequence[float]
    mass: float
    action: Box
    reference: slice
    velocity: slice
    preview: float

    def with_gains(self, gains: Sequence[float]) -> "PD":
        """The same controller with other gains."""
        return replace(self, gains=gains)

    def __call__(self, obs: Tensor) -> Deterministic:
        """The action [N, 4] at each observation [N, O]."""
        horizontal, vertical = self.gains[:2], self.gains[2:]
        kp, kd = (torch.tensor((one, one, other)) for one, other in zip(horizontal, vertical, strict=True))
        points = obs[:, self.reference].unflatten(1, (-1, 3))
        here, next_, after = points[:, 0], points[:, 1], points[:, 2]
        velocity = (-3 * here + 4 * next_ - after) / (2 * self.preview)  # derivatives of the parabola through them
        acceleration = (here - 2 * next_ + after) / self.preview**2
        wish = kp * here + kd * (velocity - obs[:, self.velocity]) + acceleration
        wish = wish + torch.tensor((0.0, 0.0, GRAVITY))
        size = wish.norm(dim=1)
        x, y, z = (wish / size[:, None]).unbind(1)
        roll, pitch = -torch.asin(y.clamp(-1, 1)), torch.atan2(x, z)
        command = torch.stack([roll, pitch, torch.zeros_like(roll), self.mass * size], dim=1)
        low, high = torch.tensor(self.action.low), torch.tensor(self.action.high)
        return Deterministic((2 * (command - low) / (high - low) - 1).clamp(-1, 1))
