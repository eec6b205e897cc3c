"""Gymnasium vector environments, in all three autoreset modes."""

import importlib
import multiprocessing
import signal
import sys
from dataclasses import replace
from functools import partial
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from torch import Tensor

from lemniscate.envs.episodes import Stagger
from lemniscate.envs.spaces import action_kind, flatten_observation, is_image, observation_layout, physical_action
from lemniscate.envs.workers import WatchedVectorEnv
from lemniscate.errors import UserError
from lemniscate.spec import Discrete, Spec
from lemniscate.types import Step


class GymnasiumBackend:
    """Any registered id, stepped one after the other (`workers=False`) or in a process each.

    Ids with an `entry_point` are vectorized here, with autoreset DISABLED: this class resets what has ended, so every
    row is real. An id that is a vector environment by itself is taken as it is, in whichever mode it declares:

    - DISABLED: reset by mask after the step.
    - SAME_STEP: the returned observation is of the next episode; the true final one is in `info["final_obs"]`.
    - NEXT_STEP: the returned observation is the true final one; the next action is ignored (`valid` False).

    With `stagger`, first episodes are cut (see `Stagger`) where the environment can be reset at will (DISABLED).
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
        self._gym_spec, self._workers, self._kwargs = spec_of(env_id), workers, kwargs
        self.num_envs, self.device = num_envs, device
        try:
            self._envs = self._build()
        except (gym.error.Error, ImportError) as error:
            raise UserError(f"{env_id} cannot be made: {error}") from error
        self.mode = self._envs.metadata.get("autoreset_mode")
        if not isinstance(self.mode, AutoresetMode):
            raise UserError(f"{env_id} does not say when it resets: its metadata needs an autoreset_mode.")
        space = self._envs.single_observation_space
        layout, action = observation_layout(space, env_id), action_kind(self._envs.single_action_space, env_id)
        self._used = isinstance(action, Discrete)
        if isinstance(action, Discrete) and "action_mask" in self._envs.reset(seed=0)[1]:
            action = replace(action, masked=True)
        limit = self._gym_spec.max_episode_steps
        self._stagger_up_to = limit if stagger and self.mode is AutoresetMode.DISABLED else None
        self.spec = Spec(
            env_id=env_id,
            layout=layout,
            action=action,
            max_episode_steps=limit,
            image=is_image(space),
        )

    def _build(self) -> VectorEnv:
        if self._gym_spec.entry_point is None:
            return gym.make_vec(self._gym_spec, self.num_envs, **self._kwargs)
        copies = [partial(make_one, self._gym_spec, **self._kwargs)] * self.num_envs
        if self._workers:
            multiprocessing.get_context("forkserver").set_forkserver_preload([__name__])  # imported once, for all
            return WatchedVectorEnv(copies, context="forkserver", autoreset_mode=AutoresetMode.DISABLED)
        return SyncVectorEnv(copies, autoreset_mode=AutoresetMode.DISABLED)

    def restart(self, seed: int) -> Tensor:
        """Close the environments and build them again: some (Box2D) carry more over a reset than they tell."""
        if self._used:
            self._envs.close()
            self._envs = self._build()
        self._used = True
        self._resetting = np.zeros(self.num_envs, dtype=bool)
        self._stagger = Stagger(self.num_envs, self._stagger_up_to, seed)
        self.counts = self._tensor(self._stagger.counts)
        if isinstance(self.spec.action, Discrete):
            self._mask = np.ones((self.num_envs, self.spec.action.n), dtype=bool)
        return self._tensor(self._seen(*self._envs.reset(seed=seed)))

    def step(self, action: Tensor) -> Step:
        """Step, then find the true successor of each row and where to act next, as the mode demands."""
        physical = physical_action(action.cpu().numpy(), self.spec.action)
        raw, reward, terminated, truncated, info = self._envs.step(physical)
        terminated, truncated = terminated.copy(), truncated.copy()  # a vector environment may write over its own
        obs = next_obs = self._seen(raw, info)
        valid = np.ones(self.num_envs, dtype=bool)
        done = terminated | truncated
        if self.mode is AutoresetMode.NEXT_STEP:
            valid, self._resetting = ~self._resetting, done
        elif self.mode is AutoresetMode.SAME_STEP:
            next_obs = self._with_final(obs, info, done)
        else:
            truncated = self._stagger.apply(terminated, truncated)
            done = terminated | truncated
            if done.any():
                obs = self._seen(*self._envs.reset(options={"reset_mask": done.copy()}))
        self.counts = self._tensor(self._stagger.counts)
        there = self._tensor(next_obs)
        return Step(
            obs=there if obs is next_obs else self._tensor(obs),
            next_obs=there,
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
                f"{self.spec.env_id} resets in the same step and hides the final observation (no info['final_obs']), so"
                " its time-outs cannot be learned from; make it NEXT_STEP, DISABLED, or give final_obs."
            )
        next_obs, size = obs.copy(), self.spec.observation_size
        for row in np.flatnonzero(done):
            final = _row(info["final_obs"], int(row))
            next_obs[row, :size] = flatten_observation(self.spec.layout, final, image=self.spec.image)
        return next_obs

    def _seen(self, raw: Any, info: dict) -> np.ndarray:
        """The flat observation; after it the action mask, where there is one."""
        flat = flatten_observation(self.spec.layout, raw, image=self.spec.image)
        if not (isinstance(self.spec.action, Discrete) and self.spec.action.masked):
            return flat.copy() if self._gym_spec.entry_point is None else flat
        if "action_mask" in info:
            self._mask = self._mask.copy()
            for row in np.flatnonzero(info.get("_action_mask", np.ones(self.num_envs, dtype=bool))):
                self._mask[row] = info["action_mask"][row]
            if not self._mask.any(axis=1).all():
                copy = int(np.argmin(self._mask.any(axis=1)))
                raise UserError(
                    f"{self.spec.env_id} rules out every action of copy {copy}: its action_mask is all zero."
                )
        return np.concatenate([flat, self._mask.astype(flat.dtype)], axis=-1)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)


def _row(batch: Any, row: int) -> Any:
    """One observation out of a batch of them, which may be a dictionary or an array of objects."""
    return {name: _row(part, row) for name, part in batch.items()} if isinstance(batch, dict) else batch[row]


def spec_of(env_id: str) -> EnvSpec:
    """How Gymnasium makes an environment: a registered id, `module:id`, or `module:Class` of somebody's own.

    A module is looked for in the working directory too. Raises `UserError` if it or the class is not there.
    """
    module_name, _, name = env_id.rpartition(":")
    if not module_name:
        return gym.spec(env_id)
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise UserError(f"{env_id} cannot be made: {error}.") from error
    if name in gym.registry:
        return gym.spec(name)
    if not (isinstance(getattr(module, name, None), type) and issubclass(getattr(module, name), gym.Env)):
        raise UserError(f"{env_id} cannot be made: {module_name} has neither an environment class nor an id {name}.")
    return EnvSpec(name, entry_point=f"{module_name}:{name}")


def make_one(spec: EnvSpec, **kwargs: Any) -> gym.Env:
    """One environment, from its spec: a worker process may not know the id.

    There, Ctrl-C is left to the parent, which stops the run in order.
    """
    if parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return gym.make(spec, **kwargs)
