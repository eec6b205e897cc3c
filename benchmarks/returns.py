"""Final returns of the presets over seeds: mean, std and IQM of the last policy, deterministic, in Gymnasium itself.

    .venv/bin/python benchmarks/returns.py ppo                       every environment of docs/results.md, every seed
    .venv/bin/python benchmarks/returns.py ppo --envs Hopper-v5 --seeds 1 2
    .venv/bin/python benchmarks/returns.py reppo --envs HalfCheetah-v5 --steps 3_800_000 --threads 2
    .venv/bin/python benchmarks/returns.py ddpg --runs DIR           keep the runs there, and go on with unfinished ones
    .venv/bin/python benchmarks/returns.py ppo trpo --table          the table of what has been run, and the pictures
    .venv/bin/python benchmarks/returns.py minutes                   which algorithm after 1, 3, 10 and 30 minutes

Each row of `benchmarks/results/returns.jsonl` is one policy: 100 episodes from starts that training never saw; the
drone's in crazyflow. Where RUNS has several numbers of steps, one run serves all: nothing in those presets depends on
how long the run is to be, but for its checkpoints, at which environments restart. Where a learning rate falls, a run
of another length is another run: `--steps`.
"""

import argparse
import json
import os
import tempfile
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from textwrap import fill

import numpy as np
from common import RESULTS, append, provenance, rows

MILLION = 1_000_000
DRONE, BREAKOUT = "DroneFigureEightTrajectory-v0", "MinAtar/Breakout-v1"
RUNS = {
    # algorithm: environment: (numbers of steps, seeds)
    "ppo": {
        "CartPole-v1": ((50_000,), 10),
        "LunarLander-v3": ((MILLION,), 10),
        "HalfCheetah-v5": ((MILLION, 3 * MILLION), 10),
        "Hopper-v5": ((MILLION,), 10),
        "Walker2d-v5": ((MILLION,), 10),
        "Ant-v5": ((MILLION, 3 * MILLION), 5),
        "Humanoid-v5": ((MILLION, 3 * MILLION, 7_500_000), 3),
    },
    "reinforce": {"CartPole-v1": ((200_000,), 10), "InvertedPendulum-v5": ((500_000,), 10)},
    "a2c": {"HalfCheetah-v5": ((MILLION,), 10), DRONE: ((MILLION,), 10)},
    "trpo": {
        "HalfCheetah-v5": ((MILLION,), 10),
        "Hopper-v5": ((1_200_000, 2 * MILLION), 10),
        "Walker2d-v5": ((1_200_000, 3 * MILLION), 10),
        "Swimmer-v5": ((MILLION,), 10),
        DRONE: ((MILLION,), 10),
    },
    "reppo": {
        "HalfCheetah-v5": ((6_600_000,), 5),
        "Hopper-v5": ((MILLION,), 10),
        "Walker2d-v5": ((MILLION,), 10),
        "Ant-v5": ((4_500_000,), 5),
    },
    "pqn": {
        "CartPole-v1": ((200_000,), 10),
        "Acrobot-v1": ((400_000,), 10),
        "LunarLander-v3": ((400_000,), 10),
        BREAKOUT: ((2 * MILLION,), 10),
    },
    "ddpg": {
        "MountainCarContinuous-v0": ((30_000,), 10),
        "Pendulum-v1": ((20_000,), 10),
        "HalfCheetah-v5": ((MILLION,), 2),
        "Hopper-v5": ((MILLION,), 3),
    },
    "td3": {
        "Pendulum-v1": ((20_000,), 10),
        "HalfCheetah-v5": ((300_000,), 2),
    },
    "sac": {
        "Pendulum-v1": ((20_000,), 10),
        "LunarLanderContinuous-v3": ((300_000,), 5),
        "HalfCheetah-v5": ((300_000,), 2),
    },
}

PRESETS = {("sac", "HalfCheetah-v5"): "half-cheetah-large"}
"""where it is not the preset that the environment gets"""


def one(algorithm, env, seed, marks, runs, threads=1):
    """Train once, or to the end; evaluate at each mark."""
    import lemniscate as lem

    with tempfile.TemporaryDirectory() if runs is None else nullcontext(runs) as folder:
        path = Path(folder) / f"{algorithm}-{Path(env).name}-{marks[-1]}-{seed}"
        fields = {"total_steps": marks[-1], "keep_checkpoints": 50, "threads": threads}
        if any(mark % -(-marks[-1] // 5) for mark in marks):  # not at a fifth of the run, where checkpoints lie
            fields["checkpoint_every"] = 250_000
        if path.exists():
            run = lem.resume(path, progress=False)
        else:
            preset = PRESETS.get((algorithm, env))
            run = lem.train(algorithm, env, preset=preset, seed=seed, run=path, progress=False, **fields)
        lines = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
        paces = [(line["step"], line["time/steps_per_second"]) for line in lines if "time/steps_per_second" in line]
        curve = [(line["step"], round(line["episode/return"], 1)) for line in lines if "episode/return" in line]
        spent = sum((b - a) / pace for (a, _), (b, pace) in pairwise([(0, 0), *paces]))
        points = curve[:: max(1, len(curve) // 60)]
        checkpoints = sorted((run.path / "checkpoints").glob("step-*"), key=lambda path: int(path.name[5:]))
        for mark in marks:
            found = next(path for path in checkpoints if int(path.name[5:]) >= mark)
            if int(found.name[5:]) > 1.05 * mark:
                raise SystemExit(f"{run.path}: the first checkpoint from step {mark:,} on is {found.name}.")
            policy = lem.load(found)
            backend = None if env in (DRONE, BREAKOUT) else "gymnasium"
            scores = lem.evaluate(policy, episodes=100, seed=0, backend=backend)
            row = {
                "algorithm": algorithm,
                "env": env,
                "steps": mark,
                "seed": seed,
                "threads": threads,
                "mean_return": scores.mean_return,
                "std_return": scores.std_return,
                "mean_length": sum(scores.lengths) / scores.episodes,
                "training_s": spent * policy.step / paces[-1][0],
                "curve": [point for point in points if point[0] <= mark],
            }
            append("returns", row | provenance())
            print(f"{env} {mark:,} seed {seed}: {scores.mean_return:.1f} ± {scores.std_return:.1f}", flush=True)


def measured(algorithm, env, steps):
    return [row for row in rows("returns") if (row["algorithm"], row["env"], row["steps"]) == (algorithm, env, steps)]


def summary(algorithm):
    """The rows of docs/results.md of what has been run."""
    from lemniscate.report.seeds import interval, iqm

    for env in RUNS[algorithm]:
        found = [row["steps"] for row in rows("returns") if (row["algorithm"], row["env"]) == (algorithm, env)]
        for mark in sorted(set(found)):
            of = measured(algorithm, env, mark)
            means = [row["mean_return"] for row in of]
            low, high = interval(iqm, means)
            seconds = np.median([row["training_s"] for row in of])
            digits = 1 if abs(np.mean(means)) < 200 else 0
            numbers = (np.mean(means), np.std(means), iqm(means), low, high, min(means))
            mean, std, middle, low, high, worst = (f"{x:,.{digits}f}" for x in numbers)
            name = f"{algorithm.upper()} | {env} | {mark:,}"
            spread = f"{mean} ± {std} | {middle} [{low}, {high}] | {worst}" if len(means) > 1 else f"{mean} | | {worst}"
            print(f"| {name} | {spread} | {len(means)} | {seconds / 60:.1f} min |")


def smoothed(curve, grid):
    """The returns of a stored curve at the steps of `grid`, averaged over a tenth of the run around each."""
    steps, returns = np.array(curve).T
    width = grid[-1] / 20
    weights = np.abs(steps - grid[:, None]) <= width
    weights[np.arange(len(grid)), np.abs(steps - grid[:, None]).argmin(axis=1)] = True
    return (weights @ returns) / weights.sum(axis=1)


def draw(algorithm):
    """Training returns, a panel for each environment: the mean of the seeds, a band from the lowest to the highest."""
    from matplotlib.figure import Figure

    from lemniscate.report.curves import COLORS, finish, save

    lines = {env: measured(algorithm, env, marks[-1]) for env, (marks, _) in RUNS[algorithm].items()}
    shown = [env for env in lines if lines[env]]
    if not shown:
        return
    columns = min(3, len(shown))
    height = -(-len(shown) // columns)
    figure = Figure(figsize=(3.6 * columns, 2.8 * height + 0.4), layout="constrained")
    panels = figure.subplots(height, columns, squeeze=False).flatten()
    for env, axes in zip(shown, panels, strict=False):
        unit, word = (1e6, "million ") if RUNS[algorithm][env][0][-1] >= MILLION else (1, "")
        grid = np.linspace(0, min(row["curve"][-1][0] for row in lines[env]), 100)
        curves = np.stack([smoothed(row["curve"], grid) for row in lines[env]])
        axes.fill_between(grid / unit, curves.min(axis=0), curves.max(axis=0), color=COLORS[0], alpha=0.2, linewidth=0)
        axes.plot(grid / unit, curves.mean(axis=0), color=COLORS[0], linewidth=1.8)
        axes.set_title(f"{env}, {len(curves)} seed{'s' * (len(curves) > 1)}", loc="left", fontsize=10)
        axes.set(xlabel=f"{word}environment steps", ylabel="return in training")
        finish(axes)
    for axes in panels[len(shown) :]:
        axes.set_visible(False)
    title = f"{algorithm.upper()}: mean over seeds, band from lowest to highest; averaged over a tenth of the run"
    figure.suptitle(fill(title, 46 * columns), x=0.01, ha="left", fontsize=10)
    save(figure, RESULTS / f"returns-{algorithm}.png")


ROBOTS = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5")


def by_minutes():
    """The algorithms on each robot by the minutes that training took: a picture, and the best after so many."""
    from matplotlib.figure import Figure

    from lemniscate.report.curves import COLORS, finish, save

    colors = dict(zip(("reppo", "ppo", "trpo", "sac", "td3", "ddpg", "a2c"), COLORS * 2, strict=False))
    figure = Figure(figsize=(3.2 * len(ROBOTS), 3.6), layout="constrained")
    for env, axes in zip(ROBOTS, figure.subplots(1, len(ROBOTS)), strict=True):
        found = {(row["algorithm"], row["steps"]) for row in rows("returns") if row["env"] == env}
        points = list[tuple[str, float, float, float, int]]()
        for algorithm, steps in sorted(found):
            of = measured(algorithm, env, steps)
            returns, minutes = ([row[name] for row in of] for name in ("mean_return", "training_s"))
            points.append((algorithm, min(minutes) / 60, np.mean(returns), min(returns), len(of)))  # others had company
        for algorithm, color in colors.items():
            mine = sorted(point[1:4] for point in points if point[0] == algorithm)
            if not mine:
                continue
            minutes, means, worst = np.array(mine).T
            axes.plot(minutes, means, "o-", color=color, linewidth=1.4, label=algorithm.upper())
            axes.vlines(minutes, worst, means, color=color, linewidth=1, alpha=0.6)
        axes.set_title(env, loc="left", fontsize=10)
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False, fontsize=8, loc="lower right")
        finish(axes)
        axes.set(xscale="log", xlim=(0.6, 120), xlabel="minutes of training, the fastest seed")
        axes.set_xticks((1, 3, 10, 30, 100), ("1", "3", "10", "30", "100"))
        axes.minorticks_off()
        cells = []
        for most in (1, 3, 10, 30):
            inside = [point for point in points if point[1] <= most]
            algorithm, _, mean, low, seeds = max(inside, key=lambda point: point[2], default=("", 0, 0, 0, 0))
            cells.append(f"{algorithm.upper()} {mean:,.0f} ({low:,.0f}, {seeds})" if seeds else "")
        print(f"| {env} | {' | '.join(cells)} |")
    save(figure, RESULTS / "returns-minutes.png")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithms", nargs="+", choices=[*RUNS, "minutes"])
    parser.add_argument("--envs", nargs="+")
    parser.add_argument("--seeds", nargs="+", type=int)
    parser.add_argument("--steps", nargs="+", type=int, help="instead of those of RUNS")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--runs", type=Path)
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args()
    os.environ.setdefault("GOMP_SPINCOUNT", "20000")  # as `lemniscate train` has threads wait; before torch is imported
    if given.algorithms == ["minutes"]:
        by_minutes()
        return
    for algorithm in () if given.table else given.algorithms:
        for env in given.envs or RUNS[algorithm]:
            marks, seeds = RUNS[algorithm][env]
            for seed in given.seeds or range(1, seeds + 1):
                one(algorithm, env, seed, given.steps or marks, given.runs, given.threads)
    print("| algorithm | environment | steps | mean ± std over seeds | IQM [95 %] | worst seed | seeds | training |")
    print("|---|---|---|---|---|---|---|---|")
    for algorithm in given.algorithms:
        summary(algorithm)
        draw(algorithm)


if __name__ == "__main__":
    main()
