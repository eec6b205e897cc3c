"""What a second core can give: EnvPool in two halves that take turns, the gradient step on two threads, short waits.

    .venv/bin/python benchmarks/cores.py              all, five rounds
    .venv/bin/python benchmarks/cores.py halves       steps per second with a policy between the steps
    .venv/bin/python benchmarks/cores.py threads      milliseconds of a compiled gradient step
    .venv/bin/python benchmarks/cores.py waiting      steps per second of whole runs, by how long threads wait

In halves one half of the environments steps while the policy acts in the other. What is printed are medians over
rounds in which the ways take turns, and the median ratio to the first way. docs/speed.md has the figures.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
import torch
from common import random_rollout

ENVS = (("HalfCheetah-v5", 16, 1500), ("HalfCheetah-v5", 64, 500), ("Ant-v5", 64, 200), ("Humanoid-v5", 64, 150))
ROWS = (64, 256, 512, 2048)


def table(ways, rounds, digits):
    """Call each way `rounds` times, in turns; print the medians and the ratios to the first."""
    found = {name: [] for name in ways}
    for _ in range(rounds):
        for name, measure in ways.items():
            found[name].append(measure())
    first = next(iter(found.values()))
    for name, values in found.items():
        ratio = median(value / beside for value, beside in zip(values, first, strict=True))
        print(f"    {name}: {median(values):,.{digits}f}, {ratio:.2f} ×", flush=True)


def policy(pool):
    """From the observations of a pool to noisy actions within its bounds: 64 × 64, eager, one thread."""
    space, inputs = pool.action_space, pool.observation_space.shape[0]
    layers = (torch.nn.Linear(inputs, 64), torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh())
    net = torch.nn.Sequential(*layers, torch.nn.Linear(64, space.shape[0]))

    @torch.no_grad()
    def act(obs):
        mean = net(torch.from_numpy(obs.astype(np.float32)).clamp(-10, 10))
        return np.clip((mean + 0.6 * torch.randn_like(mean)).numpy().astype(np.float64), space.low, space.high)

    return act


def together(pool, act, steps):
    """Steps per second where all environments step, then all wait for the policy."""
    obs, _ = pool.reset()
    started = time.perf_counter()
    for _ in range(steps):
        obs = pool.step(act(obs))[0]
    return steps * len(obs) / (time.perf_counter() - started)


def in_turns(pools, act, steps):
    """Steps per second where one half steps while the policy acts in the other."""
    first = [pool.reset()[0] for pool in pools]
    ids = np.arange(len(first[0]), dtype=np.int32)
    for pool, obs in zip(pools, first, strict=True):
        pool.send(act(obs), ids)
    started = time.perf_counter()
    for _ in range(steps):
        for pool in pools:
            pool.send(act(pool.recv()[0]), ids)
    spent = time.perf_counter() - started
    for pool in pools:
        pool.recv()
    return steps * len(pools) * len(ids) / spent


def halves(rounds):
    """Steps per second of EnvPool with a policy between the steps, as one vector and as two halves."""
    import envpool

    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    for env, num_envs, steps in ENVS:
        make = partial(envpool.make, env, env_type="gymnasium")
        whole = make(num_envs=num_envs, num_threads=2, seed=1)
        act = policy(whole)
        ways = {"one vector, two threads": partial(together, whole, act, steps)}
        for count in (1, 2):
            pools = [make(num_envs=num_envs // 2, num_threads=count, seed=seed) for seed in (1, 2)]
            ways[f"two halves, {count} + {count} threads"] = partial(in_turns, pools, act, steps)
        print(f"{num_envs} × {env}, steps per second")
        table(ways, rounds, 0)


def threads(rounds):
    """Milliseconds of a compiled gradient step of PPO, HalfCheetah's sizes, on one thread and on two."""
    from lemniscate.algos import ppo
    from lemniscate.data.rollout import epoch_minibatches
    from lemniscate.optim.compiled import Compiler
    from lemniscate.system.world import ALONE

    spec, rollout = random_rollout(64)

    def milliseconds(state, config, batch, minibatches, count):
        torch.set_num_threads(count)
        started = time.perf_counter()
        for _ in range(4):
            state.learn(config, state, batch, minibatches, batch.advantage[minibatches])
        return 1e3 * (time.perf_counter() - started) / (4 * len(minibatches))

    for rows in ROWS:
        ways = {}
        for count in (1, 2):
            torch.set_num_threads(count)
            config = ppo.Config(num_envs=64, num_steps=128, minibatch_size=rows)
            state = ppo.init(config, spec, torch.device("cpu"))
            state.prepare(ALONE, Compiler())
            state.optimizer.learning_rate = 3e-4
            batch = ppo.advantages(config, state.networks, rollout)
            minibatches = epoch_minibatches(torch.arange(8192), 8192, rows, state.rng.minibatch)
            ways[f"threads: {count}"] = partial(milliseconds, state, config, batch, minibatches, count)
            ways[f"threads: {count}"]()
        print(f"{rows} rows, milliseconds of a gradient step")
        table(ways, rounds, 3)


LONG, SHORT = "300000", "20000"
"""what OpenMP's threads wait by themselves, in turns of a loop, and what `lemniscate train` has them wait"""
TRAINED = (("reppo", "HalfCheetah-v5", 200_000), ("reppo", "Walker2d-v5", 200_000), ("trpo", "Walker2d-v5", 160_000))


def pace(algorithm, env, steps, count, spin):
    """The median steps per second of the last two thirds of a run of `lemniscate train`."""
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "train",
            algorithm,
            "--env",
            env,
            "--total-steps",
            str(steps),
            "--threads",
            str(count),
            "--seed",
            "101",
        ]
        words += ["--compile", "on"] if algorithm == "reppo" else []
        words += ["--run", f"{folder}/run", "--quiet"]
        command = [sys.executable, "-m", "lemniscate", *words]
        subprocess.run(command, env=os.environ | {"GOMP_SPINCOUNT": spin}, check=True, stderr=subprocess.DEVNULL)
        lines = map(json.loads, (Path(folder) / "run" / "metrics.jsonl").read_text().splitlines())
        paces = [line["time/steps_per_second"] for line in lines if "time/steps_per_second" in line]
    return median(paces[len(paces) // 3 :])


def waiting(rounds):
    """Steps per second of runs on one thread, and on two that wait for each other long or briefly."""
    for run in TRAINED:
        ways = {
            "one thread": partial(pace, *run, 1, LONG),
            "two threads, as OpenMP has them wait": partial(pace, *run, 2, LONG),
            "two threads that wait briefly": partial(pace, *run, 2, SHORT),
        }
        print(f"{run[0]} on {run[1]}, steps per second")
        table(ways, rounds, 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    measures = {"halves": halves, "threads": threads, "waiting": waiting}
    parser.add_argument("measures", nargs="*", metavar="MEASURE", help=", ".join(measures))
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    if wrong := set(given.measures) - set(measures):
        parser.error(f"there is no measure {', '.join(sorted(wrong))}; there is {', '.join(measures)}")
    for name in given.measures or measures:
        measures[name](given.rounds)


if __name__ == "__main__":
    main()
