"""Environments that are functions of their state, in JAX: one compiled call a step, JAX to torch without a copy.

    act → step → true observation, reward, ends → reset what ended → where to act next

is traced once into a single XLA program, so every row is real.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor

from lemniscate.envs.backend import Backend
from lemniscate.errors import UserError
from lemniscate.types import Step

if TYPE_CHECKING:
    import jax

State: TypeAlias = Any
"""a pytree of arrays"""

Outcome: TypeAlias = tuple[Any, Any, Any, Any, dict[str, Any]]
"""observation [N, O], reward [N], terminated [N], truncated [N], and measures by name, [N] each"""


class JaxEnvs(Protocol):
    """N parallel environments as pure functions of their state, fit to be traced."""

    num_envs: int
    device: Any
    action_size: int
    """A; actions are [N, A] float32 in [-1, 1]"""

    def init(self, key: jax.Array) -> State:
        """The state before the first reset, in which all randomness comes from `key`."""
        ...

    def reset(self, state: State, mask: jax.Array, stagger: jax.Array) -> tuple[State, jax.Array, jax.Array]:
        """Begin an episode in the environments of `mask` [N] bool.

        With `stagger`, a bool scalar, episodes may begin late or be cut early; which of all N begin such a fragment
        is returned as [N] bool.

        Returns:
            (state, observation [N, O] float32, fragment [N])
        """
        ...

    def step(self, state: State, action: jax.Array) -> tuple[State, Outcome]:
        """Act in every environment, and reset none."""
        ...


class Programs:
    """The two compiled programs of N environments: `restart(seed, stagger)` and `step(state, action, stagger)`."""

    def __init__(self, envs: JaxEnvs) -> None:
        import jax

        def restart(seed: jax.Array, stagger: jax.Array) -> tuple[State, jax.Array, jax.Array]:
            return envs.reset(envs.init(jax.random.key(seed)), jax.numpy.ones(envs.num_envs, dtype=bool), stagger)

        def step(state: State, action: jax.Array, stagger: jax.Array) -> tuple[State, tuple[Any, ...]]:
            state, (next_obs, reward, terminated, truncated, measures) = envs.step(state, action)
            truncated = truncated & ~terminated
            state, obs, fragment = envs.reset(state, terminated | truncated, stagger)
            flags = jax.numpy.stack((terminated, truncated, fragment))  # each array costs a conversion
            return state, (obs, next_obs, reward, flags, measures)

        self.envs = envs
        self.restart, self.step = self._compile(restart, step)

    def _compile(self, restart: Callable, step: Callable) -> tuple[Callable, Callable]:
        """Both, traced one after the other, since tracing may use one object, but compiled side by side."""
        import jax

        seed, stagger = jax.device_put((np.uint32(0), np.bool_(False)), self.envs.device)
        action = jax.device_put(np.zeros((self.envs.num_envs, self.envs.action_size), np.float32), self.envs.device)
        lowered_restart = jax.jit(restart).lower(seed, stagger)
        lowered_step = jax.jit(step).lower(lowered_restart.out_info[0], action, stagger)
        programs = compile_side_by_side([lowered_restart, lowered_step])
        return programs[0], programs[1]


def compile_side_by_side(lowered: Sequence[Any]) -> list[Callable]:
    """The programs of what `jax.jit` has lowered, compiled by two threads."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(lambda one: one.compile(), lowered))


class JaxBackend(Backend):
    """N environments that are stepped by compiled programs; what a subclass adds is their making, and the Spec."""

    compiled = True

    def __init__(self, programs: Programs, num_envs: int, device: torch.device, *, stagger: bool) -> None:
        import jax

        self.num_envs, self.device = num_envs, device
        self._programs, self._from_dlpack = programs, jax.dlpack.from_dlpack
        # Committed to the device like everything that follows, or the step would be compiled a second time.
        self._put = lambda value: jax.device_put(value, programs.envs.device)
        self._stagger = self._put(np.bool_(stagger))
        self._valid = torch.ones(num_envs, dtype=torch.bool, device=device)

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Begin again from `seed + first`, the seed of this vector."""
        self._state, obs, fragment = self._programs.restart(self._put(np.uint32(seed + first)), self._stagger)
        self.counts = ~torch.from_dlpack(fragment)
        return torch.from_dlpack(obs)

    def step(self, action: Tensor) -> Step:
        """[N, A] actions in [-1, 1]; every row of the answer is real."""
        command = self._from_dlpack(action.contiguous())
        self._state, (*out, measures) = self._programs.step(self._state, command, self._stagger)
        obs, next_obs, reward, flags = map(torch.from_dlpack, out)
        terminated, truncated, fragment = flags
        self.counts = (self.counts | terminated | truncated) & ~fragment
        named = {name: torch.from_dlpack(values) for name, values in measures.items()}
        return Step(obs, next_obs, reward, terminated, truncated, self._valid, named)

    def close(self) -> None:
        """Nothing to give back: the programs are shared."""


def jax_device(device: torch.device) -> str:
    """The name of a torch device in JAX. Raises `UserError` for mps, cuda:1, …, and cuda where JAX sees no GPU."""
    import jax

    if device.type == "mps" or device.index:
        raise UserError(f"JAX's environments run on cpu or cuda, the first GPU, not on {device}.")
    if device.type == "cuda" and not any(d.platform == "gpu" for d in jax.devices()):
        raise UserError("JAX sees no GPU, so this cannot run on cuda; it comes with: pip install 'jax[cuda12]'")
    return "gpu" if device.type == "cuda" else "cpu"
