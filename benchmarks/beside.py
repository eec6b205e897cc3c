"""The training loop of this checkout beside that of another one, in lockstep: what a change costs, to about 1 %.

    git worktree add ../old 42897e5
    .venv/bin/python benchmarks/beside.py ../old

Two processes take turns of four updates, PPO with its preset, compiled, so that both see the same machine. Printed are
the median and the quartiles of this checkout's time over the other's, in all, in `collect` and in `update`.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path
from statistics import median, quantiles

ROOT = Path(__file__).parents[1]
LOOP = """
import sys
from time import perf_counter as now

import torch

import lemniscate as lem
from lemniscate.algos import ppo
from lemniscate.data.rollout import collect
from lemniscate.envs import registry

torch.set_num_threads(1)
torch.manual_seed(0)
config = lem.config_for("ppo", sys.argv[1])
env = registry.make(sys.argv[1], config.num_envs)
env.restart(0)
state = ppo.init(config, env.spec, torch.device("cpu"))
state.compile()


def once():
    began = now()
    rollout = collect(env, state.networks.policy, config.num_steps, state.rng.action)
    collected = now()
    ppo.update(config, state, rollout)
    state.step = 0
    return collected - began, now() - collected


for _ in range(6):
    once()
print("ready", flush=True)
for _ in sys.stdin:
    print(*map(sum, zip(*(once() for _ in range(4)))), flush=True)
"""


def begin(source, env):
    """A process that has compiled its loop, and runs four updates for each line it reads."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", LOOP, env], env={**os.environ, "PYTHONPATH": str(source)}, **pipes)


def turn(process):
    """Seconds in `collect` and in `update`."""
    process.stdin.write("\n")
    process.stdin.flush()
    return [float(word) for word in process.stdout.readline().split()]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="the other checkout")
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--turns", type=int, default=60)
    given = parser.parse_args()
    here, there = (begin(checkout.resolve() / "src", given.env) for checkout in (ROOT, given.other))
    if [process.stdout.readline().strip() for process in (here, there)] != ["ready", "ready"]:
        raise SystemExit("One of the two did not begin; see above.")
    ratios = {"all": [], "collect": [], "update": []}
    for k in range(given.turns):
        order = (here, there) if k % 2 else (there, here)
        seconds = {process: turn(process) for process in order}
        for name, of in (("all", sum), ("collect", lambda both: both[0]), ("update", lambda both: both[1])):
            ratios[name].append(of(seconds[here]) / of(seconds[there]))
    for name, found in ratios.items():
        first, _, third = quantiles(found, n=4)
        print(f"{name}: {median(found):.3f} of the other's time ({first:.3f} to {third:.3f})")
    for process in (here, there):
        process.kill()


if __name__ == "__main__":
    main()
