"""DQN of Stable-Baselines3 where PQN learns, with the settings of rl-baselines3-zoo where it has some.

    .venv/bin/python benchmarks/values.py                                needs stable-baselines3
    .venv/bin/python benchmarks/values.py --envs CartPole-v1 --seeds 1 2

Each row of `benchmarks/results/values.jsonl` is one final policy: 100 episodes, deterministic; and the seconds of its
training, on one thread. `benchmarks/returns.py pqn` gives those of PQN.
"""

import argparse
import time

import gymnasium as gym
import numpy as np
import torch
from common import append, provenance, rows
from torch import nn

WIDE = {"gamma": 0.99, "policy_kwargs": {"net_arch": [256, 256]}}
LANDER = WIDE | {
    "learning_rate": 6.3e-4,
    "batch_size": 128,
    "buffer_size": 50_000,
    "learning_starts": 0,
    "target_update_interval": 250,
    "train_freq": 4,
    "gradient_steps": -1,
    "exploration_fraction": 0.12,
    "exploration_final_eps": 0.1,
}
CART_POLE = WIDE | {
    "learning_rate": 2.3e-3,
    "batch_size": 64,
    "buffer_size": 100_000,
    "learning_starts": 1_000,
    "target_update_interval": 10,
    "train_freq": 256,
    "gradient_steps": 128,
    "exploration_fraction": 0.16,
    "exploration_final_eps": 0.04,
}
BREAKOUT = {  # as in Young & Tian 2019, table 1, where SB3's DQN can; they learn at each of 5 million steps
    "learning_rate": 2.5e-4,
    "buffer_size": 100_000,
    "learning_starts": 5_000,
    "target_update_interval": 1_000,
    "exploration_final_eps": 0.1,
}
ENVS = {
    # environment: (steps, settings)
    "CartPole-v1": (50_000, CART_POLE),
    "Acrobot-v1": (100_000, LANDER),
    "LunarLander-v3": (100_000, LANDER),
    "MinAtar/Breakout-v1": (300_000, BREAKOUT),
}


def small_images():
    """The features of an image of 10 × 10: SB3's own encoder is for 36 × 36 and more."""
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class Encoder(BaseFeaturesExtractor):
        def __init__(self, space):
            super().__init__(space, 128)
            channels, height, width = space.shape
            inputs = 16 * (height - 2) * (width - 2)
            convolution = nn.Conv2d(channels, 16, kernel_size=3)
            self.layers = nn.Sequential(convolution, nn.ReLU(), nn.Flatten(), nn.Linear(inputs, 128), nn.ReLU())

        def forward(self, images):
            return self.layers(images)

    return {"features_extractor_class": Encoder, "net_arch": []}


def train(env, seed, steps, settings):
    """Returns of the final policy, and the seconds of its training."""
    from stable_baselines3 import DQN
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    import lemniscate.envs.packages  # noqa: F401  MinAtar's games by their ids

    images = len(gym.make(env).observation_space.shape) == 3
    if images:
        settings = settings | {"policy_kwargs": small_images()}
    model = DQN("CnnPolicy" if images else "MlpPolicy", make_vec_env(env, seed=seed), seed=seed, **settings)
    began = time.perf_counter()
    model.learn(steps)
    seconds = time.perf_counter() - began
    returns, _ = evaluate_policy(model, make_vec_env(env, seed=10_000), 100, return_episode_rewards=True)
    return list(map(float, returns)), seconds


def table():
    """Mean and worst of the seeds, of every environment."""
    for env, (steps, _) in ENVS.items():
        own = [row for row in rows("values") if (row["env"], row["steps"]) == (env, steps)]
        if own:
            means, seconds = [np.mean(row["returns"]) for row in own], np.median([row["seconds"] for row in own])
            seeds = len(own)
            print(f"| {env} | {steps:,} | {np.mean(means):.4g} | {min(means):.4g} | {seeds} | {seconds / 60:.1f} min |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--envs", nargs="+", default=list(ENVS))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1, 11)))
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    for env in () if given.table else given.envs:
        steps, settings = ENVS[env]
        for seed in given.seeds:
            returns, seconds = train(env, seed, steps, settings)
            row = {"env": env, "steps": steps, "seed": seed, "returns": returns, "seconds": seconds}
            append("values", row | provenance())
            print(f"{env} seed {seed}: {np.mean(returns):.1f} in {seconds:.0f} s", flush=True)
    table()
