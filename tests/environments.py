"""Environments in which the right action is a copy of what is seen, in spaces of every kind, some that fail, and wrappers.

Workers import this, so it imports nothing that takes seconds.
"""

import os
import signal
import sys
import time

import gymnasium as gym
import numpy as np
from gymnasium import spaces

KINDS = {
    # kind: (observation space, action space)
    "box": (spaces.Box(-1, 1, (2, 1), np.float64), spaces.Box(np.float32([[-1], [0]]), np.float32([[3], [1]]))),
    "discrete": (spaces.Discrete(3, start=5), spaces.Discrete(3, start=-1)),
    "multi-discrete": (spaces.MultiDiscrete([2, 3]), spaces.MultiDiscrete([2, 3], start=[1, 0])),
    "multi-binary": (spaces.MultiBinary(3), spaces.MultiBinary(3)),
    "tuple": (spaces.Tuple([spaces.Discrete(2), spaces.Dict({"z": spaces.Box(0, 1, (3,)), "a": spaces.MultiBinary(1)})]), spaces.Discrete(2)),
    "image": (spaces.Box(0, 255, (9, 12, 3), np.uint8), spaces.Discrete(2)),
    "masked": (spaces.Discrete(3), spaces.Discrete(4)),
}  # fmt: skip


class Copy(gym.Env):
    """Reward 1 for the copy of what is seen, else 0; an episode is 8 steps.

    In "masked" exactly two actions are valid, the copy and the fourth; any other ends the episode with reward -100.
    """

    def __init__(self, kind: str):
        self.kind = kind
        self.observation_space, self.action_space = KINDS[kind]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._show(), self._info()

    def step(self, action):
        reward, self.t = self._reward(action), self.t + 1
        return self._show(), reward, reward < 0 or self.t == 8, False, self._info()

    def _info(self):
        if self.kind != "masked":
            return {}
        mask = np.zeros(4, dtype=np.int8)
        mask[[self.target, 3]] = 1
        return {"action_mask": mask}

    def _show(self):
        draw = self.np_random.integers
        self.target = draw(2)
        if self.kind == "box":
            self.target = self.np_random.uniform(-1, 1, (2, 1))
        elif self.kind in ("discrete", "masked"):
            self.target = draw(3)
            return self.target + int(self.observation_space.start)
        elif self.kind == "multi-discrete":
            self.target = np.array([draw(2), draw(3)])
        elif self.kind == "multi-binary":
            self.target = draw(2, size=3).astype(np.int8)
        elif self.kind == "tuple":
            return self.target, {"a": np.array([1], dtype=np.int8), "z": np.zeros(3, dtype=np.float32)}
        elif self.kind == "image":
            picture = np.zeros((9, 12, 3), dtype=np.uint8)
            picture[:, 6 * self.target : 6 * self.target + 6, 1] = 255
            return picture
        return self.target

    def _reward(self, action):
        assert self.action_space.contains(action.astype(self.action_space.dtype) if self.kind == "box" else action)
        if self.kind == "box":
            return 1 - float(np.abs((action - [[1], [0.5]]) / [[2], [0.5]] - self.target).mean())
        if self.kind == "masked":
            return {self.target: 1, 3: 0}.get(int(action), -100)
        if self.kind in ("multi-discrete", "multi-binary"):
            start = getattr(self.action_space, "start", 0)
            return float((action - start == self.target).mean())
        return float(action - int(getattr(self.action_space, "start", 0)) == self.target)


for kind in KINDS:
    gym.register(f"Copy-{kind}-v0", entry_point="environments:Copy", max_episode_steps=100, kwargs={"kind": kind})


class Unreadable(gym.Env):
    """Observations of no fixed size."""

    observation_space = spaces.Sequence(spaces.Discrete(2))
    action_space = spaces.Discrete(2)


gym.register("Unreadable-v0", entry_point="environments:Unreadable")


class Unbounded(gym.Env):
    """Actions without an end."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(-np.inf, np.inf, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}


gym.register("Unbounded-v0", entry_point="environments:Unbounded", max_episode_steps=5)


class Reach(gym.Env):
    """Episodes of `length` steps; success is reached in the last one, or never in every other environment."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    metadata = {"render_modes": [], "measures": ["height"]}  # noqa: RUF012

    def __init__(self, length=4, reward=1.0, render_mode=None):
        self.length, self.reward = length, reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        info = {"is_success": self.t == self.length, "unnamed": 7.0}
        if self.t != 2:
            info["height"] = float(self.t)
        return np.zeros(1, np.float32), self.reward, self.t == self.length, False, info


class PlusOne(gym.RewardWrapper):
    def __init__(self, env, by=1.0):
        super().__init__(env)
        self.by = by

    def reward(self, reward):
        return reward + self.by


def times_ten(env):
    return gym.wrappers.TransformReward(env, lambda reward: 10 * reward)


class Fragile(gym.Env):
    """In a run named ppo-2 a reward is NaN, in one named ppo-3 the process is killed; else nothing happens."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        name = next((argument.rpartition("/")[2] for argument in sys.argv if "/ppo-" in argument), "")
        if name == "ppo-3":
            os.kill(os.getpid(), signal.SIGKILL)
        return np.zeros(1, np.float32), np.nan if name == "ppo-2" else 1.0, self.t == 8, False, {}


class Pictures(gym.Env):
    """Random images of bytes of any shape; an episode is 8 steps."""

    action_space = spaces.Discrete(2)

    def __init__(self, shape):
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._look(), {}

    def step(self, action):
        self.t += 1
        return self._look(), 0.0, self.t == 8, False, {}

    def _look(self):
        return self.np_random.integers(0, 256, self.observation_space.shape, np.uint8)


def tell(step, metrics, policy):
    """A callback."""
    print(f"called at {step}", flush=True)


class Hanging(Copy):
    """Hangs in the fiftieth step of the process."""

    def __init__(self):
        super().__init__("box")
        self.steps = 0

    def step(self, action):
        self.steps += 1
        if self.steps == 50:
            time.sleep(1000)
        return super().step(action)


class Graded(gym.Env):
    """What is seen is noise, and rewards are higher by a level, which is 0 unless it is set, and is told."""

    observation_space, action_space, level = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2), 0.0

    def set_level(self, level):
        if level < 0:
            raise ValueError("no such level")
        self.level = level

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._see(), {}

    def step(self, action):
        self.t += 1
        return self._see(), self.level, False, self.t >= 8, {"level": self.level}

    def _see(self):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)


def harder(step, metrics):
    """A level that grows with the step, and with what was reached."""
    assert not any(name.startswith("time/") for name in metrics)
    return {"set_level": np.float64(1 + step // 32 + min(metrics.get("episode/return", 0.0), 64.0) / 128)}


class Noise(gym.Env):
    """Observations are noise, rewards actions; an episode is `length` steps."""

    observation_space, action_space, length = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2), 5

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._see(), {}

    def step(self, action):
        self.t += 1
        return self._see(), float(np.sum(action)), False, self.t == self.length, {}

    def _see(self):
        return self.np_random.uniform(-1, 1, self.observation_space.shape).astype(np.float32)


class Near(gym.Env):
    """A number is to be brought near a goal: reward 0 within a tolerance, else −1; an episode is 20 steps."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)
    observation_space = spaces.Dict(
        {name: spaces.Box(-9, 9, (1,), np.float32) for name in ("observation", "achieved_goal", "desired_goal")}
    )
    tolerance = 0.5

    def set_tolerance(self, tolerance):
        self.tolerance = tolerance

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.x = 0, np.zeros(1, np.float32)
        self.goal = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self._see(), {}

    def step(self, action):
        self.t, self.x = self.t + 1, np.clip(self.x + np.float32(0.3) * action, -9, 9).astype(np.float32)
        return self._see(), self.compute_reward(self.x, self.goal, {}), False, self.t == 20, {}

    def compute_reward(self, achieved, desired, info):
        return -float(np.abs(achieved - desired)[0] > self.tolerance)

    def _see(self):
        return {"observation": self.x.copy(), "achieved_goal": self.x.copy(), "desired_goal": self.goal.copy()}


def nearer(step, metrics):
    return {"set_tolerance": 20.0 if step < 150 else 0.1}


def near(step, metrics):
    return {"set_tolerance": 0.1}


class Walk(gym.Env):
    """A walk to a goal on a line, in a plane or in space, at most 1 m a step: reward 0 within 0.5 m of it, else −1.

    It ends at the goal where `ends`; at more than `edge` from the beginning it falls off, and ends too.
    """

    def __init__(self, ends=True, edge=100.0, limit=12, axes=1):
        place = gym.spaces.Box(-1_000, 1_000, (axes,), np.float64)
        clock = gym.spaces.Box(0, 10_000, (1,), np.float64)
        self.observation_space = gym.spaces.Dict({"achieved_goal": place, "desired_goal": place, "observation": clock})
        self.action_space = gym.spaces.Box(-1, 1, (axes,))
        self.edge, self.limit = edge, limit
        if ends:
            self.compute_terminated = lambda achieved, desired, info: bool(np.linalg.norm(achieved - desired) < 0.5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = np.zeros(self.action_space.shape), 0
        self.goal = self.np_random.uniform(-8, 8, self.x.shape)
        return self._see(), {}

    def step(self, action):
        self.x, self.t = self.x + action, self.t + 1
        reward = self.compute_reward(self.x, self.goal, {})
        ended = np.linalg.norm(self.x) > self.edge or (reward == 0 and hasattr(self, "compute_terminated"))
        return self._see(), reward, bool(ended), self.t >= self.limit, {"is_success": reward == 0}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return 0.0 if np.linalg.norm(achieved_goal - desired_goal) < 0.5 else -1.0

    def _see(self):
        return {
            "observation": np.array([float(self.t)]),
            "achieved_goal": self.x.copy(),
            "desired_goal": self.goal.copy(),
        }
