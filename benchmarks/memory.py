"""Policies with a memory where observations say too little, beside policies without, and sb3-contrib's RecurrentPPO.

    .venv/bin/python benchmarks/memory.py gru --envs cart_pole --seeds 1 2
    .venv/bin/python benchmarks/memory.py mlp                            the same settings, without a memory
    .venv/bin/python benchmarks/memory.py sb3                            needs sb3-contrib
    .venv/bin/python benchmarks/memory.py --table
    .venv/bin/python benchmarks/memory.py --cost                         an iteration with a memory, beside one without

Each row of `benchmarks/results/memory.jsonl` is one final policy: 100 episodes, deterministic; and the seconds of its
training, on one thread.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from common import append, provenance, rows

import lemniscate as lem
from lemniscate.run.metrics import read_metrics

SHARED = {"minibatch_size": 512, "learning_rate": 1e-3, "hidden": (64,)}
ENVS = {
    # environment: (steps, what is asked for, settings of ppo, found on seeds from 101 on)
    "cart_pole": (60_000, "500", SHARED),
    "pendulum": (
        400_000,
        "≥ −200",
        SHARED | {"gamma": 0.95, "num_steps": 256, "sequence_length": 32, "desired_kl": None},
    ),
    "RepeatFirst": (300_000, "1", SHARED | {"sequence_length": 64, "desired_kl": None}),
    "lunar_lander": (2_000_000, "≥ 200", SHARED | {"gamma": 0.995, "sequence_length": 32, "desired_kl": None}),
}


def ours(env: str, seed: int, steps: int, settings: dict) -> tuple[list[float], float]:
    """Returns of the final policy, and the seconds of its training."""
    with tempfile.TemporaryDirectory() as scratch:
        fields = {"seed": seed, "total_steps": steps, "run": f"{scratch}/run", "progress": False, **settings}
        run = lem.train("ppo", f"hidden:{env}", **fields)
        return lem.evaluate(run.policy, episodes=100, seed=0).returns, run.seconds


def theirs(env: str, seed: int, steps: int, _: dict) -> tuple[list[float], float]:
    """The same of RecurrentPPO with its defaults, of 8 environments, 128 steps each."""
    import hidden
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    vector = make_vec_env(getattr(hidden, env), n_envs=8, seed=seed)
    model = RecurrentPPO("MlpLstmPolicy", vector, n_steps=128, batch_size=256, n_epochs=10, seed=seed, device="cpu")
    began = time.perf_counter()
    model.learn(steps)
    seconds = time.perf_counter() - began
    returns, _ = evaluate_policy(
        model, make_vec_env(getattr(hidden, env), 1, seed=10_000), 100, return_episode_rewards=True
    )
    return returns, seconds


def iteration(env: str, network: str, steps: int) -> float:
    """Seconds of an iteration of PPO by its preset, acting and learning: the median of all but the first two."""
    with tempfile.TemporaryDirectory() as scratch:
        fields = {"total_steps": steps, "evaluate_every": 0, "compile": "off", "progress": False}
        run = lem.train("ppo", env, run=f"{scratch}/run", network=network, **fields)
        lines = [line for line in read_metrics(run.path) if "time/learn" in line]
    return float(np.median([line["time/collect"] + line["time/learn"] for line in lines[2:]]))


def table() -> str:
    """Mean and worst of the seeds, of every policy."""
    said = ["| what is hidden | steps | asked for | gru | mlp | RecurrentPPO |", "|---|---|---|---|---|---|"]
    done = rows("memory")
    for env, (steps, wanted, _) in ENVS.items():
        cells = []
        for network in ("gru", "mlp", "sb3"):
            own = [row for row in done if row["env"] == env and row["network"] == network and row["steps"] == steps]
            means = [np.mean(row["returns"]) for row in own]
            seconds = np.median([row["seconds"] for row in own]) if own else 0
            cells.append(f"{np.mean(means):.4g}, worst {min(means):.4g} of {len(own)}; {seconds:.0f} s" if own else "–")
        said.append(f"| {env} | {steps:,} | {wanted} | {' | '.join(cells)} |")
    return "\n".join(said)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("network", nargs="?", choices=["gru", "mlp", "sb3"])
    parser.add_argument("--envs", nargs="+", default=list(ENVS))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1, 11)))
    parser.add_argument("--settings", type=json.loads, default={}, help="others than those above, of a search")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--try", action="store_true", dest="trial", help="print, and store nothing")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--cost", action="store_true")
    given = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parent))
    torch.set_num_threads(1)
    for env in given.envs if given.network else ():
        steps, _, settings = ENVS[env]
        steps, found = given.steps or steps, []
        for seed in given.seeds:
            play = theirs if given.network == "sb3" else ours
            returns, seconds = play(env, seed, steps, {**settings, **given.settings, "network": given.network})
            found.append((round(float(np.mean(returns)), 1), round(seconds, 1)))
            if not (given.trial or given.settings):
                row = {"env": env, "network": given.network, "steps": steps, "seed": seed}
                append("memory", row | {"returns": list(map(float, returns)), "seconds": seconds, **provenance()})
        print(env, steps, given.settings, f"{np.mean([f[0] for f in found]):.1f}", found, flush=True)
    for env, steps in (("CartPole-v1", 25_000), ("HalfCheetah-v5", 60_000)) if given.cost else ():
        ratios = [iteration(env, "gru", steps) / iteration(env, "mlp", steps) for _ in range(5)]
        print(f"{env}: {np.median(ratios):.2f} ×, {min(ratios):.2f} to {max(ratios):.2f}", flush=True)
    if given.table:
        print(table())
