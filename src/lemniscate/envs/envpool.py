"""EnvPool: environments in C++, stepped by native threads (Weng et al. 2022, arXiv:2206.10558)."""

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.backend import Backend
from lemniscate.envs.conversion import SUCCESS, flatten_observation, measured, physical_action, row_of
from lemniscate.envs.registry import ID_PREFIXES
from lemniscate.envs.returned import mask_in
from lemniscate.envs.spaces import SUMMARIES, ActionMasks, action_kind, is_image, masked, observation_parts
from lemniscate.envs.vec_env import Stagger
from lemniscate.errors import UserError, is_installed, missing_extra, unknown_name
from lemniscate.spec import Spec
from lemniscate.system.machine import cores
from lemniscate.types import Step

PREFIX, *GYMNASIUM_IDS = ID_PREFIXES["envpool"]
"""what an id of EnvPool's own begins with here, so that it is not mistaken for Gymnasium's of that name; and the ids
that are the same in both: tests/envs/test_envpool.py compares them"""

REFUSED = {
    "procgen": "its games begin the next level in the step that ends one, which hides the final observation.",
    "vizdoom": "its buttons are numbers without bounds, in which no policy can explore.",
}
"""families that do not fulfil the contract, and why: see docs/decisions/0008-envpool-families.md"""

NO_LIMIT = 2**31 - 1
"""the time limit of an environment that has none"""

RESERVED = ("num_envs", "batch_size", "num_threads", "seed", "env_seed", "base_path", "max_num_players")
"""options of EnvPool that are not the environment's"""


class EnvpoolBackend(Backend):
    """N parallel environments of one of the ids that EnvPool serves.

    EnvPool by itself resets in the step after an end and ignores the action of that step. Here an environment that has
    ended is reset at once, so that every row is real. With `stagger`, first episodes are cut: see `Stagger`. It has a
    thread for each processor that we may use; nothing depends on their number but the speed.
    """

    summaries = SUMMARIES
    package = "envpool"

    @classmethod
    def ids(cls) -> Collection[str]:
        """The ids that are the same in Gymnasium; and all of EnvPool's, with `EnvPool/` before them."""
        if not is_installed("envpool"):
            return ()
        import envpool

        return (*GYMNASIUM_IDS, *(PREFIX + task for task in envpool.list_all_envs() if not refusal(task)))

    @classmethod
    def serves(cls, env: str) -> bool:
        """Whether it is one of them, by the name."""
        return env.startswith(PREFIX) or (env in GYMNASIUM_IDS and is_installed("envpool"))

    @classmethod
    def room(cls, env: str) -> tuple[int, int]:
        """The memory of the smallest environment, CartPole; no files."""
        return 10_000, 0

    @classmethod
    def make_rendered(cls, env: str, mode: str, kwargs: Mapping[str, Any], wrappers: Sequence[str]) -> gym.Env:
        """One environment that renders itself in `mode`: Gymnasium's where it is the same, else EnvPool's."""
        if env in GYMNASIUM_IDS and not kwargs:
            return gym.make(env, render_mode=mode)
        return SingleEnv(env.removeprefix(PREFIX), mode, kwargs)

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
        assert not wrappers, "EnvPool's environments cannot be wrapped"
        self.num_envs, self.device = num_envs, device
        self._valid = torch.ones(num_envs, dtype=torch.bool, device=device)
        own = {"num_envs": num_envs, "num_threads": min(num_envs, cores())}
        self._build = pools(env.removeprefix(PREFIX), kwargs or {}, own)
        self._pool = self._build(0)
        limit = int(self._pool.config["max_episode_steps"])
        self._limit = limit if limit < NO_LIMIT else None
        self._stagger_up_to = self._limit if stagger else None
        space = self._pool.observation_space
        parts, action = observation_parts(space, env), action_kind(self._pool.action_space, env)
        if not is_image(space):  # no game has a mask, and to reset many takes seconds
            action = masked(action, *self._pool.reset())
        self.spec = Spec(env, parts, action, max_episode_steps=self._limit)

    @classmethod
    def divides(cls, env: str) -> bool:
        """Yes: each environment has a seed of its own."""
        return True

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Build the pool again: nothing of the past remains."""
        self._pool.close()
        self._pool = self._build(seed + first)
        self._stagger = Stagger(self.num_envs, self._stagger_up_to, seed, first)
        self.counts = self._tensor(self._stagger.counts)
        self._masks = ActionMasks(self.spec, self.num_envs) if self.spec.action.mask_size else None
        return self._tensor(self._observe(*self._pool.reset()))

    def step(self, action: Tensor) -> Step:
        """Step all environments, then reset those whose episode has ended."""
        physical = physical_action(action.cpu().numpy(), self.spec.action)
        raw, reward, terminated, truncated, info = self._pool.step(physical)
        next_obs = self._observe(raw, info)
        if self._limit:
            truncated |= info["elapsed_step"] >= self._limit  # not every family ends there by itself
        truncated = self._stagger.apply(terminated, truncated & ~terminated)
        done = terminated | truncated
        here = there = self._tensor(next_obs)
        if done.any():
            fresh, reset_info = self._pool.reset(np.flatnonzero(done).astype(np.int32))
            obs = next_obs.copy()
            obs[reset_info["env_id"]] = self._observe(fresh, reset_info)
            here, self.counts = self._tensor(obs), self._tensor(self._stagger.counts)
        reward, ended, cut = map(self._tensor, (reward.astype(np.float32), terminated, truncated))
        measures = measured(info, SUCCESS, self.num_envs, self.device)
        return Step(here, there, reward, ended, cut, self._valid, measures)

    def close(self) -> None:
        """Let the pool's threads end."""
        self._pool.close()

    def _observe(self, raw: Any, info: Mapping[str, Any]) -> np.ndarray:
        """The flat observations of all, or of those that were reset; after them the action masks, where there are."""
        flat = flatten_observation(self.spec.observation_parts, raw, image=self.spec.image)
        if self._masks is None:
            return flat
        rows = self._masks.append_to(flat, raw, info, info["env_id"])
        masks = rows[:, flat.shape[1] :]
        masks[~masks.any(axis=1)] = 1  # mazes without a way begin so; any action ends them
        return rows

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)


class SingleEnv(gym.Env):
    """One environment of EnvPool's with Gymnasium's interface, for rendering."""

    def __init__(self, task: str, mode: str, kwargs: Mapping[str, Any]) -> None:
        self._make = pools(task, kwargs, {"num_envs": 1, "render_mode": mode})
        self._pool = self._make(0)
        self.render_mode = mode
        self.observation_space, self.action_space = self._pool.observation_space, self._pool.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Build it again from `seed`: EnvPool seeds at no other time."""
        self._pool.close()
        self._pool = self._make(seed or 0)
        obs, info = self._pool.reset()
        return row_of(obs, 0), self._mask(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step."""
        obs, reward, terminated, truncated, info = self._pool.step(np.asarray(action)[None])
        late = bool(info["elapsed_step"][0] >= self._pool.config["max_episode_steps"])  # not every family ends there
        return row_of(obs, 0), float(reward[0]), bool(terminated[0]), bool(truncated[0]) or late, self._mask(info)

    def _mask(self, info: Mapping[str, Any]) -> dict[str, Any]:
        """The info of one environment, with its mask of actions if it has one."""
        mask = mask_in(None, info)[1]
        return {} if mask is None else {"action_mask": np.asarray(mask)[0] if np.any(mask) else np.ones_like(mask)[0]}

    def render(self) -> Any:
        """The picture [H, W, 3] uint8, or None in a window."""
        frames = self._pool.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Let the pool's threads end."""
        self._pool.close()


def make_pool(task: str, options: Mapping[str, Any], seed: int) -> Any:
    """A pool of EnvPool's, whose environments count up from `seed`. Raises `UserError` where it cannot be made."""
    import envpool

    try:
        pool = envpool.make(task, env_type="gymnasium", seed=seed % 2**31, **options)
    except (ImportError, TypeError, ValueError, RuntimeError, AssertionError) as error:
        first_line = str(error).partition("\n")[0]
        raise UserError(f"EnvPool cannot make {task}: {first_line}") from error
    with warnings.catch_warnings(action="ignore"):  # Gymnasium's: bounds are float64 here and float32 there
        _ = pool.observation_space, pool.action_space  # made and kept when first looked at
    return pool


def family(task: str) -> str:
    """The part of EnvPool that an id belongs to, such as atari or mujoco.playground."""
    from envpool.registration import registry

    return registry.specs[task][0].removeprefix("envpool.")


def refusal(task: str) -> str | None:
    """Why an id of EnvPool's is not served; None for one that is."""
    part = family(task)
    if (part == "pgx" and task != "Play2048-v1") or "multiagent" in task.lower().replace("-", ""):
        return "it has several players."
    return REFUSED.get(part)


def pools(task: str, options: Mapping[str, Any], own: Mapping[str, Any]) -> Callable[[int], Any]:
    """From a seed to a pool of a task, with a user's options and our own.

    Raises `UserError` for options that there are not, and for a task that is not served.
    """
    if not is_installed("envpool"):
        raise missing_extra("envpool", "envpool")
    import envpool

    if task not in envpool.list_all_envs():
        raise unknown_name("environment of EnvPool", task, envpool.list_all_envs())
    if reason := refusal(task):
        raise UserError(f"{PREFIX}{task} is not served: {reason}")
    defaults = envpool.make_spec(task).config._asdict() if options else {}
    known = {name: value for name, value in defaults.items() if name not in RESERVED}
    for name, value in options.items():
        if name not in known:
            other = " Gymnasium's arguments are those of the gymnasium backend." if task in GYMNASIUM_IDS else ""
            raise UserError(f"{unknown_name(f'option of EnvPool’s {task}', name, known)}{other}")
        if not isinstance(value, (int, float) if isinstance(known[name], float) else type(known[name])):
            kind = type(known[name]).__name__
            raise UserError(
                f"{name} of EnvPool's {task} must be of type {kind}, such as {known[name]!r}, not {value!r}."
            )
    if not 1 <= options.get("max_episode_steps", 1) < 2**31:
        steps = options["max_episode_steps"]
        raise UserError(f"max_episode_steps of EnvPool's {task} must be from 1 to {2**31 - 1:,}, not {steps:,}.")
    return partial(make_pool, task, {**options, **own})
