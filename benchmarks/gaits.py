"""How HalfCheetah runs early in training: on both legs, nose down on its front foot, or on its back; in which strides.

    .venv/bin/python benchmarks/gaits.py reppo --set total_steps=6_600_000
    .venv/bin/python benchmarks/gaits.py reppo --set total_steps=6_600_000 initial_log_std=-0.5 --seeds 107 108
    .venv/bin/python benchmarks/gaits.py ppo --steps 500_000

A run is stopped after `--steps`, at the learning rate that it has there when it is to last `total_steps`. Its policy,
deterministic, runs for 500 steps from three starts in Gymnasium. Each line of `benchmarks/results/gaits.jsonl` is a
policy, without the first 100 steps: its mean pitch in radians, positive with the nose down, its mean reward for 1,000
steps, and the strongest frequency of its actions in Hz, its strides, of the three starts the middle one.
"""

import argparse
import ast
import tempfile

import numpy as np
from common import append, provenance

OFF_ITS_LEGS = 0.5
"""radians of mean pitch: 0.1 on both legs, 1.1 on the front foot, 3.3 on the back, a third of that where one start of
three ends so"""


def gait(policy):
    """Mean pitch, reward for 1,000 steps, and strides a second."""
    import gymnasium as gym

    pitches, rewards, strides, env = [], [], [], gym.make("HalfCheetah-v5", max_episode_steps=500)
    for seed in range(3):
        obs, _ = env.reset(seed=seed)
        actions = []
        for step in range(500):
            action = policy.act(obs)
            obs, reward, *_ = env.step(action)
            if step >= 100:
                actions.append(action)
                pitches.append(obs[1])
                rewards.append(reward)
        spectrum = np.abs(np.fft.rfft(actions - np.mean(actions, axis=0), axis=0)).sum(axis=1)
        strides.append(np.fft.rfftfreq(len(actions), env.unwrapped.dt)[spectrum.argmax()])
    return float(np.mean(pitches)), float(np.mean(rewards) * 1000), float(np.median(strides))


def one(algorithm, seed, steps, fields):
    """Train until `steps`, and look at the policy."""
    import lemniscate as lem

    with tempfile.TemporaryDirectory() as scratch:
        given = {"seed": seed, "checkpoint_every": 10**9, "progress": False, **fields}
        enough = [lambda step, _metrics, _policy: step >= steps]
        run = lem.train(algorithm, "HalfCheetah-v5", run=f"{scratch}/run", callbacks=enough, **given)
        pitch, reward, strides = gait(run.policy)
    row = {"algorithm": algorithm, "seed": seed, "steps": steps, "fields": fields}
    append("gaits", row | {"pitch": pitch, "reward": reward, "strides": strides} | provenance())
    return pitch, reward, strides


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithm", help="its name")
    parser.add_argument("--steps", type=int, default=330_000, help="after so many training stops; default 330_000")
    parser.add_argument("--seeds", type=int, nargs="*", default=range(101, 107), help="default 101 to 106")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="fields, as Python literals")
    options = parser.parse_args()
    fields = {name: ast.literal_eval(value) for name, _, value in (each.partition("=") for each in options.set)}
    found = [one(options.algorithm, seed, options.steps, fields) for seed in options.seeds]
    for seed, (pitch, reward, strides) in zip(options.seeds, found, strict=True):
        legs = "off its" if pitch > OFF_ITS_LEGS else "on both"
        print(f"seed {seed}: {legs} legs, pitch {pitch:.2f}, {strides:.1f} strides a second, {reward:,.0f}")
    fallen = sum(pitch > OFF_ITS_LEGS for pitch, *_ in found)
    print(f"{fallen} of {len(found)} are off their legs; mean {np.mean([reward for _, reward, _ in found]):,.0f}")


if __name__ == "__main__":
    main()
