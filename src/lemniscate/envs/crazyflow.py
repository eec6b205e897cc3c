# pyright: reportAttributeAccessIssue=false
"""crazyflow's drones, as pure functions of their state.

crazyflow's environments are NEXT_STEP: they simulate, then reset what ended one step earlier, then compute a reward at
the reset state. Here the same methods are called in another order, that of `jax_backend`, so that every row is real.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import torch

from lemniscate.envs.backend import Scene, Summary
from lemniscate.envs.drone_interface import interface_of
from lemniscate.envs.interface import Interface
from lemniscate.envs.jax_backend import JaxBackend, Outcome, Programs, State, jax_device
from lemniscate.envs.spaces import action_kind
from lemniscate.errors import UserError, missing_extra, unknown_name
from lemniscate.spec import Box, ObservationPart, Spec

if TYPE_CHECKING:
    import jax

IDS = ("DroneFigureEightTrajectory-v0", "DroneLanding-v0", "DroneReachPos-v0", "DroneReachVel-v0")
CONTROL_HZ = 50
AHEAD = 0.75
"""the share of staggered episodes that begin ahead of their beginning"""
STATE_PARTS = ("pos", "quat", "vel", "ang_vel")
REFERENCE = "local_samples"
"""the part of an observation that begins with the way to the reference"""


class Drones:
    """A crazyflow environment with its state apart (SimData, and every array that the object keeps beside it).

    The environment's own methods are traced with its state put in and taken out again, so whatever it computes
    (rewards, ends, goals, randomization) is computed by crazyflow's code.
    """

    def __init__(self, env_id: str, num_envs: int, device: str, kwargs: Mapping[str, Any]) -> None:
        import jax
        import jax.numpy as jnp

        with _quietly():
            made = gym.make_vec(env_id, num_envs=num_envs, device=device, **{"freq": CONTROL_HZ, **kwargs})
        self.env = env = made.unwrapped
        for name, value in vars(env).items():
            if isinstance(value, np.ndarray):  # the reference trajectory: NumPy cannot be indexed by a tracer
                setattr(env, name, jnp.asarray(value, device=env.device))
        self.num_envs, self.device = num_envs, env.device
        self.low, self.high = env.single_action_space.low, env.single_action_space.high
        self.action_size = self.low.size
        self.episode_steps = round(env.max_episode_time * env.freq)
        """the time limit, in control steps"""
        sizes = {name: space.shape[-1] for name, space in env.single_observation_space.spaces.items()}
        names = (*STATE_PARTS, *(name for name in sizes if name not in STATE_PARTS))
        self.parts = tuple(ObservationPart((name,), (sizes[name],)) for name in names)
        """the flat observation: the drone's state first, then the task's own parts"""
        start = sum(part.size for part in self.parts[: len(STATE_PARTS)])
        self.error = slice(start, start + 3) if REFERENCE in names else None
        self._arrays = [name for name, value in vars(env).items() if isinstance(value, jax.Array)]
        self._initial = self._take()

    def _take(self) -> State:
        return self.env.sim.data, {name: getattr(self.env, name) for name in self._arrays}

    @contextlib.contextmanager
    def _at(self, state: State) -> Iterator[Any]:
        """The environment in a state; afterwards no placeholder of a tracer stays behind in it."""
        try:
            self._put(state)
            yield self.env
        finally:
            self._put(self._initial)

    def _put(self, state: State) -> None:
        self.env.sim.data = state[0]
        for name, value in state[1].items():
            setattr(self.env, name, value)

    def _observe(self) -> jax.Array:
        import jax.numpy as jnp

        parts = self.env.obs()
        return jnp.concatenate([parts[part.name] for part in self.parts], axis=-1)

    def init(self, key: jax.Array) -> State:
        """The state of drones that have not begun. Goals get keys of their own, which crazyflow never seeds."""
        import jax

        data, arrays = self._initial
        arrays = {
            name: jax.random.fold_in(key, i) if jax.numpy.issubdtype(value.dtype, jax.dtypes.prng_key) else value
            for i, (name, value) in enumerate(arrays.items(), start=1)
        }
        return data.replace(core=data.core.replace(rng_key=key)), arrays

    def reset(self, state: State, mask: jax.Array, stagger: jax.Array) -> tuple[State, jax.Array, jax.Array]:
        """Reset the masked drones; those that begin ahead of the beginning are fragments.

        Ahead means at a random step of the episode, and on the reference curve at that point of it.
        """
        import jax

        with self._at(state) as env:
            env._reset(mask=mask)
            data = env.sim.data
            key, whether, where = jax.random.split(data.core.rng_key, 3)
            ahead = mask & stagger & jax.random.bernoulli(whether, AHEAD, (self.num_envs,))
            steps = jax.random.randint(where, (self.num_envs,), 1, self.episode_steps) * ahead
            pos = data.states.pos
            if hasattr(env, "trajectory"):
                pos = pos + (env.trajectory[steps - 1] - env.trajectory[-1])[:, None]
            core = data.core.replace(rng_key=key, steps=data.core.steps + steps[:, None] * env.n_substeps)
            env.sim.data = data.replace(states=data.states.replace(pos=pos), core=core)
            return self._take(), self._observe(), ahead

    def step(self, state: State, action: jax.Array) -> tuple[State, Outcome]:
        """One control step of every drone."""
        import jax.numpy as jnp

        with self._at(state) as env:
            env._apply_action(self.low + 0.5 * (jnp.clip(action, -1, 1) + 1) * (self.high - self.low))
            env.sim.step(env.n_substeps)
            obs = self._observe()
            measures = {} if self.error is None else {"tracking_error": jnp.linalg.norm(obs[:, self.error], axis=-1)}
            return self._take(), (obs, env.reward(), env.terminated(), env.truncated(), measures)


@lru_cache(maxsize=4)
def programs(env_id: str, num_envs: int, device: str, kwargs: tuple[tuple[str, Any], ...]) -> Programs:
    """The compiled programs of so many drones, built once a process: all vectors of a size share them."""
    return Programs(Drones(env_id, num_envs, device, dict(kwargs)))


class CrazyflowBackend(JaxBackend):
    """N drones flown at 50 Hz by normalized [roll, pitch, yaw, thrust] commands, all on one device.

    The flat observation is position 3 (m), quaternion 4 (xyzw), velocity 3 (m/s), angular velocity 3 (rad/s), then the
    task's own part: for the figure eight, `local_samples` 30, the next ten points of the curve, 0.1 s apart, as seen
    from the drone (m). The length of its first three numbers is the measure `tracking_error`, in metres.

    With `stagger`, three of four episodes begin at a random time of theirs, on the reference curve where there is one:
    as if the drone had been flying before. All of the course is flown from the first step on, and the drones never fly
    in step. Their returns are not counted, since they are fragments.

    `kwargs` are crazyflow's: `dynamics`, `drone`, `max_episode_time` (s), `freq` (Hz), and those of the task.
    """

    @classmethod
    def ids(cls) -> Collection[str]:
        """Crazyflow's four tasks."""
        return IDS

    @classmethod
    def serves(cls, env: str) -> bool:
        """Whether it is one of them."""
        return env in IDS

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
        assert not wrappers, "drones cannot be wrapped"
        _import()
        kwargs = dict(kwargs or {})
        _check(env, kwargs)
        try:
            shared = programs(env, num_envs, jax_device(device), tuple(sorted(kwargs.items())))
        except (TypeError, ValueError, KeyError, AssertionError) as error:
            if not kwargs:
                raise
            raise UserError(f"{env} cannot be made with {kwargs}: {error}.") from error
        super().__init__(shared, num_envs, device, stagger=stagger)
        self._drones = drones = shared.envs
        assert isinstance(drones, Drones)
        action = action_kind(drones.env.single_action_space, env)
        assert isinstance(action, Box)
        self.spec = Spec(env, drones.parts, action, max_episode_steps=drones.episode_steps)
        if drones.error:
            self.summaries = (
                Summary("rmse_mm", "tracking_error", "rms", scale=1000),
                Summary("rmse_after_1s_mm", "tracking_error", "rms", scale=1000, skip=drones.env.freq),
            )

    @property
    def scene(self) -> Scene | None:
        """The drone and its reference, where it has one."""
        drones = self._drones
        if drones.error is None:
            return None
        return Scene(drones.env.sim.mj_model, 1 / drones.env.freq, slice(0, 3), slice(3, 7), drones.error)

    @property
    def interface(self) -> Interface:
        """Units, frames and times, for policies that leave Python."""
        return interface_of(self._drones.env)


def _import() -> None:
    os.environ.setdefault("SCIPY_ARRAY_API", "1")  # crazyflow insists, and before SciPy is first imported
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # MJX announces optional packages that it does not find
            import crazyflow  # noqa: F401  (registers the environments)
    except ModuleNotFoundError as error:
        raise missing_extra("crazyflow", "drone") from error


def _check(env_id: str, kwargs: Mapping[str, Any]) -> None:
    """Raise `UserError` for an argument that the environment does not have, or that cannot be compared."""
    entry: Any = gym.spec(env_id).vector_entry_point
    known = set(inspect.signature(entry).parameters) - {"num_envs", "device"}
    for name, value in kwargs.items():
        if name not in known:
            raise unknown_name(f"argument of {env_id}", name, known)
        if not isinstance(value, (int, float, str, type(None))) and not callable(value):
            raise UserError(f"{name} of {env_id} must be a number or a word, not {value!r}.")


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """MuJoCo warns about a model detail of crazyflow's on standard error and in a file in the working directory."""
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        mujoco.set_mju_user_warning(None)
