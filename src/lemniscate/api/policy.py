"""A trained policy, for those who have NumPy and an environment of their own."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from lemniscate.envs.info import read_mask
from lemniscate.envs.observations import read_observation
from lemniscate.envs.spaces import physical_action
from lemniscate.errors import UserError
from lemniscate.nn.policies import Policy
from lemniscate.run.config import RunConfig
from lemniscate.run.seeding import generator
from lemniscate.spec import Discrete, Spec


class TrainedPolicy:
    """A policy from a run or a checkpoint: NumPy in, NumPy out."""

    path: Path | None = None
    """the run or the checkpoint that it came from"""

    def __init__(self, networks: Any, spec: Spec, config: RunConfig, step: int, path: Path | None = None) -> None:
        self.networks = networks.eval()
        self.spec, self.config, self.step, self.path = spec, config, step, path
        self._noise = generator(config.seed, torch.device("cpu"), 4)

    @property
    def module(self) -> Policy:
        """The policy itself, a function of torch tensors."""
        return self.networks.policy

    @property
    def is_masked(self) -> bool:
        """Whether its environment says at each step which actions are valid."""
        return isinstance(self.spec.action, Discrete) and self.spec.action.masked

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

        Raises:
            UserError: an observation or a mask of another shape, or that is not finite; a mask where the environment
                of training gave none.
        """
        flat, batched = read_observation(self.spec, obs)
        if action_mask is not None and not self.is_masked:
            raise UserError(f"{self.spec.env_id} has no action mask, so this policy cannot follow one.")
        if isinstance(self.spec.action, Discrete) and self.spec.action.masked:
            mask = read_mask(action_mask, len(flat), self.spec.action.n)
            flat = np.concatenate([flat, mask.astype(flat.dtype)], axis=-1)
        distribution = self.module(torch.from_numpy(flat))
        if deterministic:
            action = distribution.mode()
        else:
            action = distribution.sample(self.module.draw_noise((len(flat),), self._noise))
        physical = physical_action(action.numpy(), self.spec.action)
        return physical if batched else physical[0]
