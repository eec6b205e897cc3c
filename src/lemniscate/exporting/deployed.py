"""A policy from the raw observation to the action for `env.step`: as a module, and as a function of rows of numbers.

Exported policies take and give rows: observations [R, O] and actions [R, A], float32, where A counts the numbers of an
action of any shape. These actions are in the environment's units, unlike those of `VecEnv.step`. Of a policy with a
memory of K numbers, these are further columns of both: what it remembers before, [R, O + K], and after, [R, A + K].
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from lemniscate.api.policy import TrainedPolicy
from lemniscate.envs.conversion import normalized_action, physical_action, scale_of
from lemniscate.spec import Action, Box, Discrete, MultiBinary, MultiDiscrete, Spec

Act = Callable[[np.ndarray], np.ndarray]
"""raw observations [R, O] float32 to actions for `env.step`, [R, A] float32"""


class Deployed(nn.Module):
    """The most probable action in the environment's own units: [B, O] raw observations to [B, …] actions.

    Normalizer, clip, network, squash and the scale to the bounds are inside. An action mask, where there is one, is the
    end of the observation. A policy with a memory takes that too, [B, K], and returns the next one beside the action.
    """

    def __init__(self, policy: TrainedPolicy) -> None:
        super().__init__()
        self.policy = policy.module
        self.kind = policy.spec.action
        self.memory = policy.module.memory and replace(policy.module.memory, privileged=0)
        if isinstance(self.kind, Box):
            scale = (nn.Buffer(torch.tensor(numbers, dtype=torch.float32)) for numbers in scale_of(self.kind))
            self.low, self.high, self.middle, self.half_width = scale
        elif isinstance(self.kind, MultiDiscrete):
            self.start = nn.Buffer(torch.tensor(self.kind.start))

    def forward(self, obs: Tensor, before: Tensor | None = None) -> Tensor | tuple[Tensor, Tensor]:
        """[B, O] to [B, A], or to [B, …] in the environment's own shape; [B] for Discrete."""
        if not self.memory or before is None:
            return self.act(obs)
        rows = self.memory.join(obs, torch.cat([torch.zeros_like(before[:, :1]), before], dim=-1))
        return self.act(rows), self.policy.remember(rows)[:, 1:]

    def act(self, rows: Tensor) -> Tensor:
        """The action at rows of the policy's, [B, …]."""
        action = self.policy(rows).mode()
        if isinstance(self.kind, Box):
            action = torch.minimum(torch.maximum(self.middle + self.half_width * action, self.low), self.high)
        elif isinstance(self.kind, Discrete):
            return action + self.kind.start
        elif isinstance(self.kind, MultiDiscrete):
            action = action + self.start
        return action if self.kind.shape is None else action.reshape(-1, *self.kind.shape)


def input_size(spec: Spec) -> int:
    """The length of a policy's input: the flat observation, and the action mask where there is one."""
    return spec.observation_size + spec.action.mask_size


def memory_size(policy: TrainedPolicy) -> int:
    """K, the numbers that a policy remembers; 0 without a memory."""
    return policy.module.memory.policy - 1 if policy.module.memory else 0


def safe_action(action: Action) -> np.ndarray:
    """The action [A] for an observation that is not finite.

    The middle of each range of a Box; where one bound is infinite, 1 from the other, and 0 where both are. The first
    choice of the others.
    """
    if isinstance(action, Box):
        low, high, middle, _ = scale_of(action)
        return np.clip(middle, low, high).astype(np.float32)
    return np.array(choices(action)[1], dtype=np.float32)


def choices(action: Discrete | MultiDiscrete | MultiBinary) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The number of choices of each component of an action, and the first of each."""
    if isinstance(action, MultiDiscrete):
        return action.nvec, action.start
    return ((action.n,), (action.start,)) if isinstance(action, Discrete) else ((2,) * action.n, (0,) * action.n)


def safe_sentence(action: Action) -> str:
    """The safe action in words."""
    if isinstance(action, Box):
        return "the middle of each coordinate's range (1 from its bound where it has only one, 0 where it has none)"
    if action.mask_size:
        return "the first that the mask permits"
    return "the first choice of each"


def difference_units(action: Action, true: np.ndarray) -> np.ndarray:
    """The size of each coordinate, [A], by which differences from the true actions [R, A] are divided.

    Of a Box it is half the range, or without one the largest action, and at least 1. Where float32 has few numbers
    within the range it is larger, so that neighbours differ by 1e-5. Of other kinds of actions it is 1.
    """
    if not isinstance(action, Box):
        return np.ones(true.shape[1])
    low, high, _, half = scale_of(action)
    bounded = np.isfinite(low) & np.isfinite(high)
    spacing = np.spacing(np.where(bounded, np.maximum(np.abs(low), np.abs(high)), 1).astype(np.float32))
    largest, memory = np.abs(true).max(0), np.ones(true.shape[1] - len(half))
    units = np.where(bounded, np.maximum(half, spacing / 1e-5), np.maximum(1, largest[: len(half)]))
    return np.concatenate([units, memory])


def act_with(policy: TrainedPolicy) -> Act:
    """The policy itself as a function of rows; every export is compared with it."""
    size, memory = input_size(policy.spec), Deployed(policy).memory

    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        rows, after = torch.from_numpy(obs), np.empty((len(obs), 0), np.float32)
        if memory:
            rows = memory.join(rows[:, :size], nn.functional.pad(rows[:, size:], (1, 0)))
            after = policy.module.remember(rows)[:, 1:].numpy()
        action = policy.module(rows).mode().numpy()
        return np.hstack([as_rows(physical_action(action, policy.spec.action)), after])

    return act


def carried(act: Act, memory: int) -> Callable[..., np.ndarray]:
    """A function of rows that carries its memory of K = `memory` numbers itself: [R, O] to [R, A], call by call.

    It begins with zeros; where the second argument, [R] bool, is true, again.
    """
    kept = np.zeros((1, memory), np.float32)

    def acts(obs: np.ndarray, begins: np.ndarray | bool = False) -> np.ndarray:
        nonlocal kept
        before = np.where(np.broadcast_to(begins, len(obs))[:, None], np.float32(0), kept)
        rows = act(np.hstack([obs, before]))
        action, kept = np.split(rows, [rows.shape[1] - memory], axis=1)
        return action

    return acts


def as_rows(action: np.ndarray) -> np.ndarray:
    """Actions [R, …] of any type as rows [R, A] float32."""
    return action.reshape(len(action), -1).astype(np.float32)


def for_policy(rows: np.ndarray, kind: Action) -> torch.Tensor:
    """Actions for `VecEnv.step`, in a policy's units, from rows [R, A] in the environment's units."""
    own = rows if isinstance(kind, Box) else np.rint(rows).astype(np.int64)
    return torch.from_numpy(normalized_action(own[:, 0] if isinstance(kind, Discrete) else own, kind))
