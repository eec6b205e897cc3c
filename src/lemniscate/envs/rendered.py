"""Single environments that render themselves."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym

from lemniscate.envs.registry import BACKENDS, backend_class, backend_for
from lemniscate.errors import UserError


def make_rendered(
    env: str, mode: str, kwargs: Mapping[str, Any], wrappers: Sequence[str], backend: str | None
) -> gym.Env:
    """One environment of Gymnasium's interface that renders itself in `mode`, "rgb_array" or "human".

    Where `backend` cannot render, as EnvPool cannot, the first backend that serves the environment and can does it.
    Raises `UserError` if none can.
    """
    chosen = backend or backend_for(env, wrappers)
    for name in (chosen, *BACKENDS):
        make_one = getattr(backend_class(name), "make_rendered", None)
        if make_one and backend_class(name).serves(env):
            return make_one(env, mode, kwargs, wrappers)
    raise UserError(f"the {chosen} backend renders no single environment.")
