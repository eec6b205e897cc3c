"""What the training loops of the zoo reach: `python tests/zoo_returns.py [right|wrong] [words of a title]`.

The checker has no part in this: CartPole-v1 in 60,000 steps of 8 environments, and a Box world in 30,000 steps, in
which the right action is s + 0.5; then the greedy return of the one and the reward per step of the other.
"""

import sys
import time

import gymnasium as gym
import numpy as np
import torch

import lemniscate as lem
from zoo_files import ZOO, execute, find, load


class Follow(gym.Env):
    """The reward is −|a − s − 0.5|²; an episode is 10 steps."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-3, 3, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.s = 0, self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.s, {}

    def step(self, action):
        reward = -float(((action - self.s - 0.5) ** 2).sum())
        self.t, self.s = self.t + 1, self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.s, reward, False, self.t == 10, {}


def cartpole(act, episodes=10):
    """The mean return of the greedy policy."""
    env, returns = gym.make("CartPole-v1"), []
    for seed in range(episodes):
        (obs, _), total, over = env.reset(seed=seed), 0.0, False
        while not over:
            obs, reward, terminated, truncated, _ = env.step(int(np.asarray(act(obs[None]))[0]))
            total, over = total + reward, terminated or truncated
        returns.append(total)
    return float(np.mean(returns))


def follow(act):
    """The mean reward per step of the greedy policy."""
    s = np.random.default_rng(0).uniform(-1, 1, (200, 2)).astype(np.float32)
    return -float(((np.clip(np.asarray(act(s)), -3, 3) - s - 0.5) ** 2).sum(1).mean())


def main(kind="right", words=""):
    torch.set_num_threads(1)
    for path in sorted(ZOO.glob("train.*.py")):
        for solution in load(path):
            title = solution.title
            if solution.kind != kind or words not in title:
                continue
            begun, reached = time.time(), []
            for env, steps, judge in (("CartPole-v1", 60_000, cartpole), (Follow, 30_000, follow)):
                try:
                    train = find(execute(solution, "zoo_of_returns"), solution.name)
                    agent = train(lem.make_vec(env, 8), steps, 1)
                    reached.append(judge(getattr(agent, "act", agent)))
                except Exception as error:
                    reached.append(repr(error))
            print(path.name, "|", title, "|", *reached, f"| {time.time() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
