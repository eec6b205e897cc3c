"""EnvPool: environments in C++, stepped by native threads (Weng et al. 2022, arXiv:2206.10558)."""

import os
import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.episodes import Stagger
from lemniscate.envs.spaces import action_kind, flatten_observation, is_image, observation_layout, physical_action
from lemniscate.errors import UserError
from lemniscate.spec import Spec
from lemniscate.types import Step


class EnvpoolBackend:
    """N copies of one of the ids that EnvPool serves.

    EnvPool by itself resets in the step after an end and ignores the action of that step. Here an ended copy is reset
    at once, so that every row is real. With `stagger`, first episodes are cut: see `Stagger`.

    Nothing depends on `num_threads` but the speed; by default there is one for each processor that we may use.
    """

    def __init__(
        self, env_id: str, num_envs: int, device: torch.device, *, stagger: bool = False, num_threads: int | None = None
    ) -> None:
        self.num_envs, self.device = num_envs, device
        self._num_threads = min(num_envs, num_threads or len(os.sched_getaffinity(0)))
        self._valid = torch.ones(num_envs, dtype=torch.bool, device=device)
        self._pool = self._build(env_id, 0)
        limit = int(self._pool.config["max_episode_steps"])
        self._stagger_up_to = limit if stagger else None
        self.spec = Spec(
            env_id=env_id,
            layout=observation_layout(self._pool.observation_space, env_id),
            action=action_kind(self._pool.action_space, env_id),
            max_episode_steps=limit,
            image=is_image(self._pool.observation_space),
        )

    def _build(self, env_id: str, seed: int) -> Any:
        import envpool

        if env_id not in envpool.list_all_envs():
            raise UserError(f"EnvPool does not serve {env_id}; leave out the backend, or take gymnasium.")
        copies = {"num_envs": self.num_envs, "num_threads": self._num_threads}
        pool = envpool.make(env_id, env_type="gymnasium", seed=seed, **copies)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium's, on bounds that are float64 here and float32 there
            _ = pool.observation_space, pool.action_space  # made and kept when first looked at
        return pool

    def restart(self, seed: int) -> Tensor:
        """Build the pool again: nothing of the past remains."""
        self._pool.close()
        self._pool = self._build(self.spec.env_id, seed % 2**31)
        self._stagger = Stagger(self.num_envs, self._stagger_up_to, seed)
        self.counts = self._tensor(self._stagger.counts)
        obs, _ = self._pool.reset()
        return self._tensor(self._seen(obs))

    def step(self, action: Tensor) -> Step:
        """Step all copies, then reset those whose episode has ended."""
        raw, reward, terminated, truncated, _ = self._pool.step(physical_action(action.cpu().numpy(), self.spec.action))
        next_obs = self._seen(raw)
        truncated = self._stagger.apply(terminated, truncated & ~terminated)
        done = terminated | truncated
        here = there = self._tensor(next_obs)
        if done.any():
            fresh, info = self._pool.reset(np.flatnonzero(done).astype(np.int32))
            obs = next_obs.copy()
            obs[info["env_id"]] = self._seen(fresh)
            here, self.counts = self._tensor(obs), self._tensor(self._stagger.counts)
        return Step(
            obs=here,
            next_obs=there,
            reward=self._tensor(reward.astype(np.float32)),
            terminated=self._tensor(terminated),
            truncated=self._tensor(truncated),
            valid=self._valid,
        )

    def close(self) -> None:
        """Let the pool's threads end."""
        self._pool.close()

    def _seen(self, raw: Any) -> np.ndarray:
        return flatten_observation(self.spec.layout, raw, image=self.spec.image)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)
