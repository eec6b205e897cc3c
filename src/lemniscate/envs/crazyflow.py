# pyright: reportAttributeAccessIssue=false
"""crazyflow's drones: one compiled call a step, JAX to torch without a copy.

crazyflow's environments are NEXT_STEP: they simulate, then reset what ended one step earlier, then compute a reward at
the reset state. Here the same methods are put in another order, so that every row is real:

    act → simulate → true observation, reward, ends → reset what ended → where to act next

and the whole of it is traced once into a single XLA program.
"""

import contextlib
import io
import os
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from lemniscate.envs.spaces import action_kind
from lemniscate.errors import UserError, missing_extra
from lemniscate.spec import Box, ObservationPart, Spec
from lemniscate.types import Step

os.environ.setdefault("SCIPY_ARRAY_API", "1")  # crazyflow insists, and before SciPy is first imported
try:
    with contextlib.redirect_stdout(io.StringIO()):  # MJX announces optional packages that it does not find
        import crazyflow  # noqa: F401  (registers the environments)
        import gymnasium as gym
        import jax
        import jax.numpy as jnp
        import mujoco
        import numpy as np
except ModuleNotFoundError as error:
    raise missing_extra("crazyflow", "drone") from error

CONTROL_HZ = 50
AHEAD = 0.75
"""the share of staggered episodes that begin ahead of their beginning"""
STATE_PARTS = ("pos", "quat", "vel", "ang_vel")

State = tuple[Any, dict[str, jax.Array]]
"""crazyflow's SimData, and every array that the environment object keeps beside it."""


class Simulator:
    """A crazyflow environment as two pure, compiled functions of its state.

    The environment's own methods are traced with its state put in and taken out again, so whatever it computes
    (rewards, ends, goals, randomization) is computed by crazyflow's code.
    """

    def __init__(self, env_id: str, num_envs: int, device: str) -> None:
        with _quietly():
            env: Any = gym.make_vec(env_id, num_envs=num_envs, freq=CONTROL_HZ, device=device).unwrapped
        for name, value in vars(env).items():
            if isinstance(value, np.ndarray):  # the reference trajectory: NumPy cannot be indexed by a tracer
                setattr(env, name, jnp.asarray(value, device=env.device))
        self.env, self.num_envs = env, num_envs
        self.low, self.high = env.single_action_space.low, env.single_action_space.high
        self._initial = self._take()
        self.restart, self.step = self._compile()

    def _compile(self) -> tuple[Callable, Callable]:
        """Both programs: traced one after the other, since tracing uses the environment, but compiled side by side."""
        device = self.env.device
        seed, stagger = jax.device_put((np.uint32(0), np.bool_(False)), device)
        action = jax.device_put(np.zeros((self.num_envs, self.low.size), np.float32), device)
        restart = jax.jit(self._restart).lower(seed, stagger)
        step = jax.jit(self._step).lower(restart.out_info[0], action, stagger)
        self._put(self._initial)  # tracing leaves its own placeholders behind
        with ThreadPoolExecutor(2) as pool:
            programs = list(pool.map(lambda lowered: lowered.compile(), (restart, step)))
        return programs[0], programs[1]

    def _take(self) -> State:
        arrays = {name: value for name, value in vars(self.env).items() if isinstance(value, jax.Array)}
        return self.env.sim.data, arrays

    def _put(self, state: State) -> None:
        self.env.sim.data = state[0]
        for name, value in state[1].items():
            setattr(self.env, name, value)

    def _flat(self) -> jax.Array:
        """The observation in its documented order: the drone's state first, then the task's own parts."""
        parts = self.env.obs()
        names = (*STATE_PARTS, *(name for name in parts if name not in STATE_PARTS))
        self.layout = tuple(ObservationPart((name,), (parts[name].shape[-1],)) for name in names)
        return jnp.concatenate([parts[name] for name in names], axis=-1)

    def _restart(self, seed: jax.Array, stagger: jax.Array) -> tuple[State, jax.Array, jax.Array]:
        data, arrays = self._initial
        key = jax.random.key(seed)
        # Goals are drawn from keys of their own, which crazyflow never seeds.
        arrays = {
            name: jax.random.fold_in(key, i) if jnp.issubdtype(value.dtype, jax.dtypes.prng_key) else value
            for i, (name, value) in enumerate(arrays.items(), start=1)
        }
        self._put((data.replace(core=data.core.replace(rng_key=key)), arrays))
        return self._begin(jnp.ones(self.num_envs, dtype=bool), stagger)

    def _begin(self, mask: jax.Array, stagger: jax.Array) -> tuple[State, jax.Array, jax.Array]:
        """Reset the masked drones: (state, observation, which of all drones begin ahead of the beginning).

        Ahead means with the clock at a random step of the episode, and on the reference curve at that point of it.
        """
        env = self.env
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
        return self._take(), self._flat(), ahead

    def _step(self, state: State, action: jax.Array, stagger: jax.Array) -> tuple[State, tuple[jax.Array, ...]]:
        self._put(state)
        env = self.env
        env._apply_action(self.low + 0.5 * (jnp.clip(action, -1, 1) + 1) * (self.high - self.low))
        env.sim.step(env.n_substeps)
        next_obs, reward = self._flat(), env.reward()
        terminated = env.terminated()
        truncated = env.truncated() & ~terminated
        state, obs, ahead = self._begin(terminated | truncated, stagger)
        return state, (obs, next_obs, reward, terminated, truncated, ahead)

    @property
    def model(self) -> Any:
        """The scene with the drone, a MuJoCo model, for rendering."""
        return self.env.sim.mj_model

    @property
    def episode_steps(self) -> int:
        """The time limit, in control steps."""
        return round(self.env.max_episode_time * self.env.freq)


@lru_cache(maxsize=4)
def simulator(env_id: str, num_envs: int, device: str) -> Simulator:
    """The compiled program for so many drones on cpu or cuda, built once a process: all vectors of a size share it."""
    return Simulator(env_id, num_envs, "gpu" if device == "cuda" else "cpu")


class CrazyflowBackend:
    """N drones flown at 50 Hz by normalized [roll, pitch, yaw, thrust] commands, all on one device.

    The flat observation is position 3 (m), quaternion 4 (xyzw), velocity 3 (m/s), angular velocity 3 (rad/s), then the
    task's own part: for the figure eight, `local_samples` 30, the next ten points of the curve, 0.1 s apart, as seen
    from the drone (m). Its first three numbers are the tracking error that the reward is made of.

    With `stagger`, three of four episodes begin at a random time of theirs, on the reference curve where there is one:
    as if the drone had been flying before. All of the course is flown from the first step on, and the drones never fly
    in step. Their returns are not counted, since they are fragments.
    """

    def __init__(self, env_id: str, num_envs: int, device: torch.device, *, stagger: bool = False) -> None:
        self.num_envs, self.device = num_envs, device
        if device.type == "cuda" and not any(d.platform == "gpu" for d in jax.devices()):
            raise UserError(
                "JAX sees no GPU, so crazyflow cannot fly on cuda; it comes with: pip install 'jax[cuda12]'"
            )
        self._simulator = simulator(env_id, num_envs, device.type)
        kind = action_kind(self._simulator.env.single_action_space, env_id)
        assert isinstance(kind, Box)
        layout = self._simulator.layout
        start = sum(part.size for part in layout[: len(STATE_PARTS)])
        self.spec = Spec(
            env_id=env_id,
            layout=layout,
            action=kind,
            max_episode_steps=self._simulator.episode_steps,
            time_step=1 / CONTROL_HZ,
            tracking=(start, start + 3) if any(part.name == "local_samples" for part in layout) else None,
        )
        self._stagger = jax.device_put(np.bool_(stagger), self._simulator.env.device)
        self._valid = torch.ones(num_envs, dtype=torch.bool, device=device)

    def restart(self, seed: int) -> Tensor:
        """A new fleet from `seed`: positions, velocities, goals and phases."""
        # Committed to the device like everything that follows, or the step would be compiled a second time.
        seed_here = jax.device_put(np.uint32(seed), self._simulator.env.device)
        self._state, obs, ahead = self._simulator.restart(seed_here, self._stagger)
        self.counts = ~torch.from_dlpack(ahead)
        return torch.from_dlpack(obs)

    def step(self, action: Tensor) -> Step:
        """[N, 4] commands in [-1, 1]; every row of the answer is real."""
        command = jax.dlpack.from_dlpack(action.contiguous())
        self._state, out = self._simulator.step(self._state, command, self._stagger)
        obs, next_obs, reward, terminated, truncated, ahead = map(torch.from_dlpack, out)
        self.counts = (self.counts | terminated | truncated) & ~ahead
        return Step(obs, next_obs, reward, terminated, truncated, self._valid)

    def close(self) -> None:
        """Nothing to give back: the program is shared."""


@contextlib.contextmanager
def _quietly():  # noqa: ANN202
    """MuJoCo warns about a model detail of crazyflow's on standard error and in a file in the working directory."""
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        mujoco.set_mju_user_warning(None)
