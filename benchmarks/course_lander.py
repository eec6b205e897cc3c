"""What the two defects of a course's LunarLander notebook cost, at its settings and at bolder ones, in one picture.

    .venv/bin/python benchmarks/course_lander.py        seeds 1 to 3, some twenty minutes

The notebook resets an environment when an episode has ended by its rules, never at the time limit; and it takes the old
log-probabilities again in each epoch, so that the ratio is always 1 and the clip never acts. (Without a time limit the
first episodes are not staggered either.)
"""

import argparse
import json
import tempfile
from itertools import product
from pathlib import Path
from unittest.mock import patch

import numpy as np
from common import RESULTS, append, provenance, rows
from gymnasium.envs.box2d import LunarLander

SETTINGS = {
    "the course's settings": {},
    "γ = 0.99, ten times the learning rate": {"gamma": 0.99, "learning_rate": 1e-3},
}
VARIANTS = ("corrected", "time-outs never reset", "ratio always 1")
COLORS = ("#3465a4", "#cc0000", "#f57900")


class WithoutEnd(LunarLander):
    """The lander without its time limit: what the notebook's loop makes of it."""


def one(settings, variant, seed, steps):
    """Train; fly 100 episodes of the real environment."""
    import lemniscate as lem
    from lemniscate.algos import ppo
    from lemniscate.report.curves import episode_returns
    from lemniscate.run.metrics import read_metrics

    env = "course_lander:WithoutEnd" if variant == VARIANTS[1] else "LunarLander-v3"
    fields = {**vars(lem.config_for("ppo", "LunarLander-v3", "course")), "backend": "gymnasium"}
    fields |= {"env": env, "seed": seed, "total_steps": steps, **SETTINGS[settings]}
    # The rows that are estimated again get their new log-probabilities, in the place of the old ones.
    estimate = ppo.advantages
    again = patch.object(ppo, "advantages", lambda config, networks, rollout, *_: estimate(config, networks, rollout))
    with tempfile.TemporaryDirectory() as folder:
        if variant == VARIANTS[2]:
            again.start()
        try:
            run = lem.train("ppo", run=Path(folder) / "run", progress=False, **fields)
        finally:
            patch.stopall()
        most = max(line.get("clip_fraction", 0) for line in read_metrics(run.path))
        if (most == 0) != (variant == VARIANTS[2]):
            raise SystemExit(f"{variant}: {most} of the ratios are beyond the clip, so it is another variant.")
        at, returns = episode_returns(run.path)
        mode, sample = (lem.evaluate(run.policy, "LunarLander-v3", deterministic=which) for which in (True, False))
    average = np.convolve(returns, np.ones(20) / 20, mode="valid")
    chosen = np.linspace(0, len(average) - 1, min(len(average), 200)).astype(int)
    row = {
        "settings": settings,
        "variant": variant,
        "seed": seed,
        "mean_return": mode.mean_return,
        "mean_return_sampled": sample.mean_return,
        "mean_length": float(np.mean(sample.lengths)),
        "episodes": len(returns),
        "curve": [[round(x) for x in at[19:][chosen]], [round(x, 1) for x in average[chosen]]],
    }
    append("course_lander", row | provenance())
    print(json.dumps({name: value for name, value in row.items() if name != "curve"}), flush=True)


def draw(file):
    """Mean of the last 20 training episodes: a thin line for each seed, a thick one for their mean."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    figure = Figure(figsize=(10, 4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, settings in zip(panels, SETTINGS, strict=True):
        for variant, color in zip(VARIANTS, COLORS, strict=True):
            of = [row for row in rows("course_lander") if (row["settings"], row["variant"]) == (settings, variant)]
            for row in of:
                axes.plot(*row["curve"], color=color, linewidth=0.7, alpha=0.35)
            grid = np.linspace(5_000, 315_000, 150)
            mean = np.mean([np.interp(grid, *row["curve"]) for row in of], axis=0)
            axes.plot(grid, mean, color=color, linewidth=2, label=variant)
        axes.set(xlabel="environment steps", ylim=(-650, 200))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.set_title(settings, loc="left", fontsize=11)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("return, mean of the last 20 episodes")
    panels[0].legend(frameon=False, loc="lower right")
    figure.savefig(file, dpi=130)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--steps", type=int, default=320_000)
    parser.add_argument("--draw", action="store_true", help="run nothing")
    given = parser.parse_args()
    for settings, seed, variant in [] if given.draw else product(given.settings, given.seeds, VARIANTS):
        one(settings, variant, seed, given.steps)
    draw(RESULTS / "course_lander.png")


if __name__ == "__main__":
    main()
