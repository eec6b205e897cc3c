"""Gymnasium environments, in all three autoreset modes."""

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from torch import Tensor

from lemniscate.envs import spaces
from lemniscate.envs.backend import Backend
from lemniscate.envs.conversion import flatten_observation, measured, measures_of, physical_action, row_of
from lemniscate.envs.factory import creation_errors, is_own, make_one, make_vector, maker_of, makes_vector
from lemniscate.envs.returned import fitted, mask_in
from lemniscate.envs.vec_env import Stagger
from lemniscate.envs.workers import WatchedVectorEnv, call_method
from lemniscate.errors import UserError, shown
from lemniscate.spec import Discrete, MultiDiscrete, Spec
from lemniscate.system.named import find_callable
from lemniscate.types import Step


class GymnasiumBackend(Backend):
    """Any environment of Gymnasium's interface, stepped one after the other in this process.

    Single environments are vectorized here, with autoreset DISABLED: this class resets what has ended, so every row is
    real. What is a vector environment by itself is taken as it is, in whichever mode it declares:

    - DISABLED: reset by mask after the step.
    - SAME_STEP: the returned observation is of the next episode; the true final one is in `info["final_obs"]`.
    - NEXT_STEP: the returned observation is the true final one; the next action is ignored (`valid` False).

    With `stagger`, first episodes are cut (see `Stagger`) where the environment can be reset at will (DISABLED).
    Measures are the numbers in `info`; those that the environment's metadata names in `measures`, and `is_success`, by
    these names, the others as `info/name`.

    An environment of one's own is made once at a time where there is one: it may be a robot, or hold a port. It is then
    reset where others are made again, and has no staggered episodes.
    """

    workers = False
    summaries = spaces.SUMMARIES

    @classmethod
    def ids(cls) -> Collection[str]:
        """The ids of Gymnasium's registry, without those of environments that have moved to other projects."""
        return [name for name, spec in gym.registry.items() if "function _raise" not in str(spec.entry_point)]

    @classmethod
    def serves(cls, env: str) -> bool:
        """Registered ids, and classes and functions of one's own. Raises `UserError` if these are not there."""
        return bool(maker_of(env)) if ":" in env else env in cls.ids()

    @classmethod
    def wraps(cls, env: str) -> bool:
        """Whether it is made of single environments."""
        return not makes_vector(maker_of(env))

    divides = wraps  # each single environment has a seed of its own

    @classmethod
    def room(cls, env: str) -> tuple[int, int]:
        """The memory of arrays, or of the objects of a single environment with its wrappers; no files."""
        return 8_000 if cls.wraps(env) else 200, 0

    @classmethod
    def exists_once(cls, env: str, num_envs: int) -> bool:
        """Whether it is the only one, and one's own."""
        return num_envs == 1 and is_own(maker_of(env))

    @classmethod
    def make_rendered(cls, env: str, mode: str, kwargs: Mapping[str, Any], wrappers: Sequence[str]) -> gym.Env:
        """One environment that renders itself in `mode`."""
        return make_one(maker_of(env), tuple(map(find_callable, wrappers)), render_mode=mode, **kwargs)

    def __init__(
        self,
        env: str,
        num_envs: int,
        device: torch.device,
        *,
        stagger: bool = False,
        kwargs: Mapping[str, Any] | None = None,
        wrappers: Sequence[str] = (),
    ) -> None:
        self.num_envs, self.device = num_envs, device
        maker = maker_of(env)
        self._is_vector = makes_vector(maker)
        if self._is_vector and self.workers:
            raise UserError(f"{env} makes {num_envs} environments at once, so there is none for a process of its own.")
        wraps, given = tuple(map(find_callable, wrappers)), dict(kwargs or {})
        self._make = partial(make_vector, maker, num_envs, given, wraps, self.workers)
        self._make_judge, self._judge = partial(make_one, maker, wraps, **given), None
        with creation_errors(env, kwargs, wrappers):
            self._envs, limit = self._build()
        try:
            self._read_form(env, limit)
        except BaseException:
            with suppress(Exception):  # no process is left behind
                self._envs.close()
            raise
        self._stagger_up_to = limit if stagger and self.mode is AutoresetMode.DISABLED else None
        self._calls: dict[str, Any] = {}
        self._measures = measures_of(self._envs.metadata)
        self.notices = spaces.notices(self.spec)
        self._digits: spaces.LostDigits | None = None if self.spec.image else spaces.LostDigits(self.spec)

    def _build(self) -> tuple[VectorEnv, int | None]:
        """The environments, and their time limit. What they change of torch's defaults as they are made is undone."""
        dtype = torch.get_default_dtype()
        try:
            with torch.set_grad_enabled(torch.is_grad_enabled()):
                return self._make()
        finally:
            torch.set_default_dtype(dtype)

    def _read_form(self, env: str, limit: int | None) -> None:
        """When the environments reset, and their spaces. Raises `UserError` for what nobody can learn from."""
        mode = self._envs.metadata.get("autoreset_mode")
        if not isinstance(mode, AutoresetMode):
            needed = "its metadata needs an autoreset_mode, such as AutoresetMode.NEXT_STEP of gymnasium.vector"
            raise UserError(f"{env} does not say when it resets: {needed}{f', not {shown(mode)}' if mode else ''}.")
        self.mode = mode
        space, action = self._envs.single_observation_space, spaces.action_kind(self._envs.single_action_space, env)
        parts = spaces.observation_parts(space, env)
        self._used = isinstance(action, Discrete | MultiDiscrete)
        if self._used:
            action = spaces.masked(action, *self._envs.reset(seed=0))
        self.spec = Spec(env, parts, action, max_episode_steps=limit)

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Close the environments and build them again: some (Box2D) carry more over a reset than they tell.

        Environment i of these has the seed `seed + first + i`: Gymnasium counts up.
        """
        if (self._used and not self.once) or self._envs.closed:
            self._envs.close()
            self._envs, _ = self._build()
            self.call(dict(self._calls))
        self._used = True
        self._resetting, self._valid = np.zeros(self.num_envs, dtype=bool), np.ones(self.num_envs, dtype=bool)
        self._stagger = Stagger(self.num_envs, self._stagger_up_to, seed, first)
        self.counts = torch.as_tensor(self._stagger.counts, device=self.device)
        self._masks = spaces.ActionMasks(self.spec, self.num_envs) if self.spec.action.mask_size else None
        obs = self._observe(*self._envs.reset(seed=seed + first))
        if self._masks:
            self._masks.require_choice(obs, self._valid)
        return torch.as_tensor(obs, device=self.device)

    def step(self, action: Tensor) -> Step:
        """Step, then find the true successor of each row and where to act next, as the mode demands."""
        physical = physical_action(action.detach().cpu().numpy(), self.spec.action)
        raw, reward, terminated, truncated, info = self._envs.step(physical)
        terminated, truncated = terminated.copy(), truncated & ~terminated  # new ones: a vector may write over its own
        obs = next_obs = self._observe(raw, info)
        valid, done = self._valid, terminated | truncated
        if self._masks:
            self._masks.require_alike(~self._resetting & ~done)
        if self.mode is AutoresetMode.NEXT_STEP:
            valid, self._resetting = ~self._resetting, done
        elif self.mode is AutoresetMode.SAME_STEP:
            next_obs = self._with_final(obs, info, done)
        else:
            truncated = self._stagger.apply(terminated, truncated)
            done = terminated | truncated
            if done.any():
                obs = self._observe(*self._envs.reset(options={"reset_mask": done.copy()}))
                if self._is_vector:
                    self._require_going_on(np.abs(obs - next_obs), done)
                self.counts = torch.as_tensor(self._stagger.counts, device=self.device)
        if self._masks:
            self._masks.require_choice(obs, ~self._resetting)
        tensor = partial(torch.as_tensor, device=self.device)
        there, *rest = map(tensor, (next_obs, reward.astype(np.float32), terminated, truncated, valid))
        here = there if obs is next_obs else tensor(obs)
        measures = measured(info, self._measures, self.num_envs, self.device) if info else {}
        return Step(here, there, *rest, measures=measures)

    def call(self, calls: Mapping[str, Any]) -> None:
        """Call methods of each environment or of its wrappers; of what is a vector environment by itself, its own."""
        self._calls |= calls
        vector: Any = self._envs
        for name, argument in calls.items():
            if isinstance(vector, WatchedVectorEnv):
                vector.call_method(name, argument)
                called = [self._judge] if self._judge else []
            else:
                called = vector.envs if isinstance(vector, SyncVectorEnv) else [vector.env]
            for env in called:
                call_method(env, name, argument)

    def judge_goals(self, achieved: Tensor, desired: Tensor) -> tuple[Tensor, Tensor]:
        """By the environment's own `compute_reward` and `compute_terminated`, row by row, as they are called in a step.

        Of environments in processes of their own, one more is made here to judge.
        """
        if isinstance(self._envs, SyncVectorEnv):
            judge: Any = self._envs.envs[0]
        elif self.wraps(self.spec.env_id):
            if self._judge is None:
                self._judge = self._make_judge()
                for name, argument in self._calls.items():
                    call_method(self._judge, name, argument)
            judge = self._judge
        else:
            raise UserError(f"{self.spec.env_id} makes {self.num_envs} environments at once; goals are judged by one.")
        reward, ended = judge.judge_goals(achieved.cpu().numpy(), desired.cpu().numpy())
        return torch.from_numpy(reward).to(self.device), torch.from_numpy(ended).to(self.device)

    def close(self) -> None:
        """Close the environments and their workers."""
        self._envs.close()
        if self._judge:
            self._judge.close()
            self._judge = None

    def _require_going_on(self, moved: np.ndarray, done: np.ndarray) -> None:
        """Raise `UserError` where a reset by mask moves the other rows nearly as far, too; noise moves them less."""
        sizes = np.nan_to_num(moved[:, : self.spec.observation_size])  # masks may be of some rows
        if not done.all() and sizes[~done].mean() > 0.25 * sizes[done].mean():
            raise UserError(
                f"{self.spec.env_id} is DISABLED, and its reset() changes rows whose episodes go on, in which"
                " options['reset_mask'] is False: leave them as they are, or declare NEXT_STEP or SAME_STEP."
            )

    def _with_final(self, obs: np.ndarray, info: dict, done: np.ndarray) -> np.ndarray:
        if not done.any():
            return obs
        next_obs, size, final_info = obs.copy(), self.spec.observation_size, info.get("final_info")
        final_info = final_info if isinstance(final_info, Mapping) else {}
        for row in np.flatnonzero(done):
            final = self._final(info, int(row))
            next_obs[row, :size] = flatten_observation(self.spec.observation_parts, final, image=self.spec.image)
            name, mask = mask_in(final, final_info)
            if self._masks and mask is not None and final_info.get(f"_{name}", done)[row]:
                next_obs[row, size:] = self._masks.read_mask(row_of(mask, int(row)) if name else mask, int(row))
        return next_obs

    def _final(self, info: dict, row: int) -> Any:
        """The observation in which an episode ended."""
        try:
            final = row_of(info["final_obs"], row)
        except (TypeError, KeyError, IndexError):
            final = None
        if final is None:
            entry = f"info['final_obs'][{row}]" if "final_obs" in info else "info['final_obs']"
            raise UserError(
                f"{self.spec.env_id} resets in the same step and hides the final observation (no {entry}), so"
                " its time-outs cannot be learned from; make it NEXT_STEP, DISABLED, or give final_obs."
            )
        try:
            return fitted(self._envs.single_observation_space, final)
        except ValueError as error:
            raise UserError(f"{self.spec.env_id} gives in info['final_obs'] an observation {error}.") from None

    def _observe(self, raw: Any, info: dict) -> np.ndarray:
        """The flat observation, a copy; after it the action mask, where there is one."""
        flat = flatten_observation(self.spec.observation_parts, raw, image=self.spec.image)
        if self._digits and self._digits.add(raw):
            self.notices, self._digits = [*self.notices, *self._digits.notices()], None
        if self._masks:
            return self._masks.append_to(flat, raw, info)
        if not info.keys().isdisjoint(spaces.MASKS):
            raise spaces.late_mask(self.spec)
        return flat.copy()


class AsyncGymnasiumBackend(GymnasiumBackend):
    """The same, with a process for each environment. No id is served so unless it is asked for."""

    workers = True
    in_process = "gymnasium"

    @classmethod
    def room(cls, env: str) -> tuple[int, int]:
        """The memory and files of a Python process with NumPy and Gymnasium, and of its pipes."""
        return 100_000_000, 5
