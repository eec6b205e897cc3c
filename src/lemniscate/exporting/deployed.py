"""A policy from the raw observation to the action for `env.step`, as one module."""

import numpy as np
import torch
from torch import Tensor, nn

from lemniscate.api.policy import TrainedPolicy
from lemniscate.envs.spaces import scale_of
from lemniscate.errors import UserError
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, Spec


class Deployed(nn.Module):
    """The most probable action in the environment's own units: [B, O] raw observations to [B, …] actions.

    Normalizer, clip, network, squash and the scale to the bounds are inside; an action mask, where there is one, is the
    end of the observation.
    """

    low: Tensor
    high: Tensor
    middle: Tensor
    half_width: Tensor
    start: Tensor

    def __init__(self, policy: TrainedPolicy) -> None:
        super().__init__()
        self.policy = policy.module
        self.kind = policy.spec.action
        if isinstance(self.kind, Box):
            for name, numbers in zip(("low", "high", "middle", "half_width"), scale_of(self.kind), strict=True):
                self.register_buffer(name, torch.tensor(numbers, dtype=torch.float32))
        elif isinstance(self.kind, MultiDiscrete):
            self.register_buffer("start", torch.tensor(self.kind.start))

    def forward(self, obs: Tensor) -> Tensor:
        """[B, O] to [B, A] or the environment's own shape; [B] for Discrete."""
        action = self.policy(obs).mode()
        if isinstance(self.kind, Box):
            action = torch.minimum(torch.maximum(self.middle + self.half_width * action, self.low), self.high)
        elif isinstance(self.kind, Discrete):
            return action + self.kind.start
        elif isinstance(self.kind, MultiDiscrete):
            action = action + self.start
        return action if self.kind.shape is None else action.reshape(-1, *self.kind.shape)


def require_vector(spec: Spec) -> None:
    """Raise `UserError` where a policy looks at images."""
    if spec.image:
        raise UserError(f"A policy for {spec.env_id} looks at images; what can be exported looks at vectors.")


def input_size(spec: Spec) -> int:
    """The length of what a policy is given: the flat observation, and the action mask where there is one."""
    masked = isinstance(spec.action, Discrete) and spec.action.masked
    return spec.observation_size + (spec.action.n if masked and isinstance(spec.action, Discrete) else 0)


def safe_action(action: Action) -> np.ndarray:
    """The action [A] where an observation is not finite.

    The middle of each range of a Box; where one bound is infinite, 1 from the other, and 0 where both are. The first
    choice of Discrete and MultiDiscrete, 0 of MultiBinary.
    """
    if isinstance(action, Box):
        low, high, middle, _ = scale_of(action)
        return np.clip(middle, low, high).astype(np.float32)
    if isinstance(action, Discrete):
        return np.array([action.start], dtype=np.float32)
    return np.array(action.start if isinstance(action, MultiDiscrete) else [0] * action.n, dtype=np.float32)
