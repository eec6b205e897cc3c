"""Tiny environments whose values are known in closed form. The contract of the env floor is proved on them.

Both are vector environments of Gymnasium's own interface, in any autoreset mode, so the tests drive the same adapter
as every real one.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space


class ToyEnv(VectorEnv):
    """The clockwork of both toys: steps counted, episodes ended and reset in the declared mode."""

    def __init__(self, num_envs: int, mode: str, length: int | None, horizon: int | None) -> None:
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode[mode]}
        self.length, self.horizon = length, horizon
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Reset all environments, or those of `options["reset_mask"]`."""
        mask = (options or {}).get("reset_mask")
        if mask is None:
            super().reset(seed=seed)
            self.episode = np.full(self.num_envs, -1)
            self.t = np.zeros(self.num_envs, dtype=int)
            self._done = np.zeros(self.num_envs, dtype=bool)
            self.secret = np.zeros(self.num_envs, dtype=int)
            mask = np.ones(self.num_envs, dtype=bool)
        self._begin(mask)
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """One step of every environment; in NEXT_STEP, one that has ended ignores its action and resets."""
        mode = self.metadata["autoreset_mode"]
        ignored = self._done if mode is AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, dtype=bool)
        if mode is AutoresetMode.DISABLED:
            assert not self._done.any(), "an environment that has ended was stepped without a reset"
        self._begin(ignored)
        # A reset row pays a reward too, as crazyflow's does: nobody may learn from it.
        reward = np.where(ignored, 100.0, self._reward(np.asarray(actions)))
        self.t = self.t + ~ignored
        self._draw(~ignored)
        never = np.zeros(self.num_envs, dtype=bool)
        terminated = never if self.length is None else (self.t >= self.length) & ~ignored
        truncated = never if self.horizon is None else (self.t >= self.horizon) & ~ignored & ~terminated
        self._done = terminated | truncated
        info = {}
        if mode is AutoresetMode.SAME_STEP and self._done.any():
            info = {"final_obs": self._observe(), "_final_obs": self._done.copy()}
            self._begin(self._done)
        return self._observe(), reward, terminated, truncated, info

    def _begin(self, mask: np.ndarray) -> None:
        self.episode = self.episode + mask
        self.t = np.where(mask, 0, self.t)
        self._draw(mask)
        self._done = self._done & ~mask

    def _draw(self, mask: np.ndarray) -> None:
        self.secret = np.where(mask, self.np_random.integers(0, 2, self.num_envs), self.secret)

    def _observe(self) -> np.ndarray:
        raise NotImplementedError

    def _reward(self, actions: np.ndarray) -> np.ndarray:
        raise NotImplementedError


class Countdown(ToyEnv):
    """Every step pays 1, whatever is done; an episode terminates after `length` steps, is truncated after `horizon`.

    The observation is (environment, episode, step), so every row says who it is and a misaligned one is seen. With k
    steps left before the termination V = (1 − γ^k) / (1 − γ); if it never terminates V = 1 / (1 − γ), however often it
    is truncated.
    """

    def __init__(
        self, num_envs: int = 1, mode: str = "NEXT_STEP", length: int | None = 5, horizon: int | None = None
    ) -> None:
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (3,))
        self.single_action_space = gym.spaces.Discrete(2)
        super().__init__(num_envs, mode, length, horizon)

    def _observe(self) -> np.ndarray:
        return np.stack([np.arange(self.num_envs), self.episode, self.t], axis=1).astype(np.float32)

    def _reward(self, actions: np.ndarray) -> np.ndarray:
        return np.ones(self.num_envs)


class Matching(ToyEnv):
    """A coin is shown; repeating it pays 1, anything else 0. Truncated after 20 steps: the best return is 20.

    A guessing policy expects 10. Values under the best policy are 1 / (1 − γ).
    """

    def __init__(self, num_envs: int = 1, mode: str = "NEXT_STEP", horizon: int = 20) -> None:
        self.single_observation_space = gym.spaces.Box(0, 1, (2,))
        self.single_action_space = gym.spaces.Discrete(2)
        super().__init__(num_envs, mode, None, horizon)

    def _observe(self) -> np.ndarray:
        return np.eye(2, dtype=np.float32)[self.secret]

    def _reward(self, actions: np.ndarray) -> np.ndarray:
        return (actions == self.secret).astype(float)


gym.register("Countdown-v0", vector_entry_point="toy:Countdown")
gym.register("Matching-v0", vector_entry_point="toy:Matching")
