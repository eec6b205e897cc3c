"""Gymnasium vector environments, in all three autoreset modes."""

import signal
from functools import partial
from multiprocessing import parent_process
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from torch import Tensor

from lemniscate.envs.spaces import action_kind, flatten_observation, observation_layout, physical_action
from lemniscate.errors import UserError
from lemniscate.types import Spec, Step


class GymnasiumBackend:
    """Any registered id, stepped one after the other (`workers=False`) or in a process each.

    Ids with an `entry_point` are vectorized here, with autoreset DISABLED: this class resets what has ended, so every
    row is real. An id that is a vector environment by itself is taken as it is, in whichever mode it declares:

    - DISABLED: reset by mask after the step.
    - SAME_STEP: the returned observation is of the next episode; the true final one is in `info["final_obs"]`.
    - NEXT_STEP: the returned observation is the true final one; the next action is ignored (`valid` False).

    With `stagger`, the first episode of each copy is cut after a random number of steps, uniform up to the time
    limit, where the environment can be reset at will (DISABLED) and has a limit. A cut counts as a truncation.
    """

    def __init__(
        self,
        env_id: str,
        num_envs: int,
        device: torch.device,
        *,
        stagger: bool = False,
        workers: bool = False,
        **kwargs: Any,
    ) -> None:
        self._id, self._workers, self._kwargs = env_id, workers, kwargs
        self.num_envs, self.device = num_envs, device
        try:
            self._envs = self._build()
        except (gym.error.Error, ModuleNotFoundError) as error:
            raise UserError(f"{env_id} cannot be made: {error}") from error
        self.mode = self._envs.metadata.get("autoreset_mode")
        if not isinstance(self.mode, AutoresetMode):
            raise UserError(f"{env_id} does not say when it resets: its metadata needs an autoreset_mode.")
        self._space = self._envs.single_observation_space
        limit = gym.spec(env_id).max_episode_steps
        self._stagger = stagger and self.mode is AutoresetMode.DISABLED and limit is not None
        self.spec = Spec(
            env_id=env_id,
            layout=observation_layout(self._space, env_id),
            action=action_kind(self._envs.single_action_space, env_id),
            max_episode_steps=limit,
            one_hot_from=int(self._space.start) if isinstance(self._space, gym.spaces.Discrete) else None,
        )

    def _build(self) -> VectorEnv:
        if gym.spec(self._id).entry_point is None:
            return gym.make_vec(self._id, self.num_envs, **self._kwargs)
        copies = [partial(_make, self._id, **self._kwargs)] * self.num_envs
        if self._workers:
            return AsyncVectorEnv(copies, context="forkserver", autoreset_mode=AutoresetMode.DISABLED)
        return SyncVectorEnv(copies, autoreset_mode=AutoresetMode.DISABLED)

    def restart(self, seed: int) -> Tensor:
        """Close the environments and build them again: some (Box2D) carry more over a reset than they tell."""
        self._envs.close()
        self._envs = self._build()
        self._resetting = np.zeros(self.num_envs, dtype=bool)
        self._steps_to_cut = np.full(self.num_envs, -1)
        self.whole = torch.full((self.num_envs,), not self._stagger, device=self.device)
        if self._stagger:
            rng = np.random.default_rng(seed)
            self._steps_to_cut = rng.integers(1, self.spec.max_episode_steps, self.num_envs, endpoint=True)
        obs, _ = self._envs.reset(seed=seed)
        return self._tensor(flatten_observation(self._space, obs))

    def step(self, action: Tensor) -> Step:
        """Step, then find the true successor of each row and where to act next, as the mode demands."""
        raw, reward, terminated, truncated, info = self._envs.step(physical_action(action, self.spec.action))
        obs = next_obs = flatten_observation(self._space, raw)
        valid = np.ones(self.num_envs, dtype=bool)
        done = terminated | truncated
        if self.mode is AutoresetMode.NEXT_STEP:
            valid, self._resetting = ~self._resetting, done
        elif self.mode is AutoresetMode.SAME_STEP:
            next_obs = self._with_final(obs, info, done)
        else:
            self._steps_to_cut -= 1
            truncated = truncated | ((self._steps_to_cut == 0) & ~terminated)
            done = terminated | truncated
            if done.any():
                self._steps_to_cut[done] = -1
                raw, _ = self._envs.reset(options={"reset_mask": done.copy()})
                obs = flatten_observation(self._space, raw)
        self.whole = self.whole | self._tensor(done)
        return Step(
            obs=self._tensor(obs),
            next_obs=self._tensor(next_obs),
            reward=self._tensor(reward.astype(np.float32)),
            terminated=self._tensor(terminated),
            truncated=self._tensor(truncated),
            valid=self._tensor(valid),
        )

    def close(self) -> None:
        """Close the environments and their workers."""
        self._envs.close()

    def _with_final(self, obs: np.ndarray, info: dict, done: np.ndarray) -> np.ndarray:
        if not done.any():
            return obs
        if "final_obs" not in info:
            raise UserError(
                f"{self._id} resets in the same step and hides the final observation (no info['final_obs']), so its"
                " time-outs cannot be learned from; make it NEXT_STEP, DISABLED, or give final_obs."
            )
        final, next_obs = info["final_obs"], obs.copy()
        rows = np.flatnonzero(done)
        if isinstance(final, dict):
            next_obs[rows] = flatten_observation(self._space, {name: part[rows] for name, part in final.items()})
        else:
            next_obs[rows] = flatten_observation(self._space, np.stack([final[row] for row in rows]))
        return next_obs

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)


def _make(env_id: str, **kwargs: Any) -> gym.Env:
    """One environment. In a worker process Ctrl-C is left to the parent, which stops the run in order."""
    if parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return gym.make(env_id, **kwargs)
