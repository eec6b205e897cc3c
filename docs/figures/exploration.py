"""States that a car visits under action noise alone, by the colour of the noise: docs/images/exploration.png.

    .venv/bin/python docs/figures/exploration.py

MountainCarContinuous-v0 under noise alone, of the same standard deviation at every step; nothing is learned.
"""

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from lemniscate.data.replay import ActionNoise
from lemniscate.envs import registry

IMAGE = Path(__file__).parents[1] / "images" / "exploration.png"
NOISES = {
    "white": ("white", {}),
    "Ornstein–Uhlenbeck": ("ou", {"time": 1 / 0.15}),
    "pink": ("coloured", {"exponent": 1.0}),
}
CARS, STEPS, STD = 64, 999, 0.6


def drive(kind, time=1.0, exponent=0.0):
    """([T, N, 2] positions and velocities, which of N cars reached the flag) in one episode each."""
    env = registry.make("MountainCarContinuous-v0", CARS)
    env.restart(0)
    noise = ActionNoise(kind, (CARS, 1), STEPS, torch.device("cpu"), time=time, exponent=exponent)
    generator = torch.Generator().manual_seed(0)
    visited, arrived = [], torch.zeros(CARS, dtype=torch.bool)
    for _ in range(STEPS):
        step = env.step((STD * noise(generator)).clamp(-1, 1))
        visited.append(torch.where(arrived[:, None], torch.nan, step.next_obs))
        arrived |= step.terminated
    env.close()
    return torch.stack(visited).numpy(), arrived


def draw():
    """One panel for each noise: all states that were visited, and how many cars arrived."""
    figure = Figure(figsize=(10, 3.3), layout="constrained")
    for axes, (name, (kind, settings)) in zip(figure.subplots(1, 3, sharey=True), NOISES.items(), strict=True):
        states, arrived = drive(kind, **settings)
        position, velocity = states.reshape(-1, 2).T
        known = ~np.isnan(position)
        axes.hexbin(
            position[known], velocity[known], gridsize=60, bins="log", cmap="Blues", extent=(-1.2, 0.6, -0.07, 0.07)
        )
        axes.axvline(0.45, color="#cc0000", linewidth=1)
        axes.set_title(f"{name}: {int(arrived.sum())} of {CARS} arrive", loc="left", fontsize=10)
        axes.set_xlabel("position; the flag is at the red line")
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("velocity")
    return figure


if __name__ == "__main__":
    IMAGE.parent.mkdir(exist_ok=True)
    draw().savefig(IMAGE, dpi=130)
