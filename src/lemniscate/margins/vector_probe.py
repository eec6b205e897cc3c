"""Environments of any backend flown along axes, though they know nothing of disturbances.

A channel between policy and environment delays actions, loses actions and blurs observations; factors change the models
of MuJoCo.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from lemniscate.envs import registry
from lemniscate.envs.factory import make_one, maker_of, makes_vector
from lemniscate.envs.probe import CHANNEL_AXES, MODEL_AXES, Act, Axis, Begin, Flown, Tally, Value
from lemniscate.envs.vec_env import VecEnv
from lemniscate.run.seeding import derive, generator
from lemniscate.spec import Spec

FACTORS = "lemniscate.margins.vector_probe:ModelFactors"
CPU = torch.device("cpu")


@dataclass
class Channel:
    """The way between a policy and N environments: late and lost actions, blurred observations.

    Before the first action has arrived it acts already; a lost one is replaced by the one that acted before it.

    Attributes:
        act: the policy.
        rng: of noise and losses.
        action_delay: in steps.
        observation_noise: standard deviation of each number of an observation, in multiples of `scale`.
        lost_actions: probability that an action is lost.
        scale: [O].
    """

    act: Act
    rng: torch.Generator
    action_delay: int = 0
    observation_noise: float = 0.0
    lost_actions: float = 0.0
    scale: Tensor | None = None
    _sent: list[Tensor] = field(default_factory=list, init=False)
    _acting: Tensor | None = field(default=None, init=False)

    def __call__(self, obs: Tensor) -> Tensor:
        """The actions [N, …] that act now, after the observations [N, O]."""
        if self.scale is not None and self.observation_noise:
            obs = obs + self.observation_noise * self.scale * torch.randn(obs.shape, generator=self.rng)
        self._sent.append(self.act(obs))
        arrived = self._sent.pop(0) if len(self._sent) > self.action_delay else self._sent[0]
        if self.lost_actions and self._acting is not None:
            lost = torch.rand(len(obs), generator=self.rng) < self.lost_actions
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


class VectorProbe:
    """A probe in E parallel environments, of which the first episode of each counts; all begin from one seed.

    Environments of Gymnasium's interface are those of the gymnasium backend, others those of the backend named.

    Args:
        env: as `registry.make` takes it, kwargs and wrappers too.
        starts: E.
    """

    ends_by_failure = False
    period: float | None = None

    def __init__(
        self, env: str, starts: int, kwargs: Mapping[str, Any], wrappers: tuple[str, ...], backend: str | None
    ) -> None:
        own = (backend is None or backend in registry.BACKENDS) and registry.backend_class("gymnasium").serves(env)
        backend = "gymnasium" if own else backend
        self._make = partial(registry.make, env, starts, kwargs=kwargs, backend=backend)
        self._wrappers = wrappers
        self._env = self._make(wrappers=wrappers)
        self.spec: Spec = self._env.spec
        single = own and not makes_vector(maker_of(env))
        self.axes = _axes(self.spec, single and has_model(env, kwargs))

    def fly(self, begin: Begin, seed: int) -> tuple[Flown, dict[str, list[Flown]]]:
        """All episodes, see `Probe.fly`; afterwards the environments are closed."""
        numbers, seen = _is_number(self.spec), list[Tensor]()
        try:
            nominal = _fly(self._env, begin(), seed, numbers, seen if numbers.any() else None)
            scale = torch.zeros(len(numbers))
            if seen:
                scale.masked_scatter_(numbers, torch.cat(seen).std(0, correction=0))
            points: dict[str, list[Flown]] = {}
            for axis in self.axes:
                flown = (nominal if v == axis.nominal else self._at(axis, v, scale, begin(), seed) for v in axis.values)
                points[axis.name] = list(flown)
            return nominal, points
        finally:
            self.close()

    def close(self) -> None:
        """Close the environments."""
        self._env.close()

    def _at(self, axis: Axis, value: Value, scale: Tensor | None, act: Act, seed: int) -> Flown:
        rng = generator(seed, CPU, 1)
        if axis not in MODEL_AXES:
            disturbance: dict[str, Any] = {axis.name: value}
            return _fly(self._env, Channel(act, rng, scale=scale, **disturbance), seed)
        env = self._make(wrappers=(*self._wrappers, f"{FACTORS}({axis.name}={value})"))
        try:
            return _fly(env, act, seed)
        finally:
            env.close()


def _axes(spec: Spec, has_model: bool) -> tuple[Axis, ...]:
    """The axes of an environment: with a mask no action can be late, and only numbers can be noisy."""
    noisy, masked = _is_number(spec).any(), spec.action.mask_size
    channel = (axis for axis in CHANNEL_AXES if (noisy if axis.name == "observation_noise" else not masked))
    return (*channel, *(MODEL_AXES if has_model else ()))


def _is_number(spec: Spec) -> Tensor:
    """[O] bool, of the whole observation: numbers, which are no choices, masks or pixels."""
    own = [not part.nvec and not part.image for part in spec.observation_parts for _ in range(part.size)]
    return torch.tensor([*own, *[False] * spec.action.mask_size])


def _fly(env: VecEnv, act: Act, seed: int, numbers: Tensor | None = None, seen: list[Tensor] | None = None) -> Flown:
    """The first episode of each environment; `seen` gets these `numbers` [O] bool of those that had not ended."""
    tally, age = Tally(env.num_envs), 0
    env.restart(derive(seed, 0))
    while tally.going.any():
        env.require_end(age)
        if seen is not None:
            seen.append(env.obs[tally.going][:, numbers])
        step = env.step(act(env.obs))
        tally.add(step.reward, step.terminated, step.truncated)
        age += 1
    return Flown(tally.returns, tally.terminated)
