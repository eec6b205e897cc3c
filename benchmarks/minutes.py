"""Return against minutes: the eight algorithms, Stable-Baselines3 and SBX, on five environments; three on eight more.

    .venv/bin/python benchmarks/minutes.py                              all of ours: an hour on two cores
    .venv/bin/python benchmarks/minutes.py ppo sac --envs Ant-v5        some of it
    .venv/bin/python benchmarks/minutes.py sb3 sbx                      the peers; `make .venv/.peers` installs them
    .venv/bin/python benchmarks/minutes.py --unknown                    PPO, TRPO and REPPO where no preset was searched
    .venv/bin/python benchmarks/minutes.py --table                      the tables, and a picture for each environment

One core and one thread for each run, as many runs at a time as there are cores. An algorithm has the settings that
`lemniscate train ALGORITHM --env …` gives it, and about as many steps as take `MINUTES` there (`STEPS`): a learning
rate that falls has to know where it ends. A peer has the settings of its zoo, and stops when the time is up.
The clock starts before the environments are made, so that compiling counts. Each row of
`benchmarks/results/minutes.jsonl` is a run: its curve, and its final policy over 100 episodes, deterministic.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from queue import Queue

import numpy as np
from common import RESULTS, append, provenance, rows
from peers import PEER_MINUTES

MINUTES = {"Pendulum-v1": 1, "MountainCarContinuous-v0": 1, "HalfCheetah-v5": 3, "Hopper-v5": 3, "Ant-v5": 3}
STEPS = {
    # algorithm: thousands of steps in so many minutes, in the order of MINUTES
    "reinforce": (450, 450, 1400, 1000, 500),
    "a2c": (450, 450, 1500, 1100, 500),
    "trpo": (300, 400, 1500, 950, 450),
    "ppo": (350, 400, 3000, 640, 500),
    "reppo": (250, 250, 1800, 750, 580),
    "ddpg": (18, 15, 45, 144, 22),
    "td3": (18, 10, 36, 25, 19),
    "sac": (18, 7, 220, 200, 150),
}
UNKNOWN = {
    # environment without a preset: thousands of steps that take each of DEFAULTS a minute
    "InvertedPendulum-v5": (650, 350, 400),
    "HumanoidStandup-v5": (117, 96, 102),
    "LunarLanderContinuous-v3": (600, 340, 400),
    "EnvPool/WalkerWalk-v1": (420, 280, 250),
    "EnvPool/FetchReachDense-v4": (96, 84, 81),
    "EnvPool/MetaWorld/Reach-v3": (370, 250, 220),
    "EnvPool/myoElbowPose1D6MRandom-v0": (260, 53, 150),
    "EnvPool/MuJoCoPlayground/PandaPickCube-v1": (330, 250, 220),
}
DEFAULTS = ("ppo", "trpo", "reppo")
"""the candidates for the recommended algorithm"""
PEERS = {"sb3": ("ppo",), "sbx": ("sac",)}
PEER_ENVS = ("HalfCheetah-v5", "Hopper-v5", "Ant-v5")
PEER_SEEDS = (1, 2)
POINTS = 80
"""of a stored curve, at most"""


def thousands(algorithm, env):
    """The steps of a run, in thousands."""
    if env in MINUTES:
        return STEPS[algorithm][list(MINUTES).index(env)]
    return UNKNOWN[env][DEFAULTS.index(algorithm)]


def train(algorithm, env, seed):
    """Train in this process; returns what a row says of it."""
    import lemniscate as lem

    started, curve = time.monotonic(), []

    def follow(step, metrics, _policy):
        if "episode/return" in metrics:
            curve.append([(time.monotonic() - started) / 60, step, metrics["episode/return"]])

    steps, own = 1000 * thousands(algorithm, env), env.startswith("EnvPool/")
    with tempfile.TemporaryDirectory() as scratch:
        fields = {"seed": seed, "total_steps": steps, "checkpoint_every": steps, "progress": False}
        run = lem.train(algorithm, env, run=Path(scratch) / "run", callbacks=[follow], **fields)
        minutes = (time.monotonic() - started) / 60
        scores = lem.evaluate(run.policy, episodes=100, seed=0, backend=None if own else "gymnasium")
    return {"steps": run.policy.step, "minutes": minutes, "curve": curve, "mean_return": scores.mean_return}


def peer(library, algorithm, env, seed):
    """The same of a peer."""
    import runpy

    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "peer.py"
        file.write_text(PEER_MINUTES)
        return runpy.run_path(str(file))["train"](library, algorithm, env, seed, MINUTES[env])


def one(library, algorithm, env, seed, core):
    """A run in this process, and its row."""
    os.sched_setaffinity(0, [core])
    row = train(algorithm, env, seed) if library == "lemniscate" else peer(library, algorithm, env, seed)
    row["curve"] = [[round(x, 3) for x in point] for point in row["curve"][:: len(row["curve"]) // POINTS + 1]]
    names = {"library": library, "algorithm": algorithm, "env": env, "seed": seed}
    append("minutes", names | row | provenance())
    print(
        f"{library} {algorithm} {env} seed {seed}: {row['mean_return']:.0f} after {row['minutes']:.1f} min", flush=True
    )


def together(runs):
    """Each run in a process of its own, on a core of its own."""
    cores = Queue()
    for core in sorted(os.sched_getaffinity(0)):
        cores.put(core)

    def start(run):
        core = cores.get()
        done = subprocess.run([sys.executable, __file__, "--one", *map(str, run), str(core)], check=False)
        cores.put(core)
        return done.returncode == 0

    with ThreadPoolExecutor(cores.qsize()) as pool:
        failed = [" ".join(map(str, run)) for run, well in zip(runs, pool.map(start, runs), strict=True) if not well]
    if failed:
        raise SystemExit(f"These runs failed: {', '.join(failed)}.")


def measured(env):
    """{(library, algorithm): its rows} of an environment, in the order of STEPS and PEERS."""
    names = [("lemniscate", name) for name in STEPS] + [(library, name) for library in PEERS for name in PEERS[library]]
    of = {
        name: [r for r in rows("minutes") if (r["library"], r["algorithm"]) == name and r["env"] == env]
        for name in names
    }
    return {name: found for name, found in of.items() if found}


def label(library, algorithm):
    named = {"sb3": "Stable-Baselines3", "sbx": "SBX"}
    return algorithm.upper() if library == "lemniscate" else f"{named[library]}, {algorithm.upper()}"


def unknown():
    """A row for each environment without a preset: the mean of each default over seeds, and its worst seed."""
    print("| | seeds |", " | ".join(name.upper() for name in DEFAULTS), "|")
    print("|---|--:|" + "--:|" * len(DEFAULTS))
    for env in UNKNOWN:
        of = [[row["mean_return"] for row in measured(env).get(("lemniscate", name), [])] for name in DEFAULTS]
        if any(of):
            digits = 0 if max(abs(x) for returns in of for x in returns) >= 200 else 1
            row = [f"{np.mean(x):,.{digits}f} ({min(x):,.{digits}f})" if x else "" for x in of]
            print(f"| {env} | {max(map(len, of))} | {' | '.join(row)} |")


def table():
    """A row for each algorithm: the final policy, mean over seeds, and its minutes."""
    print("| |", " | ".join(f"{env}, {minutes} min" for env, minutes in MINUTES.items()), "|")
    print("|---|" + "--:|" * len(MINUTES))
    by_env = {env: measured(env) for env in MINUTES}
    for name in dict.fromkeys(name for found in by_env.values() for name in found):
        cells = []
        for env in MINUTES:
            found = by_env[env].get(name, [])
            cells.append(f"{round(np.mean([row['mean_return'] for row in found])):,}" if found else "")
        print(f"| {label(*name)} | {' | '.join(cells)} |")


def smoothed(row, minutes):
    """The returns of a curve at these minutes, each the mean of a twentieth of the time around it."""
    times, _, returns = np.array(row["curve"]).T
    weights = np.abs(times - minutes[:, None]) <= minutes[-1] / 40
    weights[np.arange(len(minutes)), np.abs(times - minutes[:, None]).argmin(axis=1)] = True
    values = (weights @ returns) / weights.sum(axis=1)
    values[(minutes < times[0]) | (minutes > times[-1])] = np.nan
    return values


def draw():
    """A picture for each environment: the return in training against minutes, a dot where the final policy is."""
    from matplotlib.figure import Figure

    from lemniscate.report.curves import COLORS, finish, save

    colors = {name: COLORS[i] for i, name in enumerate(STEPS)}
    for env in [env for env in MINUTES if measured(env)]:
        figure = Figure(figsize=(7.2, 4.2), layout="constrained")
        axes = figure.subplots()
        longest = max(row["minutes"] for found in measured(env).values() for row in found)
        for (library, algorithm), found in measured(env).items():
            style = {"lemniscate": "-", "sb3": ":", "sbx": "--"}[library]
            grid = np.linspace(0, longest, 200)
            curves = np.stack([smoothed(row, grid) for row in found])
            known = ~np.isnan(curves).all(axis=0)
            look = {"color": colors[algorithm], "linestyle": style, "linewidth": 1.8}
            axes.plot(grid[known], np.nanmean(curves[:, known], axis=0), label=label(library, algorithm), **look)
            end = np.mean([row["minutes"] for row in found])
            axes.plot(end, np.mean([row["mean_return"] for row in found]), "o", color=colors[algorithm], markersize=5)
        axes.set(xlabel="minutes on one core", ylabel="return in training")
        axes.set_title(f"{env}; a dot: the final policy, deterministic", loc="left", fontsize=10)
        axes.set_xlim(0, 1.03 * longest)
        axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
        finish(axes)
        save(figure, RESULTS / f"minutes-{env}.png")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join([*STEPS, *PEERS]))
    parser.add_argument("--envs", nargs="+", choices=MINUTES, default=list(MINUTES))
    parser.add_argument("--seeds", nargs="+", type=int)
    parser.add_argument("--unknown", action="store_true", help="the defaults where there is no preset; two seeds")
    parser.add_argument("--table", action="store_true", help="run nothing")
    parser.add_argument("--one", nargs=5, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        library, algorithm, env, seed, core = given.one
        return one(library, algorithm, env, int(seed), int(core))
    known = DEFAULTS if given.unknown else [*STEPS, *PEERS]
    if wrong := set(given.names) - set(known):
        parser.error(f"there is no {', '.join(sorted(wrong))}; there is {', '.join(known)}")
    runs, none = [], given.table or given.unknown
    if given.unknown:
        chosen = product(given.names or DEFAULTS, UNKNOWN, given.seeds or (1, 2))
        runs += [("lemniscate", *run) for run in chosen]
    for name in [] if none else given.names or STEPS:
        if name in STEPS:
            runs += [("lemniscate", name, env, seed) for env in given.envs for seed in given.seeds or (1,)]
        else:
            envs = [env for env in PEER_ENVS if env in given.envs]
            chosen = [
                (algorithm, env, seed)
                for algorithm in PEERS[name]
                for env in envs
                for seed in given.seeds or PEER_SEEDS
            ]
            runs += [(name, *run) for run in chosen]
    together(runs)
    table()
    unknown()
    draw()


if __name__ == "__main__":
    main()
