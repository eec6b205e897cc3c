"""Gymnasium's own checker of environments, without its false alarms."""

import warnings
from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import check_env, data_equivalence

from lemniscate.envs.findings import BAD, GOOD, NOTE, Finding
from lemniscate.envs.images import is_image
from lemniscate.envs.spaces import follow, observation_parts

BESIDE_THE_POINT = ("infinity. This is probably", "we recommend using a symmetric and normalized space")
"""warnings about spaces that learning here does not mind: it normalizes observations and scales actions itself"""


def api_findings(make: Callable[[], gym.Env], env_id: str, wrapped: bool) -> Iterator[Finding]:
    """The result of Gymnasium's checker, and whether observations are copies.

    Args:
        make: makes one environment.
        env_id: its name.
        wrapped: the environment is checked as `make` returns it, with the wrappers of the user's own; otherwise what is
            inside of Gymnasium's.
    """
    found: list[Finding] = []
    env = make()
    careful = Careful(env if wrapped else env.unwrapped)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            check_env(careful, skip_render_check=True, skip_close_check=wrapped)
        except Exception as error:
            why = _why_outside(careful) if "not within the observation space" in str(error) else ""
            found.append(Finding(BAD, f"Gymnasium's checker: {one_line(error)}{why}"))
        finally:
            env.close()
    told = {one_line(warning.message) for warning in caught if warning.category is UserWarning}
    minded = sorted(sentence for sentence in told if not any(part in sentence for part in BESIDE_THE_POINT))
    found += [Finding(NOTE, f"Gymnasium's checker: {sentence}") for sentence in minded]
    yield from found or [Finding(GOOD, "Gymnasium's checker finds nothing.")]
    if careful.reuses:
        yield Finding(
            NOTE,
            "It writes each observation into the array that it returned before, which changes what others kept of it;"
            " return a copy, obs.copy(). (lemniscate copies every observation.)",
        )
    if not any(finding.grade == BAD for finding in found):
        yield from _dtypes(make, env_id)


def _why_outside(env: gym.Env) -> str:
    """The difference between the first observation and its space, a Box, in a sentence that follows Gymnasium's."""
    space, obs = env.observation_space, np.asarray(env.reset(seed=0)[0])
    if not isinstance(space, gym.spaces.Box):
        return ""
    if not np.can_cast(obs.dtype, space.dtype):
        return f" It is {obs.dtype}, the space {space.dtype}: return obs.astype(np.{space.dtype})."
    if obs.shape != space.shape:
        return f" Its shape is {obs.shape}, that of the space {space.shape}."
    outside = np.argwhere((obs < space.low) | (obs > space.high))
    if not len(outside):
        return ""
    place = tuple(outside[0])
    bounds = f"[{space.low[place]:g}, {space.high[place]:g}]"
    return f" Its number {', '.join(map(str, place))} is {obs[place]:g}, outside of {bounds}."


def _dtypes(make: Callable[[], gym.Env], env_id: str) -> Iterator[Finding]:
    env = make()
    obs, _ = env.reset(seed=0)
    kinds = {np.asarray(follow(part.path, obs)).dtype.name for part in observation_parts(env.observation_space, env_id)}
    env.close()
    kept = kinds == {"uint8"} and is_image(env.observation_space)
    as_what = "stay bytes" if kept else "reach the policy as float32"
    yield Finding(GOOD, f"Its observations are {', '.join(sorted(kinds))}, and {as_what}.")


class Careful(gym.Wrapper):
    """An environment as learning uses it: only legal actions, and of every observation a copy.

    It passes for an unwrapped one, as Gymnasium's checker wants it. `reuses` is whether an observation changed after it
    had been returned.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.reuses = False
        self._mask: Any = None
        self._returned: Any = None
        self._copy: Any = None

    @property
    def unwrapped(self) -> gym.Env:
        """Itself."""
        return self

    @property
    def spec(self) -> Any:
        """The spec of the environment."""
        return self.env.spec

    @property
    def _np_random(self) -> np.random.Generator | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.env.unwrapped._np_random

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Reset."""
        return self._copied(*self.env.reset(seed=seed, options=options))

    def step(self, action: Any) -> Any:
        """Take the action, or the first legal one."""
        if self._mask is not None and isinstance(self.action_space, gym.spaces.Discrete):
            start = self.action_space.start
            action = action if self._mask[action - start] else start + np.argmax(self._mask)
        obs, reward, terminated, truncated, info = self.env.step(action)
        obs, info = self._copied(obs, info)
        return obs, reward, terminated, truncated, info

    def _copied(self, obs: Any, info: Any) -> tuple[Any, Any]:
        """Copies of both. Notes whether the observation before has changed since it was copied, and the new mask."""
        comparable = self._copy is not None and data_equivalence(self._copy, self._copy, exact=True)  # not with a NaN
        self.reuses |= comparable and not data_equivalence(self._returned, self._copy, exact=True)
        self._returned, self._copy = obs, deepcopy(obs)
        if isinstance(info, dict):
            self._mask = info.get("action_mask", self._mask)
        return deepcopy(obs), deepcopy(info)


def one_line(message: object) -> str:
    """A message of Gymnasium's or of an exception, without colours and line breaks."""
    text = str(message).replace("\x1b[33m", "").replace("\x1b[0m", "").removeprefix("WARN: ")
    return " ".join(text.split())
