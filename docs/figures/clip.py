"""The clipped objective against the ratio, and where its gradient stops.

.venv/bin/python docs/figures/clip.py [FILE]
"""

import sys
from pathlib import Path

import torch
from matplotlib.figure import Figure

from lemniscate.maths import clipped_surrogate, surrogate

CLIP = 0.2


def objectives(advantage):
    """(ratios, r A, L^CLIP, the gradient of L^CLIP in r) for one action of this advantage."""
    ratio = torch.linspace(0.4, 1.6, 241, dtype=torch.float64)
    log_ratio, of = ratio.log()[:, None].requires_grad_(), torch.full((1,), advantage, dtype=torch.float64)
    clipped = -torch.stack([clipped_surrogate(row, of, CLIP) for row in log_ratio])
    plain = -torch.stack([surrogate(row, of) for row in log_ratio])
    (slope,) = torch.autograd.grad(clipped.sum(), log_ratio)
    return ratio, plain.detach(), clipped.detach(), slope[:, 0] / ratio


def draw():
    """A good action and a bad one."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axes, advantage in zip(figure.subplots(1, 2), (1.0, -1.0), strict=True):
        ratio, plain, clipped, slope = objectives(advantage)
        axes.plot(ratio, plain, color="#babdb6", linewidth=2.5, label="r A")
        axes.plot(ratio, clipped, color="#3465a4", linewidth=1.8, label="L^CLIP")
        axes.fill_between(
            ratio, 0, 1, where=slope == 0, transform=axes.get_xaxis_transform(), color="#fce94f", alpha=0.35, lw=0
        )
        axes.text(
            1 + advantage * 0.4, 0.5, "no gradient", transform=axes.get_xaxis_transform(), ha="center", fontsize=9
        )
        axes.plot(1, advantage, "o", color="black", markersize=5)
        for edge in (1 - CLIP, 1 + CLIP):
            axes.axvline(edge, color="#888a85", linewidth=0.8, linestyle=":")
        axes.set_xticks([0.5, 1 - CLIP, 1, 1 + CLIP, 1.5], ["0.5", "1 − ε", "1", "1 + ε", "1.5"])
        axes.set(xlabel="ratio r = π(a|s) / π_old(a|s)", ylabel="objective")
        axes.set_title("a good action, A = 1" if advantage > 0 else "a bad action, A = −1", loc="left", fontsize=11)
        axes.legend(frameon=False, loc="upper left" if advantage > 0 else "upper right")
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    draw().savefig(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "images" / "clip.png", dpi=130)
