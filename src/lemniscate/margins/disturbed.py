"""Disturbances of environments that know nothing of them: a channel for any, factors for the models of MuJoCo."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from lemniscate.envs.factory import make_one, maker_of
from lemniscate.envs.probe import Act


class Channel:
    """The way between a policy and N environments: late and lost actions, blurred observations.

    Before the first action has arrived it acts already; a lost one is replaced by the one that acted before it.

    Args:
        act: the policy.
        action_delay: in steps.
        observation_noise: standard deviation of each number of an observation, in multiples of `scale`.
        lost_actions: probability that an action is lost.
        scale: [O].
        rng: of noise and losses.
    """

    def __init__(
        self,
        act: Act,
        *,
        action_delay: int = 0,
        observation_noise: float = 0.0,
        lost_actions: float = 0.0,
        scale: Tensor | None = None,
        rng: torch.Generator,
    ) -> None:
        self._act, self._delay, self._lost, self._rng = act, int(action_delay), lost_actions, rng
        self._noise = observation_noise * scale if scale is not None and observation_noise else None
        self._sent: list[Tensor] = []
        self._acting: Tensor | None = None

    def __call__(self, obs: Tensor) -> Tensor:
        """The actions [N, …] that act now, after the observations [N, O]."""
        if self._noise is not None:
            obs = obs + self._noise * torch.randn(obs.shape, generator=self._rng)
        self._sent.append(self._act(obs))
        arrived = self._sent.pop(0) if len(self._sent) > self._delay else self._sent[0]
        if self._lost and self._acting is not None:
            lost = torch.rand(len(obs), generator=self._rng) < self._lost
            arrived = torch.where(lost.reshape(-1, *[1] * (arrived.ndim - 1)), self._acting, arrived)
        self._acting = arrived
        return arrived


class ModelFactors(gym.Wrapper):
    """A MuJoCo environment whose bodies are heavier and whose surfaces are rougher by a factor.

    Args:
        env: the environment.
        mass: of all masses, and with them of the moments of inertia.
        friction: of all coefficients of friction.
    """

    def __init__(self, env: gym.Env, mass: float = 1.0, friction: float = 1.0) -> None:
        super().__init__(env)
        import mujoco

        world: Any = env.unwrapped
        world.model.body_mass[:] *= mass
        world.model.body_inertia[:] *= mass
        world.model.geom_friction[:] *= friction
        # what MuJoCo has derived from masses
        mujoco.mj_setConst(world.model, world.data)  # pyright: ignore[reportAttributeAccessIssue]


def has_model(env: str, kwargs: Mapping[str, Any]) -> bool:
    """MuJoCo simulates the environment of Gymnasium's with this name."""
    made: Any = make_one(maker_of(env), **kwargs)
    try:
        return hasattr(getattr(made.unwrapped, "model", None), "geom_friction")
    finally:
        made.close()
