"""Return, KL, clip fraction and entropy through training: A2C, TRPO and PPO in CartPole-v1, one seed each.

.venv/bin/python docs/figures/traces.py [FILE]
"""

import sys
import tempfile
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import lemniscate as lem
from lemniscate.run.loggers import read_metrics

SHARED = {"num_envs": 8, "preset": "default", "compile": "off", "progress": False, "seed": 1}
WAYS = {
    "A2C": ("a2c", {"num_steps": 8}),
    "TRPO": ("trpo", {"num_steps": 256, "critic_epochs": 10, "scale_rewards": False}),
    "PPO": ("ppo", {"num_steps": 256, "desired_kl": None, "final_learning_rate": 0.0}),
}
PANELS = {
    "return of an episode": ("episode/return",),
    "KL of an update": ("kl", "approx_kl"),
    "clip fraction": ("clip_fraction",),
    "entropy": ("losses/entropy",),
}


def draw(steps=100_000):
    """A panel for each quantity; of A2C's many short updates the mean of each two thousand steps."""
    figure = Figure(figsize=(12, 2.9), layout="constrained")
    panels = figure.subplots(1, len(PANELS))
    for i, (name, (algorithm, fields)) in enumerate(WAYS.items()):
        with tempfile.TemporaryDirectory() as folder:
            run = lem.train(algorithm, "CartPole-v1", run=f"{folder}/run", total_steps=steps, **SHARED, **fields)
            lines = read_metrics(run.path)
        for axes, (title, keys) in zip(panels, PANELS.items(), strict=True):
            axes.set_title(title, loc="left", fontsize=10)
            rows = [(line["step"] // 2048, line[key]) for line in lines for key in keys if key in line]
            if not rows:
                continue
            at, values = np.array(rows).T
            bins = np.unique(at)
            axes.plot(
                bins * 2048,
                [values[at == b].mean() for b in bins],
                color=mpl.colormaps["tab10"](i),
                linewidth=1.5,
                label=name,
            )
    for axes in panels:
        axes.xaxis.set_major_formatter(mpl.ticker.EngFormatter(sep=""))
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.set_xlabel("environment steps", fontsize=9)
    panels[0].legend(frameon=False)
    return figure


if __name__ == "__main__":
    draw().savefig(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "images" / "traces.png", dpi=130)
