"""A whole training loop: a skeleton to fill in, and the judgement of a loop by what it learns.

In each small world the better of two actions is known, and one mistake makes the other one look better; one more world
has Box actions. A loop that passes them all is trained on CartPole-v1.
"""

import inspect
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from lemniscate.course.exercise import TEMPLATES, Function, raised
from lemniscate.envs.vector_view import VectorView, make_vec
from lemniscate.errors import UserError, unknown_name
from lemniscate.system.console import say

SKELETONS = ("ppo",)
SOLUTION = re.compile(r"^( *)# <solution>\n.*?# </solution>\n", re.DOTALL | re.MULTILINE)
"""the lines of a program that its skeleton leaves out"""

STEPS, NUM_ENVS = 2_048, 8
CARTPOLE_STEPS, CARTPOLE_RETURN, EPISODES_EACH = 60_000, 400, 3


def skeleton(name: str = "ppo", path: str | Path | None = None) -> Path:
    """Write a training loop to fill in, as one file that runs by itself and checks itself.

    Args:
        name: ppo.
        path: the new file; by default `ppo.py` here.

    Raises:
        UserError: an unknown name; a file that exists, or cannot be written.
    """
    if name not in SKELETONS:
        raise unknown_name("skeleton", name, SKELETONS)
    path = Path(path or f"{name}.py")
    if path.exists():
        raise UserError(f"{path} exists already; name another file with path.")
    with_gaps = SOLUTION.sub(r'\1raise NotImplementedError("to be written")\n', solution(name))
    try:
        path.write_text(with_gaps.replace(f"python {name}.py", f"python {path.name}"), "utf-8")
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}.") from error
    return path


def solution(name: str) -> str:
    """The program of a skeleton without gaps."""
    # Not a module: it is a text for the reader's own file, and nothing here may come to import it.
    return (TEMPLATES / f"{name}.py.txt").read_text("utf-8")


@dataclass(frozen=True)
class World:
    """A small world in which action 0 is better than action 1 in state 0."""

    moves: list[list[dict[str, Any]]]
    """by state and action: its effect, as `worlds.toml` says"""
    starts: list[float]
    """by state: the probability that an episode begins there"""
    mistake: str
    """a sentence on what action 1 in state 0 reveals"""
    seen: Sequence[int] = range(6)
    """by state: the state that it looks like"""

    def obs(self, state: int) -> np.ndarray:
        """The observation of a state: a one-hot vector [6]."""
        return np.eye(6, dtype=np.float32)[self.seen[state]]


class WorldEnv(gym.Env):
    """A world as an environment."""

    def __init__(self, world: int) -> None:
        self.world = WORLDS[world]
        self.observation_space = gym.spaces.Box(0, 1, (6,), np.float32)
        self.action_space: gym.Space = gym.spaces.Discrete(2)
        self._bonus = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """A state to begin in."""
        super().reset(seed=seed)
        self._state = int(self.np_random.choice(len(self.world.starts), p=self.world.starts))
        return self.world.obs(self._state), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """The move of that action."""
        move = self.world.moves[self._state][int(action)]
        reward, end = move["reward"] + self._bonus, move.get("end")
        self._bonus, self._state = move.get("next_bonus", 0.0), move["to"]
        return self.world.obs(self._state), reward, end == "death", end == "time-out", {}


class BoxEnv(WorldEnv):
    """World 0 with a Box of two actions: the reward is the first minus the second."""

    def __init__(self) -> None:
        super().__init__(0)
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """A death after one action."""
        return self.world.obs(0), float(action[0] - action[1]), True, False, {}


WORLDS = [World(**world) for world in tomllib.loads((TEMPLATES / "worlds.toml").read_text("utf-8"))["world"]]


def train(function: Function) -> Iterator[str]:
    """`train(envs, total_steps, seed)`, returning what acts: an agent with `act`, or a function of observations."""
    say(f"{len(WORLDS) + 1} small worlds, then CartPole-v1: up to a minute.")
    for number in range(len(WORLDS)):
        yield from in_world(function, number)
    yield from with_box_actions(function)
    with closing(make_vec("CartPole-v1", NUM_ENVS, backend="gymnasium")) as envs:
        mean = _mean_return(_trained(function, envs, CARTPOLE_STEPS), envs)
    if mean < CARTPOLE_RETURN:
        yield (
            f"all small worlds are right, but on CartPole-v1 the mean return after {CARTPOLE_STEPS:,} steps is"
            f" {mean:.0f}; {CARTPOLE_RETURN} is expected. None of the known mistakes; are the settings those of the"
            " skeleton?"
        )


def in_world(function: Function, number: int) -> Iterator[str]:
    """Train in one small world, and look at the action in its state 0."""
    world = WORLDS[number]
    envs = make_vec(WorldEnv, NUM_ENVS, env_kwargs={"world": number})
    with closing(envs), _ratios_of(function) as ratios:
        act = _trained(function, envs, STEPS)
    if int(np.asarray(act(world.obs(0)[None]))[0]) != 0:
        yield f"small world {number + 1} of {len(WORLDS) + 1}: {world.mistake}."
    if ratios and max(ratios) < 1e-6:
        yield (
            "the ratio is 1 in every gradient step, so the clip never acts. Likely: the old log-probabilities are"
            " computed again in each epoch; they belong before the epochs."
        )
    if ratios and ratios[0] > 1e-3:
        yield (
            "the ratio is not 1 in the first gradient step. Likely: the old log-probabilities are of other actions,"
            " or of other rows (the minibatch chooses rows of each column)."
        )


def with_box_actions(function: Function) -> Iterator[str]:
    """Train in the small world with Box actions, and look at the actions [1, 2] in its only state."""
    try:
        with closing(make_vec(BoxEnv, NUM_ENVS)) as envs:
            act = _trained(function, envs, STEPS)
        first, second = np.asarray(act(WORLDS[0].obs(0)[None]))[0]
    except Exception as error:  # what it raises is a finding, which has to say that it is not of Discrete actions
        yield f"in the small world with Box actions {raised(error)}"
        return
    if first - second < 0.5:
        yield (
            f"in the small world with Box actions it takes {first:.2g} and {second:.2g}, though the first minus the"
            " second is the reward. Likely: the actions are not those whose log-probability is trained."
        )


def _trained(function: Function, envs: VectorView, steps: int) -> Callable[[np.ndarray], Any]:
    made = function(envs, total_steps=steps, seed=1)
    return getattr(made, "act", made)


def _mean_return(act: Callable[[np.ndarray], Any], envs: VectorView) -> float:
    """Over the first episodes that end, from unseen starts; each environment plays equally many."""
    obs, _ = envs.reset(seed=12_345)
    running, returns = np.zeros(envs.num_envs), [[] for _ in range(envs.num_envs)]
    while min(map(len, returns)) < EPISODES_EACH:
        obs, reward, terminated, truncated, _ = envs.step(np.asarray(act(obs)))
        running += reward
        for i in np.flatnonzero(terminated | truncated):
            returns[i].append(running[i])
            running[i] = 0.0
    # The first ones of each alone: of all that ended, short episodes would be more than their share.
    return float(np.mean([episode for row in returns for episode in row[:EPISODES_EACH]]))


@contextmanager
def _ratios_of(function: Function) -> Iterator[list[float]]:
    """The largest |log ratio| in each call of `clipped_surrogate(log_ratio, …)`, if the function's file has one."""
    names: dict[str, Any] = getattr(function, "__globals__", {})
    found, own = [], names.get("clipped_surrogate")
    if own is None or "log_ratio" not in inspect.signature(own).parameters:  # it takes something else
        yield found
        return

    def watched(log_ratio: torch.Tensor, *args: Any, **options: Any) -> Any:
        found.append(log_ratio.detach().abs().max().item())
        return own(log_ratio, *args, **options)

    names["clipped_surrogate"] = watched
    try:
        yield found
    finally:
        names["clipped_surrogate"] = own
