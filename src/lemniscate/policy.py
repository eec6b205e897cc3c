"""A trained policy, for those who have NumPy and an environment of their own."""

from typing import Any

import numpy as np
import torch

from lemniscate.envs.spaces import flatten_observation, physical_action
from lemniscate.errors import UserError
from lemniscate.nn.policies import Policy
from lemniscate.run.config import RunConfig
from lemniscate.run.seeding import generator
from lemniscate.spec import Discrete, Spec


class TrainedPolicy:
    """A policy from a run or a checkpoint: NumPy in, NumPy out."""

    def __init__(self, networks: Any, spec: Spec, config: RunConfig, step: int) -> None:
        self.networks = networks.eval()
        self.spec, self.config, self.step = spec, config, step
        self._noise = generator(config.seed, torch.device("cpu"), 4)

    @property
    def module(self) -> Policy:
        """The policy itself, a function of torch tensors."""
        return self.networks.policy

    @torch.no_grad()
    def act(self, obs: Any, deterministic: bool = True, action_mask: Any = None) -> np.ndarray:
        """The action at one raw observation, or at each of a batch; ready for `env.step`.

        Args:
            obs: as the environment returns it: an array, a number, or a dictionary or tuple of these; or the flat
                observation [O] or [B, O].
            deterministic: the mode of the distribution; otherwise a sample.
            action_mask: `info["action_mask"]`, [n] or [B, n], where the environment gives one; all are valid otherwise.

        Returns:
            In the environment's own units and shape, [A] or [B, A] for Box; a scalar array or [B] for Discrete.
        """
        flat, batched = self._flatten(obs)
        if isinstance(self.spec.action, Discrete) and self.spec.action.masked:
            mask = np.ones(self.spec.action.n) if action_mask is None else np.asarray(action_mask)
            mask = np.broadcast_to(mask, (len(flat), self.spec.action.n)).astype(flat.dtype)
            flat = np.concatenate([flat, mask], axis=-1)
        distribution = self.module(torch.from_numpy(flat))
        if deterministic:
            action = distribution.mode()
        else:
            action = distribution.sample(self.module.draw_noise((len(flat),), self._noise))
        physical = physical_action(action.numpy(), self.spec.action)
        return physical if batched else physical[0]

    def _flatten(self, obs: Any) -> tuple[np.ndarray, bool]:
        """([B, O], whether it was a batch)."""
        parts, env_id = self.spec.observation_parts, self.spec.env_id
        if not isinstance(obs, dict | tuple) and self._is_flat(np.asarray(obs)):
            flat = np.asarray(obs, dtype=np.uint8 if self.spec.image else np.float32)
            return flat.reshape(-1, self.spec.observation_size), flat.ndim == 2
        try:
            flat = flatten_observation(parts, obs, image=self.spec.image)
        except (KeyError, IndexError, TypeError, ValueError) as error:
            shapes = ", ".join(f"{part.name} {part.own_shape or part.shape}" for part in parts)
            raise UserError(f"{env_id} observes {shapes}; this observation cannot be read: {error!r}.") from None
        return flat, self._is_batch(obs)

    def _is_flat(self, obs: np.ndarray) -> bool:
        """Whether it is [O] or [B, O], laid out as policies see it, and not as the environment returns it."""
        first = self.spec.observation_parts[0]
        counted = bool(first.nvec) and np.issubdtype(obs.dtype, np.integer)  # numbers that are yet to become one-hot
        right_size = obs.ndim in (1, 2) and obs.shape[-1] == self.spec.observation_size
        return right_size and obs.shape != first.shape and not counted

    def _is_batch(self, obs: Any) -> bool:
        """Whether the first part of an observation has one dimension more than the environment gives it."""
        part = self.spec.observation_parts[0]
        for step in part.path:
            obs = obs[step]
        return np.ndim(obs) > len(part.own_shape or part.shape)
