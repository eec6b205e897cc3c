"""Our parallel environments as Gymnasium's `VectorEnv`, for a training loop of one's own."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers import vector as wrappers_of_vectors
from gymnasium.wrappers.utils import RunningMeanStd

from lemniscate.envs import registry
from lemniscate.envs.conversion import normalized_action
from lemniscate.envs.returned import as_array
from lemniscate.envs.vec_env import VecEnv
from lemniscate.errors import UserError, shown
from lemniscate.spec import Action, Box, Discrete, MultiDiscrete, Spec
from lemniscate.types import Step


def make_vec(
    env: str | Callable[..., Any],
    num_envs: int = 1,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[str | Callable[..., Any]] = (),
    backend: str | None = None,
) -> "VectorView":
    """N parallel environments with Gymnasium's interface; named as `gymnasium.make_vec`, whose place it takes.

    Args:
        env: an id, `module:Class`, a class, or a function that makes an environment.
        num_envs: N.
        env_kwargs: arguments of the environment.
        wrappers: around each single environment, the first innermost.
        backend: gymnasium, gymnasium-async, envpool or crazyflow; by default the first that serves `env`.

    Raises:
        UserError: an unknown environment or backend, arguments that it does not take, spaces nobody can act in.
    """
    return VectorView(registry.make(env, num_envs, kwargs=env_kwargs, wrappers=wrappers, backend=backend))


class VectorView(VectorEnv):
    """A `VecEnv` as a `gymnasium.vector.VectorEnv`: NumPy in, NumPy out.

    Observations are float32 arrays [N, O]: a Dict is flattened in the order of its keys, a whole number is one-hot; a
    Box keeps its shape, and images their bytes, channels last. Actions are in the environment's own units, clipped.

    What has ended is reset in the same step (`metadata["autoreset_mode"]` is SAME_STEP): the observation returned is
    the first of the next episode, and `info["final_obs"][i]` the last of the one that ended, where
    `info["_final_obs"][i]`. A vector environment that is NEXT_STEP by itself stays so. `info` also has the measures and
    the action mask of each environment, where it has any.
    """

    def __init__(self, env: VecEnv) -> None:
        self.env, self.num_envs = env, env.num_envs
        self._next_step = env.backend.mode is AutoresetMode.NEXT_STEP
        self.metadata = {"autoreset_mode": env.backend.mode if self._next_step else AutoresetMode.SAME_STEP}
        self.single_observation_space = observation_space(env.spec)
        self.single_action_space = action_space(env.spec.action)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self.action_space = batch_space(self.single_action_space, env.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin again in every environment, as if just made with `seed`; without one, with a drawn one.

        Raises:
            UserError: a seed for each environment, or a reset of some of them.
        """
        self._require_open()
        if options:
            raise UserError(f"All environments are reset together, without options such as {next(iter(options))}.")
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer | None) or not 0 <= (seed or 0) < 2**32:
            raise UserError(
                "seed must be one whole number from 0 to 4,294,967,295, from which those of all environments follow,"
                f" not {seed!r}."
            )
        super().reset(seed=None if seed is None else int(seed))
        obs = self.env.restart(int(self.np_random.integers(2**31)) if seed is None else int(seed))
        return self._shaped(obs), self._masks(obs)

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """(observations, rewards [N] float32, terminated [N], truncated [N], info) after one action in each.

        Raises:
            UserError: actions of another shape, or that are no choices.
        """
        self._require_open()
        actions, is_box = as_array(actions), isinstance(self.env.spec.action, Box)
        if actions.shape != self.action_space.shape:
            raise UserError(f"Actions have the shape {self.action_space.shape} here, not {actions.shape}.")
        with suppress(ValueError, TypeError):  # of numbers, each an object
            actions = actions.astype(np.float64) if actions.dtype.kind == "O" else actions
        if actions.dtype.kind not in "biuf" or not (is_box or (actions == np.rint(actions)).all()):
            wrong = next((x for x in actions.flatten().tolist() if not isinstance(x, int | float) or x % 1), None)
            raise UserError(f"Actions are {'' if is_box else 'whole '}numbers here, and not {shown(wrong)}.")
        step = self.env.step(torch.from_numpy(normalized_action(actions, self.env.spec.action)))
        reward = (step.reward * step.valid).numpy()  # that of an ignored action is 0, as in Gymnasium
        flags = step.terminated.numpy().copy(), step.truncated.numpy().copy()
        return self._shaped(step.obs), reward, *flags, self._info(step)

    def _require_open(self) -> None:
        if self.closed:
            raise UserError(f"These environments of {self.env.spec.env_id} are closed: make others.")

    def close_extras(self, **kwargs: Any) -> None:
        """Give back processes and windows."""
        self.env.close()

    def _info(self, step: Step) -> dict[str, Any]:
        """The `info` of Gymnasium's layout: the entries of an ended episode are under `final_info`."""
        reset = (step.terminated | step.truncated).numpy() & (not self._next_step)
        info = self._masks(step.obs)
        measures = {name.removeprefix("info/"): values.numpy().copy() for name, values in step.measures.items()}
        given = {name: ~np.isnan(values) for name, values in measures.items()}
        for name, values in measures.items():
            info |= {name: values, f"_{name}": given[name] & ~reset}
        last = self._shaped(step.next_obs)
        for row in np.flatnonzero(reset):
            final = {name: values[row] for name, values in measures.items() if given[name][row]}
            info = self._add_info(info, {"final_obs": last[row], "final_info": final}, int(row))
        return info

    def _shaped(self, obs: torch.Tensor) -> np.ndarray:
        """A copy [N, …] in the shape of the space, without the action mask."""
        flat = obs[:, : self.env.spec.observation_size].cpu().numpy()
        return flat.reshape(self.num_envs, *(self.single_observation_space.shape or ())).copy()

    def _masks(self, obs: torch.Tensor) -> dict[str, Any]:
        if not self.env.spec.action.mask_size:
            return {}
        masks = obs[:, self.env.spec.observation_size :].cpu().numpy().astype(np.int8)
        return {"action_mask": masks, "_action_mask": np.ones(self.num_envs, dtype=bool)}


def observation_space(spec: Spec) -> spaces.Box:
    """The space of the flat observation; of the only part, if it is a Box, in its own shape."""
    only = spec.observation_parts[0]
    shape = only.shape if len(spec.observation_parts) == 1 and not only.nvec else (spec.observation_size,)
    if spec.image:
        return spaces.Box(0, 255, shape, np.uint8)
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def action_space(action: Action) -> spaces.Space:
    """The space that a record of actions was read from."""
    if isinstance(action, Discrete):
        return spaces.Discrete(action.n, start=action.start, dtype=np.dtype(action.dtype).type)
    if isinstance(action, Box):
        kind, ends = np.dtype(action.dtype), [action.low, action.high]
        if kind.kind in "iu":  # what has no bound has that of its type
            least, most = np.iinfo(kind).min, np.iinfo(kind).max
            ends = [[int(min(max(x, least), most)) for x in end] for end in ends]
        shape = (action.size,) if action.shape is None else action.shape
        low, high = np.array(ends, dtype=kind).reshape(2, *shape)
        return spaces.Box(low, high, shape, kind.type)
    if isinstance(action, MultiDiscrete):
        shape = action.shape or (len(action.nvec),)
        nvec, start = np.reshape(action.nvec, shape), np.reshape(action.start, shape)
        return spaces.MultiDiscrete(nvec, dtype=np.dtype(action.dtype).type, start=start)
    return spaces.MultiBinary(action.n if action.shape in (None, (action.n,)) else action.shape)


class NormalizeObservation(wrappers_of_vectors.NormalizeObservation):
    """Gymnasium's wrapper of that name, which refuses SAME_STEP, for SAME_STEP.

    `info["final_obs"]` is normalized too, by the same statistics. Evaluation sets `update_running_mean = False`.
    """

    def __init__(self, env: VectorEnv, epsilon: float = 1e-8) -> None:
        VectorWrapper.__init__(self, env)  # past the two that refuse
        shape = self.single_observation_space.shape
        self.single_observation_space = spaces.Box(-np.inf, np.inf, shape, np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.num_envs, *(shape or ())), np.float32)
        self.obs_rms = RunningMeanStd(shape=shape or ())
        self.epsilon, self._update_running_mean = epsilon, True

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Gymnasium's, with normalized final observations."""
        obs, reward, terminated, truncated, info = super().step(actions)
        for row in np.flatnonzero(info.get("_final_obs", ())):
            final = info["final_obs"][row] - self.obs_rms.mean
            info["final_obs"][row] = (final / np.sqrt(self.obs_rms.var + self.epsilon)).astype(np.float32)
        return obs, reward, terminated, truncated, info
