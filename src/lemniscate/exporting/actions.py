"""Actions as rows of numbers, as C has them, and as environments and policies have them."""

from collections.abc import Callable

import numpy as np
import torch

from lemniscate.api.policy import TrainedPolicy
from lemniscate.envs.spaces import normalized_action, physical_action
from lemniscate.spec import Action, Box, Discrete

Act = Callable[[np.ndarray], np.ndarray]
"""raw observations [R, O] float32 to actions for `env.step`, [R, A] float32"""


def act_with(policy: TrainedPolicy) -> Act:
    """The policy itself, of which everything exported is a copy."""

    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        action = policy.module(torch.from_numpy(obs)).mode().numpy()
        return as_rows(physical_action(action, policy.spec.action))

    return act


def as_rows(action: np.ndarray) -> np.ndarray:
    """Actions [R, …] of any type as rows [R, A] float32."""
    return action.reshape(len(action), -1).astype(np.float32)


def for_policy(rows: np.ndarray, kind: Action) -> torch.Tensor:
    """Rows of actions [R, A] in the environment's units as a policy has them, which `VecEnv.step` takes."""
    own = rows if isinstance(kind, Box) else np.rint(rows).astype(np.int64)
    return torch.from_numpy(normalized_action(own[:, 0] if isinstance(kind, Discrete) else own, kind))
