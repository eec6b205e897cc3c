"""Gymnasium spaces, read once into a `Spec`; observations flattened, actions scaled."""

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from lemniscate.errors import UserError
from lemniscate.types import Box, Discrete


def observation_layout(space: gym.Space, env_id: str) -> tuple[tuple[str, int], ...]:
    """The parts of the flat observation, in order, with their sizes.

    A Box of any shape is flattened in C order, a Discrete becomes one-hot, a Dict is laid out in the order of its own
    keys. Raises `UserError` for anything else.
    """
    if isinstance(space, gym.spaces.Box):
        return (("obs", int(np.prod(space.shape))),)
    if isinstance(space, gym.spaces.Discrete):
        return (("obs", int(space.n)),)
    if isinstance(space, gym.spaces.Dict) and all(isinstance(s, gym.spaces.Box) for s in space.spaces.values()):
        return tuple((name, int(np.prod(s.shape or (1,)))) for name, s in space.spaces.items())
    raise UserError(
        f"{env_id} observes {type(space).__name__}; what can be flattened is Box, Discrete, or a Dict of Box."
    )


def flatten_observation(space: gym.Space, obs: object) -> np.ndarray:
    """A batch of raw observations of `space` as float32 [N, O], in the order of `observation_layout`."""
    if isinstance(space, gym.spaces.Discrete):
        return np.eye(int(space.n), dtype=np.float32)[np.asarray(obs) - int(space.start)]
    if isinstance(space, gym.spaces.Dict):
        assert isinstance(obs, dict)
        parts = [np.asarray(obs[name], dtype=np.float32) for name in space.spaces]
        return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=-1)
    flat = np.asarray(obs, dtype=np.float32)
    return flat.reshape(len(flat), -1)


def action_kind(space: gym.Space, env_id: str) -> Box | Discrete:
    """The action space as a record. Raises `UserError` for what no policy here can act in."""
    if isinstance(space, gym.spaces.Discrete):
        return Discrete(int(space.n), int(space.start))
    if isinstance(space, gym.spaces.Box) and len(space.shape) == 1:
        return Box(tuple(map(float, space.low)), tuple(map(float, space.high)))
    raise UserError(f"{env_id} takes {space} actions; what can be acted in is Discrete or a one-dimensional Box.")


def scale_action(action: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Actions in [-1, 1]^A to physical units; what lies outside is clipped.

        a_phys = low + ½ (clip(a, −1, 1) + 1) (high − low)

    A coordinate with an infinite bound is not scaled, only clipped to its bounds.
    """
    finite = torch.isfinite(low) & torch.isfinite(high)
    span = torch.where(finite, high - low, 1.0)
    base = torch.where(finite, low, 0.0)
    return torch.where(finite, base + 0.5 * (action.clamp(-1, 1) + 1) * span, action.clamp(low, high))


def physical_action(action: Tensor, kind: Box | Discrete) -> np.ndarray:
    """What a policy chose, as `env.step` wants it: NumPy, in the environment's own units."""
    if isinstance(kind, Discrete):
        return action.cpu().numpy() + kind.start
    low, high = (torch.tensor(bound, dtype=action.dtype, device=action.device) for bound in (kind.low, kind.high))
    return scale_action(action, low, high).cpu().numpy()
