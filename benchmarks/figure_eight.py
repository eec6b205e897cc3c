"""The drone's figures: presets over seeds, each in a process of its own from start to evaluated.

    make bench                                            the presets of docs/results.md, seeds 1 to 5
    .venv/bin/python benchmarks/figure_eight.py --presets figure-eight --seeds 1 2 3
    .venv/bin/python benchmarks/figure_eight.py --algorithm shac --presets figure-eight

Each row of `benchmarks/results/figure_eight.jsonl` says with which commit, versions and machine it was made. Every seed
flies 64 starts that training never saw.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from statistics import mean, median

from common import append, provenance

ENV = "DroneFigureEightTrajectory-v0"


def one_run(algorithm, preset, seed, device):
    """Train and evaluate here; print one JSON object."""
    import lemniscate as lem

    with tempfile.TemporaryDirectory() as folder:
        run = lem.train(algorithm, ENV, preset=preset, seed=seed, device=device, run=f"{folder}/run", progress=False)
        scores = lem.evaluate(run.policy, episodes=64, seed=0)
    print(
        json.dumps(
            {
                "algorithm": algorithm,
                "preset": preset,
                "seed": seed,
                "mean_return": scores.mean_return,
                "min_return": min(scores.returns),
                "crashes": scores.terminated,
                "rmse_mm": scores.measures["rmse_mm"],
                "rmse_after_1s_mm": scores.measures["rmse_after_1s_mm"],
                "training_s": run.seconds,
            }
        )
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["figure-eight", "course"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--algorithm", default="ppo")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--one-run", action="store_true", help="train one preset and seed in this process")
    given = parser.parse_args()
    if given.one_run:
        return one_run(given.algorithm, given.presets[0], given.seeds[0], given.device)
    stamp, rows = provenance(), []
    for preset in given.presets:
        for seed in given.seeds:
            command = [sys.executable, __file__, "--one-run", "--presets", preset, "--seeds", str(seed)]
            started = time.monotonic()
            command += ["--algorithm", given.algorithm, "--device", given.device]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            row = json.loads(done.stdout.splitlines()[-1]) | {"total_s": time.monotonic() - started} | stamp
            append("figure_eight", row)
            rows.append(row)
            print(
                row["preset"], row["seed"], f"{row['mean_return']:.1f}", f"{row['rmse_after_1s_mm']:.2f} mm", flush=True
            )
    print("\n| preset | return of 500, mean (worst seed) | error after 1 s | crashes | training | from start |")
    print("|---|---|---|---|---|---|")
    for preset in given.presets:
        of = [row for row in rows if row["preset"] == preset]
        print(
            f"| `{preset}` | {mean(r['mean_return'] for r in of):.1f} ({min(r['mean_return'] for r in of):.1f}) "
            f"| {mean(r['rmse_after_1s_mm'] for r in of):.2f} mm (worst {max(r['rmse_after_1s_mm'] for r in of):.2f}) "
            f"| {sum(r['crashes'] for r in of)} | {median(r['training_s'] for r in of):.1f} s "
            f"| {median(r['total_s'] for r in of):.1f} s |"
        )


if __name__ == "__main__":
    main()
