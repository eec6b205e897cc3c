"""Environments of packages that Gymnasium does not find by itself: MinAtar's games, and Gymnasium-Robotics."""

import logging
from collections.abc import Collection
from contextlib import redirect_stderr
from functools import cache
from io import StringIO
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from lemniscate.envs.gymnasium import GymnasiumBackend
from lemniscate.errors import is_installed, missing_extra

MODULES = ("asterix", "breakout", "freeway", "seaquest", "space_invaders")
GAMES = {f"MinAtar/{module.title().replace('_', '')}-v1": module for module in MODULES}
LIMIT = 10_000
"""steps of an episode at most, which the games have not"""
PIXELS = 20
"""the side of a field in a video"""


class MinAtar(gym.Env):
    """A game on 10 × 10 fields (Young & Tian 2019, arXiv:1903.03176), with the actions that have an effect in it.

    Observations are images of bytes, 0 or 255, with a channel for each kind of thing.

    Args:
        game: the name of its module.
        render_mode: none, or rgb_array.
        sticky_action_prob: the probability that the action before is repeated.
        difficulty_ramping: whether a game becomes harder.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(
        self,
        game: str,
        render_mode: str | None = None,
        sticky_action_prob: float = 0.1,
        difficulty_ramping: bool = True,
    ) -> None:
        if not is_installed("minatar"):
            raise missing_extra("minatar", "minatar")
        disabled = logging.root.manager.disable
        logging.disable(logging.WARNING)  # that seaborn is not there, which draws their own windows
        try:
            from minatar import Environment  # pyright: ignore[reportMissingImports]
        finally:
            logging.disable(disabled)
        self.render_mode, self._game = render_mode, Environment(game, sticky_action_prob, difficulty_ramping)
        self._actions = self._game.minimal_action_set()
        self.action_space = gym.spaces.Discrete(len(self._actions))
        self.observation_space = gym.spaces.Box(0, 255, self._game.state_shape(), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """A new game."""
        self._game.seed(seed)
        self._game.reset()
        self._game.last_action = 0
        return self._show(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """The game's, without a time limit."""
        reward, over = self._game.act(self._actions[action])
        return self._show(), float(reward), bool(over), False, {}

    def render(self) -> np.ndarray:
        """The field, each kind of thing in a grey of its own; [H, W, 3]."""
        state = self._game.state()
        shade = (state * np.linspace(80, 255, state.shape[-1])).max(-1).astype(np.uint8)
        return shade.repeat(PIXELS, 0).repeat(PIXELS, 1)[..., None].repeat(3, 2)

    def _show(self) -> np.ndarray:
        return 255 * self._game.state().astype(np.uint8)


for _id, _game in GAMES.items():  # in the place of the package's own, whose observations are no bytes
    _point = "lemniscate.envs.packages:MinAtar"
    gym.registry[_id] = EnvSpec(_id, entry_point=_point, max_episode_steps=LIMIT, kwargs={"game": _game})


class MinatarBackend(GymnasiumBackend):
    """MinAtar's games by their own ids, as environments of Gymnasium's."""

    @classmethod
    def ids(cls) -> Collection[str]:
        """The five games, where the package is installed."""
        return [*GAMES] if is_installed("minatar") else []

    @classmethod
    def serves(cls, env: str) -> bool:
        """Whether it is one of the five, by the name."""
        return env in GAMES

    @classmethod
    def exists_once(cls, env: str, num_envs: int) -> bool:
        """Never: there can be many."""
        return False


class RoboticsBackend(GymnasiumBackend):
    """Gymnasium-Robotics by its own ids: arms and hands with goals (Plappert et al. 2018, arXiv:1802.09464), mazes."""

    @classmethod
    def ids(cls) -> Collection[str]:
        """Those that need no older MuJoCo, where the package is installed."""
        return _robotics() if is_installed("gymnasium_robotics") else []

    @classmethod
    def serves(cls, env: str) -> bool:
        """Its ids. Raises `UserError` where the package is not installed."""
        if not is_installed("gymnasium_robotics"):
            raise missing_extra("gymnasium_robotics", "robotics")
        return env in _robotics()


@cache
def _robotics() -> list[str]:
    """The ids of the package, which registers them when it is imported."""
    before = dict(gym.registry)
    with redirect_stderr(StringIO()):  # its news, at every start
        import gymnasium_robotics  # noqa: F401  # pyright: ignore[reportMissingImports]
    gym.registry.update(before)  # it takes over ids of Gymnasium's that need an older MuJoCo
    points = {name: str(spec.entry_point) for name, spec in gym.registry.items()}
    return [name for name, point in points.items() if point.startswith("gymnasium_robotics.") and "Py" not in point]
