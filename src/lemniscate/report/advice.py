"""Advice on a run: sentences derived from its metrics, each by a rule with a threshold and its source.

A rule is a function of the `Evidence` that returns a sentence, or None where it has nothing to say. The rules see
numbers alone: they say what was measured and what usually helps, not what is wrong.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lemniscate.report.curves import moving_average, window_of
from lemniscate.run.fields import flag

SMALLER_STEPS = (("lower", "learning_rate"), ("lower", "actor_learning_rate"), ("lower", "max_kl"))
"""cures of a policy that changes too fast, by the field that its algorithm has"""

ONE_SEED = "One seed says nothing about another setting or algorithm: train several with --seeds 1-5."


@dataclass(frozen=True)
class Evidence:
    """The input of the rules: the fields of a run's Config, its metrics, and the scores of its final evaluation."""

    config: Mapping[str, Any]
    log: Sequence[Mapping[str, Any]]
    scores: Mapping[str, Any]

    @cached_property
    def returns(self) -> np.ndarray:
        """The return of every whole training episode, in order: [episodes]."""
        return np.array([ret for line in self.log for ret in line.get("episode/returns", [])], dtype=np.float64)

    def values(self, name: str) -> np.ndarray:
        """A metric of every line that has it, in order."""
        return np.array([line[name] for line in self.log if name in line], dtype=np.float64)

    def late(self, name: str) -> float | None:
        """The median of a metric in the last half of the lines that have it; None if none has."""
        values = self.values(name)
        return float(np.median(values[len(values) // 2 :])) if len(values) else None

    def advise(self, said: str, *cures: tuple[str, str]) -> str:
        """A sentence on what was measured, and the cures whose field the run's Config has: (what to do, the field)."""
        there = [f"{what} {flag(field)}" for what, field in cures if field in self.config]
        return f"{said}: {' or '.join(there)}." if there else f"{said}."


def sentences(evidence: Evidence) -> list[str]:
    """The sentences of all rules that apply."""
    return [said for rule in RULES if (said := rule(evidence))]


def kl_above_target(evidence: Evidence) -> str | None:
    """The KL divergence of the late updates is more than twice its target, or without one above 0.1.

    Schulman et al. 2017, section 4, calls 1.5 times the target too much; 0.1 is three times the end of the usual range
    in `docs/notes/ppo.md`: many good runs are a little above it.
    """
    kl = evidence.late("approx_kl")
    target = next(filter(None, map(evidence.config.get, ("target_kl", "desired_kl", "max_kl"))), None)
    if kl is None or kl <= (2 * target if target else 0.1):
        return None
    beside = f"{kl / target:.0f} times its target of {target:g}" if target else "and 0.003 to 0.03 is usual"
    said = f"The KL divergence of the late updates is {kl:.2g}, {beside}"
    return evidence.advise(said, *SMALLER_STEPS, ("take fewer", "epochs"))


def ratios_clipped(evidence: Evidence) -> str | None:
    """More than 40 % of the late ratios are clipped: above the healthy range of `docs/notes/ppo.md`."""
    share = evidence.late("clip_fraction")
    if share is None or share <= 0.4:
        return None
    said = f"{share:.0%} of the late probability ratios are clipped"
    return evidence.advise(said, *SMALLER_STEPS, ("take fewer", "epochs"))


def value_explains_nothing(evidence: Evidence) -> str | None:
    """The value explains less than a tenth of its targets' variance: no better than a constant, `docs/notes/ppo.md`.

    Where the late episodes all have nearly one return, to 2 % of its size, there is nothing to explain.
    """
    explained, late = evidence.late("explained_variance"), evidence.returns[len(evidence.returns) // 2 :]
    if explained is None or explained >= 0.1 or (len(late) and late.std() <= 0.02 * abs(late.mean())):
        return None
    said = f"The value explains {max(0.0, explained):.0%} of the variance of its targets, no more than a constant would"
    cures = ("take more", "epochs"), ("take more", "critic_epochs"), ("lower", "gae_lambda")
    return f"{evidence.advise(said, *cures)} Or the observations do not hold what decides the return."


def exploration_collapsed(evidence: Evidence) -> str | None:
    """By a quarter of the run the policy has lost nine tenths of its entropy, or of its standard deviation.

    "Collapsed early" in `docs/notes/ppo.md`; that a tenth is little and a quarter early is our choice. Not for SAC,
    which chooses its entropy itself.
    """
    std, entropy = evidence.values("policy_std"), evidence.values("losses/entropy")
    spread, name = (std, "standard deviation") if len(std) else (entropy, "entropy")
    if len(spread) < 8 or "initial_temperature" in evidence.config or spread[0] <= 0:
        return None
    left = spread[len(spread) // 4] / spread[0]
    if left >= 0.1:
        return None
    said = f"After a quarter of the run the policy's {name} is {max(0.0, left):.0%} of what it was at first"
    cures = (("raise", "entropy_coef"),) if "entropy_coef" in evidence.config else SMALLER_STEPS
    return evidence.advise(said, *cures)


def gradient_clipped(evidence: Evidence) -> str | None:
    """The late gradient is more than ten times `max_grad_norm`, "always far above" in `docs/notes/ppo.md`."""
    norm, limit = evidence.late("gradient_norm"), evidence.config.get("max_grad_norm")
    if norm is None or not limit or norm <= 10 * limit or "value_coef" not in evidence.config:
        return None
    cure = ("lower", "value_coef") if evidence.config.get("scale_rewards", True) else ("add", "scale_rewards")
    share = f"1/{norm / limit:.0f}"
    return evidence.advise(
        f"The gradient is clipped to {share} of its norm, usually because the value's loss is large", cure
    )


def q_biased(evidence: Evidence) -> str | None:
    """Q differs from the discounted return that followed by more than half of it; the threshold is our choice.

    Why Q over-estimates, and that the lesser of two critics does not: Fujimoto et al. 2018, section 4.
    """
    bias = (evidence.scores.get("q_bias") or {}).get("bias")
    if bias is None or abs(bias) <= 0.5:
        return None
    if bias < 0:
        said, longer = f"Q under-estimates the return by {-bias:.0%}", ("train longer with", "total_steps")
        return evidence.advise(said, longer, ("raise", "critic_learning_rate"))
    said = evidence.advise(f"Q over-estimates the return by {bias:.0%}", ("lower", "critic_learning_rate"))
    two_critics = {"target_noise", "initial_temperature"} & set(evidence.config)
    return said if two_critics else f"{said} Or try td3 or sac, which believe the lesser of two critics."


def still_rising(evidence: Evidence) -> str | None:
    """The last fifth of the episodes is better than the fifth before: by three standard errors and 5 % of all progress.

    Three standard errors, and ten episodes in each fifth at least, because neighbouring episodes are alike; our choice.
    """
    fifth = len(evidence.returns) // 5
    if fifth < 10:
        return None
    before, last = evidence.returns[-2 * fifth : -fifth], evidence.returns[-fifth:]
    averages = moving_average(evidence.returns, window_of(evidence.returns))
    gain, error = last.mean() - before.mean(), np.hypot(last.std(), before.std()) / np.sqrt(fifth)
    if gain <= 3 * error or gain <= 0.05 * np.ptp(averages):
        return None
    steps = 2 * evidence.config.get("total_steps", 0)
    return (
        f"Returns were still rising at the end, from {before.mean():,.4g} to {last.mean():,.4g} in the last two fifths:"
        f" train longer, such as --total-steps {steps:_}."
    )


def fell_back(evidence: Evidence) -> str | None:
    """The last moving average is lower than the best by a fifth of all progress, and by three standard errors.

    Both thresholds are our choice.
    """
    returns = evidence.returns
    window = window_of(returns)
    if len(returns) < 3 * window:
        return None
    averages = moving_average(returns, window)[window - 1 :]
    fall, error = averages.max() - averages[-1], returns[-window:].std() / np.sqrt(window)
    if fall <= 3 * error or fall <= 0.2 * np.ptp(averages):
        return None
    said = f"Returns fell from {averages.max():,.4g} to {averages[-1]:,.4g} before the end"
    return f"{evidence.advise(said, *SMALLER_STEPS)} With --keep-checkpoints more of the earlier policies are kept."


def no_episode(evidence: Evidence) -> str | None:
    """No whole episode has ended: there is no return to judge by."""
    if not evidence.log or len(evidence.returns):
        return None
    return "No whole episode ended in training: take more --total-steps, or fewer parallel environments (--num-envs)."


def seeds_differ(finals: Sequence[float]) -> str | None:
    """The standard deviation of the final returns over seeds is more than a fifth of their mean; our choice."""
    if len(finals) < 2 or np.std(finals) <= 0.2 * abs(np.mean(finals)):
        return None
    return (
        f"The final returns of its seeds lie from {min(finals):,.4g} to {max(finals):,.4g}:"
        " train more seeds before believing a difference."
    )


RULES: tuple[Callable[[Evidence], str | None], ...] = (
    no_episode,
    still_rising,
    fell_back,
    kl_above_target,
    ratios_clipped,
    value_explains_nothing,
    exploration_collapsed,
    gradient_clipped,
    q_biased,
)
