"""What λ does to an advantage, on a walk whose values are known.

    .venv/bin/python docs/figures/gae_lambda.py [FILE]

The walk starts in the middle of 0 … 10, goes left or right with equal chance, with reward 1 where it leaves at 10 and
0 where it leaves at 0: V(s) = s / 10 at γ = 1. The critic has learned half of that.
"""

import sys
from pathlib import Path

import torch
from matplotlib.figure import Figure

from lemniscate.maths import gae

END, STEPS = 10, 1000
LAMBDAS = torch.cat([torch.linspace(0, 0.9, 19), torch.linspace(0.91, 1, 10)])
COLORS = {0.0: "#3465a4", 0.9: "#4e9a06", 1.0: "#cc0000"}


def walk(walks):
    """Positions before and after each step, rewards, ends, and which rows are of the walk, all [T, N]."""
    generator = torch.Generator().manual_seed(1)
    moves = 2 * torch.randint(2, (STEPS, walks), generator=generator) - 1
    after = END // 2 + moves.cumsum(0)
    outside = (after <= 0) | (after >= END)
    times_outside = outside.cumsum(0)
    ended = outside & (times_outside == 1)
    valid = ended | (times_outside == 0)
    columns = (after - moves, after, (ended & (after == END)).double(), ended, valid)
    return tuple(column[: valid.sum(0).max()] for column in columns)


def critic(position):
    """Half of what there is to learn: between the constant ½ and the truth."""
    return 0.25 + 0.5 * position.double() / END


def errors(lam, rollout, valid, pair, q):
    """Root mean squares over pairs of state and action: (bias, standard deviation) of the estimate A + V of Q."""
    reward, value, next_value, ended = rollout
    advantage, _ = gae(reward, value, next_value, ended, ended, gamma=1.0, lam=lam)
    error = (advantage + value - q)[valid]
    count = torch.bincount(pair)
    mean = torch.bincount(pair, error) / count.clamp(min=1)
    variance = torch.bincount(pair, (error - mean[pair]).square()) / count.clamp(min=1)
    weights = count / count.sum()
    return (weights * mean.square()).sum().sqrt(), (weights * variance).sum().sqrt()


def draw(walks=20_000):
    """One walk at three λ; the error over many walks at every λ."""
    before, after, reward, ended, valid = walk(walks)
    rollout = (reward, critic(before), critic(after), ended)
    figure = Figure(figsize=(10, 4), layout="constrained")
    one, many = figure.subplots(1, 2)

    lengths = valid.sum(0)
    chosen = int(torch.nonzero((lengths == 31) & reward.any(0))[0, 0])
    rows = slice(0, 31)
    for lam, color in COLORS.items():
        advantage, _ = gae(*rollout[:3], ended, ended, gamma=1.0, lam=lam)
        one.plot(advantage[rows, chosen], color=color, linewidth=1.5, label=f"gae, λ = {lam:g}")
    value, next_value = (rollout[i][rows, chosen] for i in (1, 2))
    td_error = reward[rows, chosen] + next_value * ~ended[rows, chosen] - value
    to_come = reward[rows, chosen].flip(0).cumsum(0).flip(0)
    one.plot(td_error, "o", color=COLORS[0.0], markersize=4, label="r + V(s′) − V(s)")
    one.plot(to_come - value, "o", color=COLORS[1.0], markersize=4, label="return to come − V(s)")
    one.axhline(0, color="#babdb6", linewidth=0.8, zorder=0)
    one.set(xlabel="step of the walk", ylabel="advantage")
    one.set_title("One walk that ends at 10", loc="left")
    one.legend(frameon=False, fontsize=8)

    pair = (2 * before + (after > before))[valid]
    q = after.double() / END  # Q(s, a) = V(s ± 1), and 1 or 0 at the ends: which are after / END too
    bias, std = torch.tensor([errors(float(lam), rollout, valid, pair, q) for lam in LAMBDAS]).T
    many.plot(LAMBDAS, bias, color="#3465a4", label="bias, from the critic")
    many.plot(LAMBDAS, std, color="#cc0000", label="standard deviation, from chance")
    total = (bias.square() + std.square()).sqrt()
    many.plot(LAMBDAS, total, color="black", label="both")
    best = int(total.argmin())
    many.plot(LAMBDAS[best], total[best], "o", color="black")
    many.annotate(
        f"λ = {LAMBDAS[best]:.2f}", (LAMBDAS[best], total[best]), (0, 8), textcoords="offset points", ha="center"
    )
    many.set(xlabel="λ", ylabel="error of the estimate", ylim=(0, None))
    many.set_title(f"{walks:,} walks", loc="left")
    many.legend(frameon=False, fontsize=8)
    for axes in (one, many):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    draw().savefig(
        sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "images" / "gae_lambda.png", dpi=130
    )
