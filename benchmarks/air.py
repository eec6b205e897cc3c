"""One policy in every air: the figure eight in crazyflow's four dynamics and in their corners, beside a PD controller.

    .venv/bin/python benchmarks/air.py                         5 seeds of figure-eight-robust, and of first principles
    .venv/bin/python benchmarks/air.py --ways figure-eight --seeds 1 2
    .venv/bin/python benchmarks/air.py --ways "shac: figure-eight-robust" --seeds 1 2
    .venv/bin/python benchmarks/air.py --bounds                what no policy can do
    .venv/bin/python benchmarks/air.py --gains                 a search for the gains of PD, on seeds 101 to 103
    .venv/bin/python benchmarks/air.py --table                 the tables of what has been measured

Every policy, and PD, flies 64 starts that training never saw, in each dynamics: with rotors at rest, as crazyflow does,
and with turning ones. A corner is mass, inertia, motors, a delay of 20 ms and a wind of 0.05 N at once. Each row of
`benchmarks/results/air.jsonl` says how it was made.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
from dataclasses import replace
from itertools import product
from statistics import mean

import torch
from common import append, provenance, rows

ENV, STARTS = "DroneFigureEightTrajectory-v0", 64
DYNAMICS = ("so_rpy", "so_rpy_rotor", "so_rpy_rotor_drag", "first_principles")
CORNERS = {
    f"mass {m:g}, inertia {j:g}, motors {k:g}": {
        "mass": m, "inertia": j, "motor_gain": k, "action_delay": 0.02, "wind": 0.05, "rotors": 1,
    }
    for m, j, k in product((0.85, 1.15), (0.7, 1.3), (0.9, 1.1))
}  # fmt: skip
ALONE = {"history": 5, "rotors": [0.0, 1.0]}
WAYS = {
    "figure-eight": ("figure-eight", {}, {}),
    "figure-eight-robust": ("figure-eight-robust", {}, {}),
    "so_rpy_rotor alone": ("figure-eight", {"dynamics": "so_rpy_rotor", **ALONE}, {"total_steps": 2_000_000}),
    "so_rpy_rotor_drag alone": ("figure-eight", {"dynamics": "so_rpy_rotor_drag", **ALONE}, {"total_steps": 2_000_000}),
    "first principles alone": (
        "figure-eight-robust",
        {"dynamics": "first_principles", "history": 5},
        {"total_steps": 8_000_000},
    ),
    "shac: figure-eight-robust": ("figure-eight-robust", {}, {}),
    "shac: first principles alone": (
        "figure-eight",
        {"dynamics": "first_principles", "privileged": True, **ALONE},
        {
            "num_envs": 64,
            "num_steps": 16,
            "total_steps": 820_000,
            "gamma": 0.95,
            "actor_learning_rate": 5e-3,
            "critic_epochs": 4,
            "checkpoint_every": 250_000,
        },
    ),
}
"""preset, arguments of the environment, other fields; of PPO unless another is named"""


def numbers(scores):
    return {
        "return": scores.mean_return,
        "worst": min(scores.returns),
        "crashes": scores.terminated,
        "mm": scores.measures["rmse_after_1s_mm"],
    }


def one_run(way, seed):
    """Train and fly here; print one JSON object."""
    import lemniscate as lem
    from lemniscate.drones.vehicle import CONDITIONS

    (preset, kwargs, fields), algorithm = WAYS[way], "shac" if way.startswith("shac: ") else "ppo"
    with tempfile.TemporaryDirectory() as folder:
        given = fields | ({"env_kwargs": kwargs} if kwargs else {})
        run = lem.train(algorithm, ENV, preset=preset, seed=seed, run=f"{folder}/run", progress=False, **given)
    nominal = {name: CONDITIONS[name].nominal for name in run.policy.config.env_kwargs if name in CONDITIONS}

    def fly(dynamics, baseline=False, **conditions):
        kwargs = {**nominal, "dynamics": dynamics, **conditions}
        return numbers(lem.evaluate(run.policy, episodes=STARTS, seed=0, env_kwargs=kwargs, baseline=baseline))

    found = {"way": way, "seed": seed, "training_s": run.seconds}
    for dynamics in [kwargs["dynamics"]] if "dynamics" in kwargs else DYNAMICS:
        found[dynamics] = {"rest": fly(dynamics), "turning": fly(dynamics, rotors=1)}
        if seed == 1:
            found[dynamics] |= {"pd rest": fly(dynamics, True), "pd turning": fly(dynamics, True, rotors=1)}
        if way.endswith("figure-eight-robust"):
            found[dynamics]["corners"] = {name: fly(dynamics, **corner) for name, corner in CORNERS.items()}
    print(json.dumps(found))


def bounds():
    """The return and the error after the first second of a drone that is as high as it can be, at full thrust."""
    from lemniscate.envs import registry
    from lemniscate.run.evaluate import EVALUATION
    from lemniscate.run.seeding import derive

    print("| dynamics | conditions | return, at most | error after 1 s, at least |\n|---|---|--:|--:|")
    heavy = {"mass": 1.15, "motor_gain": 0.9, "action_delay": 0.02}
    for dynamics, more in [*((name, {}) for name in DYNAMICS[1:]), (DYNAMICS[-1], heavy)]:
        for rotors in (0, 1):
            env = registry.make(ENV, STARTS, kwargs={"dynamics": dynamics, "rotors": rotors, **more})
            env.restart(derive(0, EVALUATION, 0))
            full, inside = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(STARTS, 4), torch.ones(STARTS, dtype=torch.bool)
            total, squares = torch.zeros(STARTS), torch.zeros(STARTS)
            for t in range(env.spec.max_episode_steps):
                step = env.step(full)
                inside &= ~step.terminated
                missing = torch.where(inside, step.next_obs[:, 15].clamp(min=0), 0.0)  # z of the curve less that
                total += torch.exp(-2 * missing)
                squares += missing**2 * (t >= 50)
            error = 1000 * (squares.mean() / (env.spec.max_episode_steps - 50)).sqrt()
            print(f"| {dynamics} | rotors {rotors}, {more or 'nominal'} | {total.mean():.1f} | {error:.1f} mm |")


def gains(trials):
    """Random search, then steps from the best, by the mean return over three seeds of 64 starts each."""
    from lemniscate.drones.vehicle import GAINS
    from lemniscate.envs import registry
    from lemniscate.run.evaluate import evaluate

    for dynamics in DYNAMICS:
        env, rng = registry.make(ENV, STARTS, kwargs={"dynamics": dynamics}), random.Random(101)
        best = (float("-inf"), GAINS[dynamics])
        for i in range(trials):
            if i < trials // 2:
                tried = [rng.uniform(*ends) for ends in ((4, 40), (2, 14), (4, 60), (2, 20))]
            else:
                tried = [gain * rng.uniform(0.8, 1.25) for gain in best[1]]
            pd = replace(env.baseline, gains=[tried])
            best = max(best, (mean(evaluate(pd, env, STARTS, seed).mean_return for seed in (101, 102, 103)), tried))
        print(dynamics, [round(gain, 1) for gain in best[1]], f"{best[0]:.1f}", flush=True)


def table():
    found = list({(row["way"], row["seed"]): row for row in rows("air")}.values())  # the newest of each
    for way in dict.fromkeys(row["way"] for row in found):
        of = [row for row in found if row["way"] == way]
        print(f"\n{way}: {len(of)} seeds, {mean(row['training_s'] for row in of):.0f} s of training\n")
        print("| dynamics | rotors | return (worst seed) | crashes | error after 1 s (worst seed) | PD |")
        print("|---|---|--:|--:|--:|--:|")
        for dynamics, rotors in product(DYNAMICS, ("rest", "turning")):
            flown = [row[dynamics][rotors] for row in of if dynamics in row]
            if flown:
                returns, errors = [f["return"] for f in flown], [f["mm"] for f in flown]
                flown_by_pd = [row[dynamics] for row in found if f"pd {rotors}" in row.get(dynamics, {})]
                pd = flown_by_pd[-1][f"pd {rotors}"] if flown_by_pd else None
                beside = f"{pd['return']:.0f}, {pd['mm']:.0f} mm" if pd else ""
                crashes = f"{sum(f['crashes'] for f in flown)} of {STARTS * len(flown)}"
                mine = (
                    f"{mean(returns):.1f} ({min(returns):.1f}) | {crashes} | {mean(errors):.1f} mm ({max(errors):.1f})"
                )
                print(f"| `{dynamics}` | {rotors} | {mine} | {beside} |")
        corners = [
            (dynamics, name, flown)
            for row in of
            for dynamics in DYNAMICS
            for name, flown in row.get(dynamics, {}).get("corners", {}).items()
        ]
        for dynamics in dict.fromkeys(d for d, _, _ in corners):
            by = {n: [f for d, name, f in corners if (d, name) == (dynamics, n)] for n in CORNERS}
            worst = min(by, key=lambda name: mean(f["return"] for f in by[name]))
            flown = by[worst]
            crashes = sum(f["crashes"] for f in flown) / (STARTS * len(flown))
            print(f"worst corner of `{dynamics}`: {worst}: {mean(f['return'] for f in flown):.1f}, {crashes:.1%} crash")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ways", nargs="+", default=["figure-eight-robust", "first principles alone"], choices=WAYS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--one-run", action="store_true", help="train one way and seed in this process")
    parser.add_argument("--bounds", action="store_true")
    parser.add_argument("--gains", type=int, nargs="?", const=60, help="number of gains that are tried")
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args()
    if given.one_run:
        return one_run(given.ways[0], given.seeds[0])
    if given.bounds:
        return bounds()
    if given.gains:
        return gains(given.gains)
    stamp = provenance()
    for way, seed in [] if given.table else product(given.ways, given.seeds):
        command = [sys.executable, __file__, "--one-run", "--ways", way, "--seeds", str(seed)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        row = json.loads(done.stdout.splitlines()[-1])
        append("air", row | stamp)
        flown = {name: row[name]["turning"] for name in DYNAMICS if name in row}
        print(way, seed, f"{row['training_s']:.0f} s", flown, flush=True)
    table()


if __name__ == "__main__":
    main()
