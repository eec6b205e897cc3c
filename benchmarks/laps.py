"""The figure eight faster and faster: the error by lap time, beside crazyflow's Mellinger controller and the PD one.

    .venv/bin/python benchmarks/laps.py                        5 seeds for each lap time
    .venv/bin/python benchmarks/laps.py --laps 10 5 --seeds 1 2
    .venv/bin/python benchmarks/laps.py --table                the table and the picture of what has been measured

The preset `figure-eight`, a million steps long, is trained for each lap time, and flies 64 unseen starts of one lap;
the controllers fly the same starts in the same dynamics. Each row of `benchmarks/results/laps.jsonl` says how it was
made.
"""

import argparse
import os
import tempfile
from statistics import mean

os.environ.setdefault("SCIPY_ARRAY_API", "1")

import numpy as np
from common import RESULTS, append, provenance, rows

ENV, STARTS, HZ = "DroneFigureEightTrajectory-v0", 64, 50
LAPS = (10.0, 8.0, 6.0, 5.0, 4.5)


def arguments(lap):
    """A lap of the curve, from start to end."""
    return {"trajectory_time": lap, "max_episode_time": lap}


def learned(lap, seed):
    """Error after the first second (mm), crashes and seconds of training of a policy, and the same of PD."""
    import lemniscate as lem

    with tempfile.TemporaryDirectory() as folder:
        fields = {
            "preset": "figure-eight",
            "total_steps": 1_000_000,
            "seed": seed,
            "env_kwargs": arguments(lap),
            "progress": False,
        }
        run = lem.train("ppo", ENV, run=f"{folder}/run", **fields)
        scores = [lem.evaluate(run.policy, episodes=STARTS, seed=0, baseline=pd) for pd in (False, True)]
    mine, pd = ({"mm": s.measures["rmse_after_1s_mm"], "crashes": s.terminated} for s in scores)
    return mine | {"seconds": run.seconds}, pd


def mellinger(lap):
    """The same of crazyflow's Mellinger controller at 100 Hz, told position, velocity and acceleration at 50 Hz."""
    from crazyflow.sim import Sim

    from lemniscate.drones.crazyflow import programs
    from lemniscate.envs import registry
    from lemniscate.run.evaluate import EVALUATION
    from lemniscate.run.seeding import derive

    env = registry.make(ENV, STARTS, kwargs=arguments(lap))
    obs = env.restart(derive(0, EVALUATION, 0)).numpy()
    _, (drones,) = programs(ENV, STARTS, "cpu", tuple(sorted(arguments(lap).items())))
    points = np.asarray(drones.env.trajectory, np.float32)
    sim = Sim(n_worlds=STARTS, drone=drones.env.sim.drone, dynamics=drones.dynamics, control="state")
    states = sim.data.states.replace(pos=obs[:, None, 0:3], vel=obs[:, None, 7:10])
    sim.data = sim.data.replace(states=states)
    velocity = np.gradient(points, 1 / HZ, axis=0)
    acceleration, flying, errors = np.gradient(velocity, 1 / HZ, axis=0), np.ones(STARTS, bool), []
    for t, goal in enumerate(points):
        command = np.concatenate([goal, velocity[t], acceleration[t], (0, 0, 0, 1), (0, 0, 0)])
        sim.state_control(np.broadcast_to(command.astype(np.float32), (STARTS, 1, 16)))
        sim.step(sim.freq // HZ)
        pos = np.asarray(sim.data.states.pos)[:, 0]
        flying &= (pos[:, 2] >= 0) & (np.abs(pos) <= 2).all(1)
        errors.append(np.where(flying, np.linalg.norm(pos - goal, axis=1), np.nan))
    late = np.stack(errors[HZ:])
    return {"mm": 1000 * float(np.sqrt(np.nanmean(late**2))), "crashes": int((~flying).sum())}


def table():
    found = rows("laps")
    print("| seconds a lap | PPO, error after 1 s (worst seed) | crashes | Mellinger | PD |")
    print("|--:|--:|--:|--:|--:|")
    for lap in sorted({row["lap"] for row in found}, reverse=True):
        of = [row for row in found if row["lap"] == lap]
        mine = [row["learned"]["mm"] for row in of]
        crashes = sum(row["learned"]["crashes"] for row in of)
        others = " | ".join(f"{of[0][name]['mm']:.0f} mm ({of[0][name]['crashes']})" for name in ("mellinger", "pd"))
        print(f"| {lap:g} | {mean(mine):.1f} mm ({max(mine):.1f}) | {crashes} of {STARTS * len(of)} | {others} |")


def draw():
    """Error by lap time, a line for each controller, and the seeds of ours."""
    from matplotlib.figure import Figure

    found = rows("laps")
    laps = sorted({row["lap"] for row in found})
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axes = figure.subplots()
    for name, label, color in (
        ("learned", "PPO", "#3465a4"),
        ("pd", "PD", "#888a85"),
        ("mellinger", "Mellinger", "#c17d11"),
    ):
        errors = [[row[name]["mm"] for row in found if row["lap"] == lap] for lap in laps]
        axes.plot(laps, [mean(of) for of in errors], color=color, marker="o", markersize=4)
        axes.annotate(label, (laps[-1], mean(errors[-1])), (6, 0), textcoords="offset points", va="center", color=color)
        if name == "learned":
            axes.fill_between(
                laps, [min(of) for of in errors], [max(of) for of in errors], color=color, alpha=0.2, lw=0
            )
    axes.set(yscale="log", xlabel="seconds a lap", xlim=(laps[0] - 0.3, laps[-1] + 1.4))
    axes.set_title("error after the first second, mm", loc="left", fontsize=10)
    axes.set_yticks([1, 3, 10, 30], ["1", "3", "10", "30"])
    axes.minorticks_off()
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(RESULTS / "laps.png", dpi=130)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laps", nargs="+", type=float, default=LAPS, help="seconds")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args()
    stamp = provenance()
    for lap in [] if given.table else given.laps:
        its = mellinger(lap)
        for seed in given.seeds:
            mine, pd = learned(lap, seed)
            append("laps", {"lap": lap, "seed": seed, "learned": mine, "mellinger": its, "pd": pd} | stamp)
            print(lap, seed, mine, its, pd, flush=True)
    table()
    draw()


if __name__ == "__main__":
    main()
