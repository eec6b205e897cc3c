"""The table of backends, and which of them runs an environment."""

from collections.abc import Callable

import gymnasium as gym
import torch

from lemniscate.envs.vec_env import Backend, VecEnv
from lemniscate.errors import UserError, is_installed, missing_extra, unknown_name


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
        raise unknown_name("environment", env_id, known_ids())
    if env_id in CRAZYFLOW_IDS:
        return "crazyflow"
    return "envpool" if env_id in ENVPOOL_IDS and is_installed("envpool") else "gymnasium"


def file_name(env_id: str) -> str:
    """An id as a part of a file's name."""
    return env_id.replace("/", "_").replace(":", "_")


def require_backend(backend: str) -> str:
    """The name itself. Raises `UserError` with the nearest names for one that is not known."""
    if backend not in BACKENDS:
        raise unknown_name("backend", backend, BACKENDS)
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
