"""The zoo's training loops: each mistake changes what is computed, and each right loop is repeatable.

What the right ones reach is in a comment of theirs, by `python tests/zoo_returns.py`.
"""

import functools
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import lemniscate as lem
from zoo_files import ZOO, Solution, execute, find, load

pytestmark = pytest.mark.long  # of the zoo itself, which the quick suite takes as it is


class World(gym.Env):
    """Deaths and time-outs, both within a few steps; the right action is what is seen."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, box):
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32) if box else gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._look(), {}

    def step(self, action):
        reward, self.t = 1 - float(np.abs(np.asarray(action) - self.s).sum()), self.t + 1
        return self._look(), reward, bool(self.np_random.random() < 0.1), self.t == 6, {}

    def _look(self):
        self.s = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.s


class Recorded:
    """The environments, and what they were told to do."""

    def __init__(self, box):
        self._envs, self.told = lem.make_vec(functools.partial(World, box), 3), []

    def __getattr__(self, name):
        return getattr(self._envs, name)

    def step(self, actions):
        self.told.append(np.array(actions))
        return self._envs.step(actions)


def told(code, title, name, box):
    """All actions of three rollouts and more of some loop, and what its agent does then; or the exception."""
    envs = Recorded(box)
    np.random.seed(0)
    try:
        agent = find(execute(Solution("", title, "", code, name), "zoo_of_loops"), name)(envs, 400, 1)
        obs = np.random.default_rng(0).uniform(-1, 1, (9, 2)).astype(np.float32)
        return np.array(envs.told), np.asarray(getattr(agent, "act", agent)(obs))
    except Exception as error:
        return repr(error)


@functools.cache
def of_the_right_one(path, box):
    return told(*next((code, title, name) for kind, title, _, code, name in load(path) if kind == "right"), box)


LOOPS = [(p, *b) for p in sorted(ZOO.glob("train.*.py")) for b in load(p)]


def same(a, b):
    return all(x.shape == y.shape and np.allclose(x, y, atol=1e-6) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize(
    ("path", "kind", "title", "regex", "code", "name"),
    LOOPS,
    ids=lambda x: x if isinstance(x, str) and len(x) < 99 else "",
)
@pytest.mark.filterwarnings("ignore")
@pytest.mark.one_in(5)
def test_a_mistake_changes_what_is_computed(path: Path, kind, title, regex, code, name):
    for box in (True, False):
        right, mine = of_the_right_one(path, box), told(code, title, name, box)
        assert not isinstance(right, str), right
        if kind == "wrong" and (isinstance(mine, str) or not same(right, mine)):
            print("raised:" if isinstance(mine, str) else "ran:", title, "|", mine if isinstance(mine, str) else "")
            return
        assert same(right, mine)
        assert len(right[1]) == 9
    assert kind == "right"
