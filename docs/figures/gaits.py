"""The two gaits that HalfCheetah finds, three moments of each: REPPO from a narrow and from a wide first policy.

.venv/bin/python docs/figures/gaits.py [FILE]
"""

import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import gymnasium as gym
import matplotlib as mpl
from matplotlib.figure import Figure

import lemniscate as lem

STARTS = {"initial_log_std −1, the default": -1.0, "initial_log_std −0.5": -0.5}
MOMENTS = (400, 402, 404)
"""steps of the episode"""


def stills(policy):
    """Pictures [H, W, 3] uint8 of an episode, and its mean pitch in radians."""
    env, seen, pitch = gym.make("HalfCheetah-v5", render_mode="rgb_array", width=480, height=320), [], 0.0
    obs, _ = env.reset(seed=0)
    for step in range(1, MOMENTS[-1] + 1):
        obs, *_ = env.step(policy.act(obs))
        pitch += obs[1] / MOMENTS[-1]
        if step in MOMENTS:
            seen.append(env.render()[60:200])
    env.close()
    return seen, pitch


def draw(steps=330_000):
    """A row of pictures for each start."""
    figure = Figure(figsize=(9.6, 2.9), layout="constrained")
    panels = figure.subplots(len(STARTS), len(MOMENTS))
    for (name, log_std), row in zip(STARTS.items(), panels, strict=True):
        with tempfile.TemporaryDirectory() as folder:
            enough = [lambda step, _metrics, _policy: step >= steps]
            given = {"seed": 102, "total_steps": 6_600_000, "initial_log_std": log_std}
            run = lem.train("reppo", "HalfCheetah-v5", run=f"{folder}/run", callbacks=enough, progress=False, **given)
        pictures, pitch = stills(run.policy)
        row[0].set_title(f"{name}: mean pitch {pitch:.2f} rad", loc="left", fontsize=10)
        for axes, picture in zip(row, pictures, strict=True):
            axes.imshow(picture)
            axes.set_axis_off()
    return figure


if __name__ == "__main__":
    mpl.rcParams.update({"font.size": 9})
    draw().savefig(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "images" / "gaits.png", dpi=110)
