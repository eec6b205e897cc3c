"""Environments with the `VecEnv` interface of rsl_rl, such as Isaac Lab's, as a backend; and ours with that interface.

Neither needs rsl_rl; ours as one needs tensordict.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import zip_longest
from typing import Any

import torch
from torch import Tensor

from lemniscate.envs import registry
from lemniscate.envs.backend import Backend
from lemniscate.envs.returned import kind_of
from lemniscate.errors import UserError
from lemniscate.spec import Box, ObservationPart, Spec
from lemniscate.system import named
from lemniscate.types import Step

ACTOR, CRITIC = ("actor", "policy"), "critic"
"""groups of observations: the first of these that is there is what a policy sees; what a critic sees besides"""
FINAL = ("final_obs", "final_observation", "terminal_observation")
"""names in `extras` of the true final observations, in the form of the others"""

_made: dict[tuple[str, str], Any] = {}
"""what makers have made, by name and arguments: a process has one simulator"""


class RslRlBackend(Backend):
    """N environments in one object that speaks rsl_rl's `VecEnv`: passed as `env`, or made by `module:function`.

    A process has one such object, so evaluation uses that of training. Actions are the environment's own, [N, A],
    without bounds. The critic sees the group `critic` behind the policy's. Numbers in `extras["log"]` are measures.

    An episode that has ended is reset in the same step. Where `extras` has the true final observations (`final_obs`),
    values at time-outs are exact; else the observation before stands for them, as in rsl_rl.
    """

    @classmethod
    def serves(cls, env: str) -> bool:
        """An object that speaks it, or a function of one's own, which may make one."""
        return ":" in env and (is_rsl_rl_env(found := named.find(env)) or callable(found))

    @classmethod
    def exists_once(cls, env: str, num_envs: int) -> bool:
        """Always: a process has one such simulator."""
        return True

    @classmethod
    def make_rendered(cls, env: str, mode: str, kwargs: Mapping[str, Any], wrappers: Sequence[str]) -> None:
        """None can be made. Raises `UserError`."""
        raise UserError(f"{env} is a simulator of N environments, which draws itself or nothing: leave the video out.")

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
        self._env, self.num_envs, self.device = _made_once(env, num_envs, kwargs or {}), num_envs, device
        if (there := int(self._number("num_envs", env))) != num_envs:
            raise UserError(f"{env} has {there:,} environments, not {num_envs:,}: num_envs={there}.")
        obs = self._env.get_observations()
        if not hasattr(obs, "keys"):
            raise UserError(
                f"{env} returns {kind_of(obs)} from get_observations(); they must be groups of observations by their"
                " names, such as a TensorDict with policy, as in rsl_rl from version 3 on."
            )
        groups = [*obs.keys()]
        group = next((name for name in ACTOR if name in groups), None)
        if group is None:
            given = ", ".join(map(str, groups)) or "none"
            raise UserError(f"{env} has the groups of observations {given}; one must be actor or policy.")
        self._env_id, self._groups = env, [group, *([CRITIC] if CRITIC in groups else [])]
        self._sizes: list[int] = []
        self._sizes = [part.shape[1] for part in self._parts(obs)]
        actions = int(self._number("num_actions", env))
        longest = math.inf if self._env.max_episode_length is None else self._number("max_episode_length", env)
        steps = int(longest) if math.isfinite(longest) else None
        bounds = Box((-math.inf,) * actions, (math.inf,) * actions)
        self.spec = Spec(env, (ObservationPart((), (self._sizes[0],)),), bounds, steps, sum(self._sizes[1:]))
        self.counts = torch.ones(num_envs, dtype=torch.bool, device=device)
        self.notices = []

    def restart(self, seed: int, first: int = 0) -> Tensor:
        """Seed and reset it, where it has `seed` and `reset`; else it goes on from where it is, which is said."""
        if named.takes(getattr(self._env, "seed", None), 1):
            self._env.seed(seed + first)
        else:
            self._note(f"{self.spec.env_id} has no seed(number): no run can be repeated.")
        if named.takes(getattr(self._env, "reset", None), 0):
            self._env.reset()
        else:
            self._note(f"{self.spec.env_id} has no reset(): episodes go on where they are, and no run can be repeated.")
        self._obs = self._rows(self._env.get_observations())
        return self._obs

    def step(self, action: Tensor) -> Step:
        """Act; the rows of time-outs have the true final observation, or else the one before."""
        returned = self._env.step(action.to(getattr(self._env, "device", self.device)))
        if not isinstance(returned, tuple) or len(returned) != 4:
            what = f"{len(returned)} values" if isinstance(returned, tuple) else kind_of(returned)
            raise UserError(f"{self._env_id} returns {what} from step(); it must be 4, (obs, rewards, dones, extras).")
        obs, reward, dones, extras = returned
        extras = self._dictionary("extras", extras)
        done, late = self._column("dones", dones, torch.bool), extras.get("time_outs")
        truncated = torch.zeros_like(done) if late is None else done & self._column("time_outs", late, torch.bool)
        before, self._obs = self._obs, self._rows(obs)
        final = next((name for name in FINAL if extras.get(name) is not None), None)
        if final is None and truncated.any():
            self._note(
                f"{self.spec.env_id} hides final observations (no extras['final_obs']): at time-outs the value of the"
                " observation before stands for what follows."
            )
        last = before if final is None else self._rows(extras[final], f"extras[{final!r}], group ")
        return Step(
            obs=self._obs,
            next_obs=torch.where(done[:, None], last, self._obs),
            reward=self._column("rewards", reward, torch.float32),
            terminated=done & ~truncated,
            truncated=truncated,
            valid=torch.ones_like(done),
            measures=self._logged(extras),
        )

    def close(self) -> None:
        """Nothing: the object is used again, and is its owner's."""

    def _rows(self, obs: Any, where: str = "the observations ") -> Tensor:
        """[N, O + P] of groups [N, …]; clones, since a simulator may write over its own."""
        return torch.cat(self._parts(obs, where), dim=-1)

    def _parts(self, obs: Any, where: str = "the observations ") -> list[Tensor]:
        """[N, O], and [N, P] where there is a group of the critic's. Raises `UserError` for what is no such group."""
        alone = isinstance(obs, Tensor) and len(self._groups) == 1
        groups: Any = {self._groups[0]: obs} if alone else obs
        found = []
        for name, size in zip_longest(self._groups, self._sizes):
            group: Any = groups[name] if name in getattr(groups, "keys", dict)() else None
            rows = isinstance(group, Tensor) and group.shape[:1] == (self.num_envs,) and not group.is_complex()
            width = group.numel() // self.num_envs if rows else 0
            if not width or width != (size or width):
                raise UserError(
                    f"{self._env_id} gives {kind_of(group)} as {where}{name}; a group must be one Tensor"
                    f" [{self.num_envs}, {size or '…'}], with its terms concatenated."
                )
            found.append(group.reshape(self.num_envs, -1).to(self.device, torch.float32))
        return found

    def _column(self, name: str, values: Any, dtype: torch.dtype) -> Tensor:
        """[N] of one number for each environment, [N] or [N, 1]; a clone, as of observations."""
        right = isinstance(values, Tensor) and values.numel() == self.num_envs and not values.is_complex()
        if not right or (dtype is torch.bool and values.is_floating_point() and values.isnan().any()):
            wanted = f"a Tensor [{self.num_envs}]{' of True and False' * (dtype is torch.bool)}"
            raise UserError(f"{self._env_id} gives {kind_of(values)} as {name}; it must be {wanted}.")
        return values.reshape(self.num_envs).to(self.device, dtype, copy=True)

    def _number(self, name: str, env: str) -> float:
        """An attribute that counts, the largest number of a Tensor. Raises `UserError` for one that counts nothing."""
        value = getattr(self._env, name)
        try:
            number = float(torch.as_tensor(value).max())
        except (TypeError, ValueError, RuntimeError):
            number = math.nan
        if not number >= 1 or (number % 1 and name != "max_episode_length"):
            raise UserError(f"{name} of {env} is {kind_of(value)}; it must be a whole number from 1.")
        return number

    def _dictionary(self, name: str, value: Any) -> Mapping[str, Any]:
        if value is not None and not (hasattr(value, "get") and hasattr(value, "items")):
            raise UserError(f"{self._env_id} gives {kind_of(value)} as {name}; it must be a dictionary.")
        return {} if value is None else value

    def _logged(self, extras: Mapping[str, Any]) -> dict[str, Tensor]:
        """The means of what numbers a log has, each the same in all rows."""
        rows, found = self.counts.float(), {}
        logs = [self._dictionary(f"extras[{name!r}]", extras.get(name)) for name in ("log", "episode")]
        for key, value in next(filter(len, logs), {}).items():
            with suppress(TypeError, ValueError, RuntimeError):  # what is no number is not measured
                mean = torch.as_tensor(value, dtype=torch.float32).mean().item()
                found[f"info/{str(key).strip('/')}"] = torch.full_like(rows, mean)
        return found

    def _note(self, sentence: str) -> None:
        if sentence not in self.notices:
            self.notices = [*self.notices, sentence]


def is_rsl_rl_env(thing: object) -> bool:
    """Whether an object has what rsl_rl's `VecEnv` has."""
    needed = ("num_envs", "num_actions", "max_episode_length", "get_observations", "step")
    return not isinstance(thing, type) and all(hasattr(thing, name) for name in needed)


def _made_once(env: str, num_envs: int, kwargs: Mapping[str, Any]) -> Any:
    """The object of that name: as it was passed, or made by its maker, once in a process."""
    found = named.find(env)
    if is_rsl_rl_env(found):
        if kwargs:
            raise UserError(f"{env} is made already, so env_kwargs such as {next(iter(kwargs))} do not reach it.")
        return found
    key = env, repr(sorted(kwargs.items()))
    if key not in _made or _made[key].num_envs != num_envs:
        try:
            _made[key] = found(num_envs=num_envs, **kwargs)
        except TypeError as error:
            raise UserError(f"{env} cannot be made: {error}. It is called with num_envs and the env_kwargs.") from None
        if not is_rsl_rl_env(_made[key]):
            kind = type(_made.pop(key)).__name__
            raise UserError(f"{env} makes a {kind}, which does not speak rsl_rl's VecEnv: no get_observations.")
    return _made[key]


class RslRlVecEnv:
    """Environments of lemniscate's as a `VecEnv` of rsl_rl's, for its runner: of continuous actions.

    Observations have the group `policy` and, where something is privileged, `critic`, which has both. Actions are in
    units of half the range, clipped to [-1, 1]. `extras` has `time_outs`, and true final observations as `final_obs`.
    First episodes are cut at random steps, so ends are spread as by the runner's `init_at_random_ep_len`, which sets
    `episode_length_buf`: here that counts steps and ends nothing.

    Args:
        env: as `lemniscate.train` takes it.
        num_envs: N.
        seed: of the environments.
        device: of the tensors.
        **options: `kwargs`, `wrappers` and `backend` of `lemniscate.envs.registry.make`.

    Raises:
        UserError: an environment that cannot be made, has other actions, or resets in a step of its own.
    """

    def __init__(self, env: Any, num_envs: int, *, seed: int = 0, device: str = "cpu", **options: Any) -> None:
        self._env = registry.make(env, num_envs, device=device, stagger=True, **options)
        spec = self._env.spec
        if not isinstance(spec.action, Box):
            raise UserError(f"{spec.env_id} has no continuous actions, which rsl_rl needs.")
        self.num_envs, self.num_actions, self.device, self.cfg = num_envs, spec.action.size, self._env.device, {}
        self.max_episode_length = spec.max_episode_steps or 10**9
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.int64, device=self._env.device)
        self._size, self._privileged = spec.observation_size, spec.privileged
        self._env.restart(seed)

    def get_observations(self) -> Any:
        """The present observations, a TensorDict."""
        return self._groups(self._env.obs)

    def step(self, actions: Tensor) -> tuple[Any, Tensor, Tensor, dict[str, Any]]:
        """Act; what has ended is reset in the same step."""
        step = self._env.step(actions)
        if not step.valid.all():
            raise UserError(
                f"{self._env.spec.env_id} resets in a step of its own, which rsl_rl's runner would learn from."
            )
        done = step.terminated | step.truncated
        self.episode_length_buf = (self.episode_length_buf + 1) * ~done
        extras = {"time_outs": step.truncated, "final_obs": self._groups(step.next_obs), "log": {}}
        for name, values in step.measures.items():
            extras["log"][f"/{name}"] = values[~values.isnan()].mean() if (~values.isnan()).any() else 0.0
        return self._groups(step.obs), step.reward, done, extras

    def close(self) -> None:
        """Give back processes and windows."""
        self._env.close()

    def _groups(self, obs: Tensor) -> Any:
        from tensordict import TensorDict  # pyright: ignore[reportMissingImports]

        groups = {"policy": obs[:, : self._size]} | ({CRITIC: obs} if self._privileged else {})
        return TensorDict(groups, batch_size=[self.num_envs])
