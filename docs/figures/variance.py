"""The variance of the policy gradient by the weight of log π: in CartPole-v1, for one frozen policy.

    .venv/bin/python docs/figures/variance.py [FILE]

A policy and a value function are trained for a while and then frozen. Many batches of whole episodes are collected,
and from each the gradient is estimated four times: with the return of the whole episode, with the reward-to-go, with
that minus the mean of the batch, and with that minus V(s). γ is 1, so that all of them estimate the same vector, except
for the small bias of a mean that contains the return from which it is subtracted.
"""

import sys
from pathlib import Path

import torch
from matplotlib.figure import Figure

from lemniscate.algos import reinforce
from lemniscate.data.rollout import collect, collect_episodes
from lemniscate.envs.registry import make
from lemniscate.maths import policy_gradient

WAYS = {
    "return of the whole episode": ("episode", "none"),
    "reward-to-go": ("to_go", "none"),
    "reward-to-go − its mean": ("to_go", "mean"),
    "reward-to-go − V(s)": ("to_go", "value"),
}


def gradients(batches=60, updates=10, num_envs=4):
    """{way: gradients [batches, P]}, from the same episodes."""
    torch.set_num_threads(1)
    config = reinforce.Config(env="CartPole-v1", num_envs=num_envs, total_steps=10**6, gamma=1.0, standardize=False)
    env = make(config.env, num_envs)
    env.restart(1)
    torch.manual_seed(1)
    state = reinforce.init(config.replace(standardize=True), env.spec, torch.device("cpu"))
    for _ in range(updates):
        rollout = collect(env, state.policy, config.num_steps, state.rng.action)
        reinforce.update(config.replace(standardize=True), state, rollout)
    of = {way: [] for way in WAYS}
    for _ in range(batches):
        rollout = collect_episodes(env, state.policy, 1, state.rng.action)
        for way, (returns, baseline) in WAYS.items():
            weighting = config.replace(episodes=1, returns=returns, baseline=baseline)
            batch = reinforce.weights(weighting, state.networks, rollout)[rollout.valid_rows]
            loss = policy_gradient(state.policy(batch.obs).log_prob(batch.action), batch.advantage)
            gradient = torch.autograd.grad(loss, list(state.policy.parameters()))
            of[way].append(torch.cat([part.flatten() for part in gradient]))
    return {way: torch.stack(rows) for way, rows in of.items()}


def draw(**sizes):
    """The variance of the gradient, as a share of the first; and how many episodes make up for it."""
    variances = {way: rows.var(0).sum().item() for way, rows in gradients(**sizes).items()}
    first = next(iter(variances.values()))
    figure = Figure(figsize=(7.5, 2.6), layout="constrained")
    axes = figure.subplots()
    names, shares = list(variances), [variance / first for variance in variances.values()]
    axes.barh(names[::-1], shares[::-1], color=["#3465a4", "#729fcf", "#babdb6", "#babdb6"])
    for i, share in enumerate(shares[::-1]):
        axes.text(share, i, f" {100 * share:.3g} %", va="center", fontsize=9)
    axes.set_xlim(0, 1.1)
    axes.xaxis.set_major_formatter("{x:.0%}")
    axes.set_title("variance of the policy gradient, by the weight of log π", loc="left", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)
    return figure


if __name__ == "__main__":
    draw().savefig(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "images" / "variance.png", dpi=130)
