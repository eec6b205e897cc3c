"""The contract of the env floor, and the table of who fulfils it.

A backend is one file with a class that has `spec`, `num_envs`, `device`, `restart`, `step` and `close`, and one line in
`BACKENDS`. `VecEnv` wraps any of them and is what the floors above see.
"""

import math
from collections.abc import Callable
from typing import Protocol

import gymnasium as gym
import torch
from torch import Tensor

from lemniscate.envs.books import Books, Episodes
from lemniscate.errors import NonFiniteError, UserError, is_installed, missing_extra, unknown
from lemniscate.types import Spec, Step


class Backend(Protocol):
    """N copies of an environment, stepped together."""

    spec: Spec
    num_envs: int
    device: torch.device
    whole: Tensor
    """[N] bool: the copy's present episode began at its beginning; a staggered one is a fragment"""

    def restart(self, seed: int) -> Tensor:
        """Begin anew, as if just built from `seed`: nothing of the past remains. Returns obs [N, O]."""
        ...

    def step(self, action: Tensor) -> Step:
        """Act in every copy: Box actions float [N, A] in [-1, 1], Discrete ones int64 [N]."""
        ...

    def close(self) -> None:
        """Give back processes and windows."""
        ...


PATIENCE = 20_000
"""steps that an episode may take in an environment without a time limit, where whole ones are wanted"""


class VecEnv:
    """A backend with its current observation and the books of its episodes."""

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self.spec = backend.spec
        self.num_envs = backend.num_envs
        self.device = backend.device
        self.obs = torch.empty(0)

    def restart(self, seed: int, steps: int = 0) -> Tensor:
        """Begin anew from `seed`; also stored as `obs`, [N, O]. `steps` is what the run has taken so far."""
        self.steps = steps
        self._books = Books(self.num_envs, self.device)
        self.obs = self.backend.restart(seed)
        self._require_finite(observation=self.obs)
        return self.obs

    def step(self, action: Tensor) -> Step:
        """Act in every copy and move `obs` on.

        Raises:
            NonFiniteError: an observation or a reward is NaN or infinite; nothing has learned from it yet.
        """
        whole = self.backend.whole
        step = self.backend.step(action)
        self._require_finite(observation=step.next_obs, reward=step.reward)
        if step.obs is not step.next_obs:
            self._require_finite(observation=step.obs)
        self.obs = step.obs
        self.steps += self.num_envs
        self._books.log(step, whole)
        return step

    def _require_finite(self, **quantities: Tensor) -> None:
        for name, values in quantities.items():
            if math.isfinite(values.sum().item()):  # one NaN or infinity shows in the sum of all, and the sum is cheap
                continue
            bad = torch.nonzero(~torch.isfinite(values))
            if len(bad):
                value, copy = values[tuple(bad[0])].item(), int(bad[0, 0])
                raise NonFiniteError(f"The {name} of environment {copy} is {value} in the step after {self.steps:,}.")

    def require_end(self, age: int) -> None:
        """Raise `UserError` where an episode of `age` steps has had its chance to end, and there is no time limit."""
        if self.spec.max_episode_steps is None and age >= PATIENCE:
            raise UserError(
                f"An episode of {self.spec.env_id} has not ended after {PATIENCE:,} steps, and there is no time limit;"
                " give it one, with max_episode_steps where it is registered."
            )

    def take_episodes(self) -> Episodes:
        """The whole episodes that ended since the last call."""
        return self._books.take()

    def close(self) -> None:
        """Give back processes and windows."""
        self.backend.close()


def _gymnasium(env_id: str, num_envs: int, device: torch.device, stagger: bool) -> Backend:
    from lemniscate.envs.gymnasium import GymnasiumBackend

    return GymnasiumBackend(env_id, num_envs, device, stagger=stagger)


def _gymnasium_async(env_id: str, num_envs: int, device: torch.device, stagger: bool) -> Backend:
    from lemniscate.envs.gymnasium import GymnasiumBackend

    return GymnasiumBackend(env_id, num_envs, device, stagger=stagger, workers=True)


def _envpool(env_id: str, num_envs: int, device: torch.device, stagger: bool) -> Backend:
    if not is_installed("envpool"):
        raise missing_extra("envpool", "envpool")
    from lemniscate.envs.envpool import EnvpoolBackend

    return EnvpoolBackend(env_id, num_envs, device, stagger=stagger)


def _crazyflow(env_id: str, num_envs: int, device: torch.device, stagger: bool) -> Backend:
    from lemniscate.envs.crazyflow import CrazyflowBackend

    return CrazyflowBackend(env_id, num_envs, device, stagger=stagger)


BACKENDS: dict[str, Callable[[str, int, torch.device, bool], Backend]] = {
    "gymnasium": _gymnasium,
    "gymnasium-async": _gymnasium_async,
    "envpool": _envpool,
    "crazyflow": _crazyflow,
}

CRAZYFLOW_IDS = (
    "DroneFigureEightTrajectory-v0",
    "DroneLanding-v0",
    "DroneReachPos-v0",
    "DroneReachVel-v0",
)

ENVPOOL_IDS = (
    "Ant-v5",
    "CartPole-v1",
    "HalfCheetah-v5",
    "Hopper-v5",
    "Humanoid-v5",
    "LunarLander-v3",
    "Walker2d-v5",
)
"""those that behave in EnvPool as in Gymnasium: tests/envs/test_envpool.py compares them"""


def known_ids() -> list[str]:
    """Every environment id that can be asked for, sorted."""
    import lemniscate.envs.toy  # noqa: F401  (registers the toys)

    return sorted({*gym.registry, *CRAZYFLOW_IDS})


def backend_for(env_id: str) -> str:
    """The backend that serves `env_id`, an id or somebody's own `module:Class`.

    Raises `UserError` with the nearest names if there is none.
    """
    if ":" in env_id:
        from lemniscate.envs.gymnasium import spec_of

        spec_of(env_id)
        return "gymnasium"
    if env_id not in known_ids():
        raise unknown("environment", env_id, known_ids())
    if env_id in CRAZYFLOW_IDS:
        return "crazyflow"
    return "envpool" if env_id in ENVPOOL_IDS and is_installed("envpool") else "gymnasium"


def file_name(env_id: str) -> str:
    """An id as a part of a file's name."""
    return env_id.replace("/", "_").replace(":", "_")


def require_backend(backend: str) -> str:
    """The name itself. Raises `UserError` with the nearest names for one that is not known."""
    if backend not in BACKENDS:
        raise unknown("backend", backend, BACKENDS)
    return backend


def make(
    env_id: str, num_envs: int, *, device: str = "cpu", stagger: bool = False, backend: str | None = None
) -> VecEnv:
    """N copies of an environment on `device`; `restart` it before the first step.

    Raises:
        UserError: an unknown environment or backend, spaces nobody can act in, a missing extra.
    """
    served_by = backend_for(env_id)
    if backend is not None and (require_backend(backend) == "crazyflow") != (served_by == "crazyflow"):
        raise UserError(f"{env_id} cannot be served by the {backend} backend; {served_by} serves it.")
    return VecEnv(BACKENDS[backend or served_by](env_id, num_envs, torch.device(device), stagger))
