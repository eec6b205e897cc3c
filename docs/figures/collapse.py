"""What a step that is too large does: REINFORCE beside TRPO and PPO in CartPole-v1, three seeds each.

    .venv/bin/python docs/figures/collapse.py [FILE]

Returns of training episodes, and how far each update moved the policy: KL from the old to the new, of PPO as the
minibatches of its epochs saw it on the way.
"""

import sys
import tempfile
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

import lemniscate as lem
from lemniscate.run.loggers import read_metrics

SHARED = {"num_envs": 8, "num_steps": 256, "preset": "default", "compile": "off", "progress": False}
CONSTANT = {"final_learning_rate": 1.0}
WAYS = {
    "REINFORCE, α = 0.003": ("reinforce", {"learning_rate": 0.003, **CONSTANT}),
    "REINFORCE, α = 0.1": ("reinforce", {"learning_rate": 0.1, **CONSTANT}),
    "TRPO, δ = 0.01": ("trpo", {"max_kl": 0.01, "critic_epochs": 10, "scale_rewards": False}),
    "PPO, α = 0.01, target KL 0.02": (
        "ppo",
        {"learning_rate": 0.01, "desired_kl": None, "target_kl": 0.02, **CONSTANT},
    ),
}


def trained(algorithm, fields, seed, steps):
    """The metrics of one run."""
    with tempfile.TemporaryDirectory() as folder:
        run = lem.train(algorithm, "CartPole-v1", run=f"{folder}/run", seed=seed, total_steps=steps, **SHARED, **fields)
        return read_metrics(run.path)


def draw(steps=80_000, seeds=(1, 2, 3)):
    """A column for each way: returns above, KL below."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    panels = figure.subplots(2, len(WAYS), sharex=True, sharey="row")
    for (name, (algorithm, fields)), (above, below) in zip(WAYS.items(), panels.T, strict=True):
        for seed in seeds:
            lines = trained(algorithm, fields, seed, steps)
            color = mpl.colormaps["tab10"](seed - 1)
            ended = [(line["step"], line["episode/return"]) for line in lines if "episode/return" in line]
            moved = [(line["step"], line.get("kl", line.get("approx_kl"))) for line in lines]
            above.plot(*zip(*ended, strict=True), color=color, linewidth=1.3)
            below.plot(*zip(*moved, strict=True), color=color, linewidth=1.0)
        above.set_title(name, loc="left", fontsize=10)
        below.set_yscale("log")
        below.axhline(0.01, color="#888a85", linewidth=0.8, linestyle=":")
        below.set(xlabel="environment steps", ylim=(1e-6, 30))
        below.xaxis.set_major_formatter(mpl.ticker.EngFormatter(sep=""))
        for axes in (above, below):
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(labelsize=8)
    panels[0, 0].set_ylabel("return of an episode")
    panels[1, 0].set_ylabel("KL of an update")
    return figure


if __name__ == "__main__":
    draw().savefig(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "images" / "collapse.png", dpi=130)
