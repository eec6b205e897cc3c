"""What can be wrong with a run: faults, each with what shows it and what that means.

The functions, one for each subject, look at the `Evidence` and yield the names of the faults that they see, each with
what was seen, in words with numbers. What a fault means, its remedy and its source are in `rules.toml`; settings far
outside their usual range, which is in their help, are in `settings.toml`. A metric that there is not is NaN, of which
every comparison is false.

The thresholds were chosen on one half of the runs with injected faults of `benchmarks/doctor.py`, six of them with a
look at the other half; those of later rules on the faults that outsiders injected. `docs/doctor.md` has how often all
this is right.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lemniscate.doctor.evidence import HORIZONS, Evidence, first_number, last_number
from lemniscate.run.fields import field_of, flag, typed
from lemniscate.run.terms import ROUNDING
from lemniscate.run.updates import TARGET_ROUNDING

Seen = Iterator[tuple[str, str]]
"""names of faults, each with what was seen of it"""

CERTAIN, LIKELY, POSSIBLE, HINT = "certain", "likely", "possible", "hint"
"""how sure a finding is; a hint is no fault, but what to do next"""

CAUSES = ("environment", "learner", "settings")
"""kinds of faults; where a finding of one of these is certain or likely, symptoms are its own"""


def read(name: str) -> dict[str, dict[str, Any]]:
    """The tables of a file of TOML beside this one."""
    return tomllib.loads(Path(__file__).with_name(name).read_text("utf-8"))


@dataclass(frozen=True)
class Rule:
    """A fault.

    Attributes:
        name: its anchor in `docs/doctor.md`.
        kind: one of `KINDS`.
        sure: how sure a finding of it is.
        means: what it means.
        remedy: what to change: alternatives, of which those are named whose flags the algorithm has.
        source: where that is known from.
        metric: the metric to draw beside it.
    """

    name: str
    kind: str
    sure: str
    means: str
    remedy: str
    source: str
    metric: str = "episode/return"

    def remedy_for(self, config: Mapping[str, object]) -> str:
        """The alternatives whose flags are fields of the Config, or of no Config, and are not on already."""
        kept = [clause for clause in self.remedy.split("; ") if _may_help(clause, config)]
        text = " or ".join(kept or ["Look at docs/faq.md"])
        return text[0].upper() + text[1:]


def _may_help(clause: str, config: Mapping[str, object]) -> bool:
    options = [
        (field_of(option), value) for option, value in re.findall(r"(--[a-z-]+)(?: (off|none|0)(?![\w.]))?", clause)
    ]
    on_already = [repr(config.get(name)) == PRESENT[value] for name, value in options]
    return all(name in OF_COMMANDS or name in config for name, _ in options) and not (options and all(on_already))


PRESENT = {"": "True", "off": "False", "none": "None", "0": "0.0"}
"""what stands in a Config where an option was given with this value"""


OF_COMMANDS = ("episodes", "stochastic", "env_kwargs")
"""options that are no fields"""

FAR = 3.0
"""the factor outside of its usual range from which on a setting is named"""

CONSEQUENCES = {
    "action-without-effect": {
        "observation-part",
        "evaluated-otherwise",
        "acts-at-mode",
        "observation-repeated",
        "setting-initial-log-std",
    },
    "steps-short": {"observation-repeated", "exploding-observation", "every-return-alike"},
    "no-episode": {"ratio-always-one"},
    "still-rising": {"fell-back"},
    "action-late": {"exploding-observation"},
    "reward-unexplained": {"exploding-observation"},
    "advantage-not-normalized": {"ratio-not-one", "loss-differs"},
    "advantage-opposed": {"reward-large", "ratio-not-one", "targets-behind", "policy-still", "rows-of-others"},
    "targets-alike": {"critic-still"},
    "gradient-grows": {"value-runaway"},
    "policy-still": {"units-inactive", "loss-differs"},
    "ends-continued": {"targets-differ", "rewards-differ", "targets-forward"},
    "advantage-unrelated": {"policy-still", "setting-learning-rate", "kl-too-large", "loss-differs", "rows-of-others"},
    "q-unfollowed": {"policy-still"},
    "evaluated-otherwise": {"too-few-episodes"},
    "acts-at-mode": {"advantage-opposed", "entropy-opposed"},
    "replay-differs": {"replay-repeated"},
    "setting-entropy-coef": {"entropy-opposed"},
    "targets-of-others": {"critic-still", "replay-differs", "ends-continued"},
    "q-opposed": {"replay-differs", "loss-differs"},
    "replay-repeated": {"replay-part"},
    "gradient-clipped": {"loss-below-zero"},
    "missing-bootstrap": {"rate-zero", "rewards-differ", "targets-forward", "discount-differs"},
    "ends-ignored": {"ends-continued"},
    "targets-differ": {"rewards-differ", "targets-forward", "discount-differs", "targets-rescaled"},
    "kl-too-large": {"clip-differs"},
    "ratios-clipped": {"clip-differs"},
    "q-biased": {"critics-not-least"},
    "entropy-collapsed": {"entropy-opposed"},
    "ratio-not-one": {"rows-of-others"},
    "loss-differs": {
        "targets-of-others",
        "ends-continued",
        "loss-of-others",
        "rows-of-others",
        "targets-copied",
        "gradient-grows",
        "rewards-differ",
        "discount-differs",
        "entropy-opposed",
        "critics-not-least",
        "clip-differs",
        "targets-rescaled",
        "targets-differ",
    },
    "reward-small": {"setting-initial-log-std"},
}
"""faults that are not named beside one of these, which brings them about"""

TABLE = read("rules.toml")
KINDS = tuple(TABLE)
RULES = [Rule(name, kind, **row) for kind, rows in TABLE.items() for name, row in rows.items()]


def findings(e: Evidence) -> list[tuple[Rule, str]]:
    """The rules that apply, each with what was seen, in their order."""
    with np.errstate(all="ignore"):  # a run that has broken logs ∞ and NaN
        every = [fault for of_subject in SUBJECTS for fault in of_subject(e)]
    seen = dict(reversed(every))  # of two sentences the first counts
    return without_consequences([(rule, seen[rule.name]) for rule in RULES if rule.name in seen])


def without_consequences(found: Sequence[tuple[Rule, str]]) -> list[tuple[Rule, str]]:
    """The findings without those that another one of them brings about."""
    names = {rule.name for rule, _ in found}
    return [(rule, seen) for rule, seen in found if not CONSEQUENCES.get(rule.name, set()) & names]


def observation_faults(e: Evidence) -> Seen:
    """Faults of the observations, and of their copies in the replay buffer."""
    cut, repeated = e.late("observation/at_limits"), e.early("observation/repeated")
    predicted, whole, kept = map(e.late, ("observation/predicted", "observation/whole", "replay/repeated"))
    constant, fitted = e.values("observation/constant"), e.values("observation/predicted")  # few, and not one of n
    partly = len(fitted) >= 3 and 0.3 < constant.min(initial=1) < 1 and (predicted < 0.25 or not e.rose)
    if cut > 0.5:
        yield "observation-clipped", f"{cut:.0%} of the observed numbers stand at an end of their range."
    if e.sees_nothing:
        yield (
            "constant-observation",
            "Every number of the observation was the same in all of the newest rows, each time that they were looked"
            " at.",
        )
    elif repeated > 0.5 and not cut > 0.5 and not e.returns_alike:  # else the environment itself stands still
        yield "observation-repeated", f"After {repeated:.0%} of the steps the observation was the same as before."
    elif predicted < 0.25 and whole > 0.95:
        yield (
            "observation-repeated",
            f"{whole:.0%} of the observed numbers are whole, and an observation explains {max(0.0, predicted):.0%}"
            " of the next one.",
        )
    else:
        if partly:
            yield "observation-part", f"{constant.min():.0%} of the observed numbers were never seen to change."
        elif predicted < 0.25:
            yield "observation-noisy", f"An observation explains {max(0.0, predicted):.0%} of the next one."
        if kept > 0.9:
            yield (
                "replay-repeated",
                f"In {kept:.0%} of the sampled transitions the next observation is the same as the observation.",
            )


def normalization_faults(e: Evidence) -> Seen:
    """Faults of the size of observations, and of the normalizer."""
    first, late = e.early("observation/largest"), e.late("observation/largest")
    offset = e.late("normalizer/offset")
    count, normalized = e.last("normalizer/count"), e.config.get("normalize_observations", True)
    steps = max((line["step"] for line in e.log if "normalizer/count" in line), default=0)
    sizes = e.values("observation/largest")
    if late > max(1e5, 10 * first) or late > 300 * max(first, 1.0):  # not what is in a small unit from the beginning
        yield (
            "exploding-observation",
            f"Observations reached {late:.3g} in the last half of the run, and {first:.3g} at its beginning.",
        )
    elif len(sizes) >= 4 and sizes.max() > max(1e5, 1000 * np.median(sizes)):
        yield "exploding-observation", f"Observations reached {sizes.max():.3g}, and usually {np.median(sizes):.3g}."
    few = len(e.values("observation/predicted")) > 0  # of many numbers, as a Humanoid's, some are healthily large
    if not normalized and late > (200 if e.config.get("activation") == "tanh" else 500 if few else 20_000):
        yield "large-observation", f"Observations reach {late:.3g}, and are not normalized."
    if normalized and not e.config.get("episodes") and count < 0.45 * steps:  # reset rows are not seen
        yield "normalizer-frozen", f"The normalizer has seen {count:,.0f} observations of {steps:,} steps."
    if offset > 4:
        yield (
            "normalizer-stale",
            f"The newest observations lie {offset:.1f} standard deviations off their running mean.",
        )


def action_faults(e: Evidence) -> Seen:
    """Faults of the actions' effect, and of its delay."""
    effects, shares = e.values("action/effect"), e.values("action/share")
    now, beside = e.early("action/effect"), e.early("action/beside")
    late = e.values("action/late")[:3]  # of a hundred rows, as at first, chance explains a fifth
    before = float(np.median(late)) if len(late) else np.nan
    first = slice(max(3, len(effects) // 4))
    if e.is_slow and not e.rose:
        pace = np.median(e.values("observation/pace"))
        yield (
            "steps-short",
            f"In a step no number of the observation moves by more than {pace:.1%} of its standard deviation.",
        )
    if beside > 0.15 and beside > 3 * max(now, 0.0):
        yield (
            "observation-of-another",
            f"Actions in the environment beside explain {beside:.0%} of how observations change, those in their own"
            f" {max(now, 0.0):.0%}.",
        )
    elif before > 0.15 and before > 3 * max(now, 0.0):
        yield (
            "action-late",
            f"Earlier actions explain {before:.0%} of how observations change,"
            f" and the present one {max(now, 0.0):.0%}.",
        )
    elif len(effects) >= 3 and not e.rose and not e.sees_nothing and not e.late("observation/predicted") < 0.25:
        explained, most = (shares if len(shares) else effects)[first].max(), effects[first].max()
        none = np.median(effects[first]) < 0.02 and most < 0.1  # of a hundred rows chance explains 0.07
        paid = e.early("action/paid") > 0.1  # as where each step is a task of its own
        if not paid and (none or (len(shares) and explained < 0.001)):
            yield "action-without-effect", f"Actions explain {max(0.0, explained):.2%} of how observations change."


def action_part_faults(e: Evidence) -> Seen:
    """Faults of single numbers, signs and choices of actions, and of their bounds."""
    effects, at_bounds, by_sign = e.values("action/effect"), e.late("action/at_bounds"), e.early("action/by_sign")
    weakest, half, alike = map(e.values, ("action/weakest", "action/half", "action/alike"))
    first = slice(max(3, len(effects) // 4))
    if min(len(weakest), len(effects)) >= 3 and weakest[first].max() < 0.02 < np.median(effects[first]):
        yield (
            "action-part",
            f"One of the numbers of an action explains {max(0.0, weakest[first].max()):.2%} of how observations"
            f" change, all together {np.median(effects[first]):.0%}.",
        )
    if len(half) >= 3 and half[first].max() < 0.1 and np.median(half) < 0.05:
        yield (
            "action-half",
            f"Actions of one sign explain {np.median(half):.1%} of what those of the other explain of how observations"
            " change.",
        )
    share = np.median(alike[:3] / effects[:3]) if min(len(alike), len(effects)) >= 3 else 1.0  # while all are tried
    if share < 0.03 and np.median(effects[:3]) > 0.02:
        yield (
            "action-part",
            f"Which of two choices is made explains {max(0.0, np.median(alike[:3])):.2%} of how observations change,"
            f" all together {np.median(effects[:3]):.0%}.",
        )
    if by_sign > 0.5 and not at_bounds > 0.5:  # else a policy at its bounds has signs alone
        yield (
            "action-by-sign",
            f"Of what actions do not explain of how observations change, their signs explain {by_sign:.0%}.",
        )
    if at_bounds > 0.9 and not e.rose:
        yield "actions-at-bounds", f"{at_bounds:.0%} of the actions lie at or beyond a bound."


def reward_size_faults(e: Evidence) -> Seen:
    """Faults of the size of rewards, and of those that are 0."""
    largest, scaled = e.greatest("reward/largest"), e.config.get("scale_rewards", False)
    zero, unpaid, ends = e.early("reward/zero"), e.late("reward/zero"), e.greatest("episode/terminated")
    mean, std = e.late("reward/mean"), e.late("reward/std")
    if largest == 0 and not e.returns.any():
        yield "reward-zero", "Every reward was 0."
    fades = e.late("reward/age") < 0.2 and mean > 0 and ends == 0  # what is paid is so at the beginning of episodes
    if fades and unpaid > 0.9:
        yield "failure-goes-on", f"No episode terminates, and {unpaid:.0%} of the rewards, all but the first, are 0."
    elif zero > 0.9 and largest > 0:
        yield "reward-rare", f"{zero:.1%} of the rewards at the beginning were 0."
    elif unpaid > 0.9 and ends == 0 and mean > 0 and not e.returns_alike:  # where rewards are costs, 0 is a success
        yield (
            "failure-goes-on",
            f"No episode terminates, and {unpaid:.0%} of the late rewards are 0; at the beginning {zero:.0%} were.",
        )
    if 0 < largest < 0.03:
        yield "reward-small", f"No reward is larger than {largest:.2g}."
    if abs(mean) > 20 and 1e-6 < std / abs(mean) < 1 / 30:
        yield "reward-offset", f"Rewards are about {mean:,.3g}, and vary by {std:.2g} alone."
    elif largest > (1000 if scaled else 150):  # LunarLander, which is learned unscaled too, has 100
        yield "reward-large", f"Rewards reach {largest:,.3g}{'' if scaled else ', and are not scaled'}."


def reward_faults(e: Evidence) -> Seen:
    """Faults of what the rewards depend on."""
    by_time, before = e.late("reward/by_time"), e.values("reward/before")
    vary = [line for line in e.log if line.get("reward/std", 0) > 1e-6]  # elsewhere there is nothing to explain
    explained = [line["reward/explained"] for line in vary if "reward/explained" in line]
    std, by_age = e.late("reward/std"), e.late("reward/by_age")
    varies = std > 0.5 * abs(e.late("reward/mean"))  # not a reward that differs in the step of a goal alone
    if by_time > 0.8 and e.early("reward/by_time") > 0.5 and not e.is_slow:  # not what the policy has made of it
        yield "reward-by-time", f"Time alone explains {by_time:.0%} of the rewards within an episode."
    elif by_age > 0.25:
        yield (
            "reward-by-time",
            f"The steps since an episode began explain {by_age:.0%} more of the rewards' variance than what is seen.",
        )
    if std > 1e-6 and e.greatest("reward/within") < 1e-6:
        yield "reward-by-episode", "The reward is the same in every step of an episode, and another in the next one."
    if len(before) >= 3 and np.median(before) > 0.2 and not e.sees_nothing:
        yield (
            "reward-late",
            f"The row before explains {np.median(before):.0%} more of the rewards' variance than their own row does.",
        )
    elif std > 1e-6 and len(explained) >= 2 and (varies or not e.rose) and not e.sees_nothing:
        share = float(np.median(explained))
        if share < 0.02:
            yield (
                "reward-unexplained",
                f"Observations and actions explain {max(0.0, share):.1%} of the rewards' variance.",
            )


def episode_faults(e: Evidence) -> Seen:
    """Faults of the episodes: their starts, lengths and ends."""
    late, terminated = e.lengths[len(e.lengths) // 2 :], e.late("episode/terminated")
    short = len(e.lengths) >= 20 and np.percentile(e.lengths, 90) <= 2
    starts = e.values("observation/starts_alike")
    if e.repeats is False:
        yield "seed-ignored", "Two resets with the same seed began with different observations."
    if e.log and not len(e.returns):
        yield "no-episode", "No whole episode ended in training."
    if short:
        yield "short-episodes", f"Nine of ten episodes took {np.percentile(e.lengths, 90):.0f} or fewer steps."
    elif e.returns_alike and e.returns.any():
        cut = terminated == 0 and np.ptp(e.lengths) == 0
        yield (
            "every-return-alike",
            f"All {len(e.returns):,} episodes had the same return, {e.returns[0]:,.4g}, whatever was done"
            f"{f', and each was cut after {e.lengths[0]:,.0f} steps' if cut else ''}.",
        )
    longest = np.max(late, initial=0)
    if terminated > 0.9 and len(late) >= 5 and np.mean(late == longest) > 0.98 and longest >= 10:
        yield (
            "limit-as-termination",
            f"{np.sum(late == longest):,} of the last {len(late):,} episodes terminated after exactly {longest:,.0f}"
            " steps.",
        )
    alike = e.varies is False or (len(starts) > 2 and starts.min() == 1)
    if alike and e.late("observation/whole") < 0.9:  # a board begins alike
        yield "starts-alike", "Every episode began with the same observation."
    again = e.values("observation/jumps_every")
    if len(again) >= 3 and np.ptp(again) == 0:
        yield (
            "end-not-reported",
            f"After every {again[0]:.0f} steps of an episode the observation jumps as if another one began.",
        )


def reset_faults(e: Evidence) -> Seen:
    """Whether a reset begins an episode anew."""
    if (share := e.median("observation/goes_on")) > 0.9 and not e.is_slow:
        yield "reset-without-effect", f"After {share:.0%} of the ends the next episode begins where the last one ended."


def horizon_faults(e: Evidence) -> Seen:
    """Faults of the horizon: the discount against the length of episodes."""
    gamma, recommended = (first_number(config.get("gamma")) for config in (e.config, e.recommended))
    fifth = len(e.lengths) // 5
    if gamma is not None and recommended is not None and gamma < recommended:
        ahead, length = 1 / (1 - gamma), np.median(e.lengths) if len(e.lengths) else 0
        named = abs(e.beyond("gamma", *e.usual.get("gamma", (0.0, 1.0)))) >= FAR  # as a setting far out
        much = length > 25 * ahead or (length > 15 * ahead and 1 - gamma > 10 * (1 - recommended))
        if much and not named and not e.as_recommended("gamma"):
            yield (
                "horizon-short",
                f"With gamma {gamma:g} some {ahead:.0f} steps ahead count, and episodes last {length:,.0f}.",
            )
    if fifth >= 4 and e.gain > 5 and e.returns[-fifth:].mean() < 0 and e.late("episode/terminated") > 0.9:
        first, last = np.median(e.lengths[: max(10, fifth // 10)]), np.median(e.lengths[-fifth:])
        if last < 0.6 * first:
            yield "ends-early", f"Returns rose while episodes went from {first:.0f} steps to {last:.0f}."


def ratio_faults(e: Evidence) -> Seen:
    """Faults of the probability ratios: those of the KL divergence that no step explains, and their clip."""
    kl, other, rate = e.late("approx_kl"), e.late("old_approx_kl"), e.late("learning_rate")
    every, entropy, rates = e.values("approx_kl"), e.values("losses/entropy"), e.values("learning_rate")
    tenth, adapts, clipped = len(every) // 10, e.config.get("desired_kl") is not None, e.late("clip_fraction")
    fell = tenth >= 2 and len(rates) == len(every) and rates[-tenth:].mean() < 0.2 * rates[0]
    if adapts and rate < 3e-6 and kl > 1e-3:
        yield (
            "ratio-not-one",
            f"The KL divergence is {kl:.2g} although the learning rate has fallen to {rate:.1g}, which moves nothing.",
        )
    elif fell and not adapts:
        last, usual = np.median(every[-tenth:]), np.median(every[: 5 * tenth])
        if last > 0.02 and last > 0.7 * usual:
            yield (
                "ratio-not-one",
                f"The KL divergence of the last updates is {last:.2g}, and was {usual:.2g}, although the learning rate"
                f" has fallen to {rates[-tenth:].mean() / rates[0]:.0%} of what it was.",
            )
    elif len(every) >= 6 and other > max(4 * kl, 1e-3):  # both are unbiased where the old policy acted
        yield (
            "ratio-not-one",
            f"The two estimates of the KL divergence are {other:.2g} and {kl:.2g}: the actions are not those of the old"
            " policy.",
        )
    several = e.config.get("epochs", 1) >= 2 and min(len(every), len(entropy)) >= 4
    if several and np.abs(every).max() <= 1e-9 and np.ptp(entropy) >= 1e-3:
        yield (
            "ratio-always-one",
            f"Every update's KL divergence is 0, though the entropy went from {entropy[0]:.3g} to {entropy[-1]:.3g}.",
        )
    if clipped > 0.4:
        yield "ratios-clipped", f"{clipped:.0%} of the late probability ratios are clipped."


def update_size_faults(e: Evidence) -> Seen:
    """Faults of the update's size."""
    kl = np.fmax(e.late("approx_kl"), e.late("kl"))
    target = next(filter(None, map(first_number, map(e.config.get, ("target_kl", "desired_kl", "max_kl")))), None)
    if kl > (2 * target if target else 0.1):
        beside = f"{kl / target:.0f} times its target of {target:g}" if target else "and 0.003 to 0.03 is usual"
        yield "kl-too-large", f"The KL divergence of the late updates is {kl:.2g}, {beside}."
    if e.greatest("step_fraction") == 0 and e.late("gradient_norm") > 0:
        yield "step-refused", "The line search took no step in any update."
    if "policy" in e.config.get("freeze", ()):
        return
    if kl < 1e-6 and not e.rose and not e.spread_left >= 0:
        yield "policy-still", f"The KL divergence of the late updates is {kl:.1g}: the policy hardly moves."
    elif e.greatest("network/moved") == 0:
        yield "policy-still", "No update that was looked at changed a parameter of the policy."
    elif len(flat := e.last_half("gradient_norm/actor")) >= 3 and not flat.any():
        yield "policy-still", "The gradient of the policy is 0 in each of the late lines."


def exploration_faults(e: Evidence) -> Seen:
    """Faults of exploration: the policy's spread, and random play."""
    first, late = e.early("policy_std"), e.late("policy_std")
    starts, total = e.config.get("learning_starts"), e.config.get("total_steps")
    if e.spread_left >= 0:
        name = "standard deviation" if first >= 0 else "entropy"
        yield (
            "entropy-collapsed",
            f"In the first half of the run the policy's {name} fell to {e.spread_left:.0%} of what it was.",
        )
    epsilon, final = e.values("epsilon"), last_number(e.config.get("final_epsilon"))
    if len(epsilon) >= 4 and final is not None and abs(epsilon[-1] - final) > 0.01:
        if np.ptp(epsilon) == 0:
            yield "exploration-still", f"epsilon is {epsilon[0]:g} in each line, and is to end at {final:g}."
        elif abs(epsilon[-1] - final) > abs(epsilon[0] - final) + 0.01:
            yield (
                "exploration-still",
                f"epsilon went from {epsilon[0]:g} to {epsilon[-1]:g}; it is to end at {final:g}.",
            )
    if late > max(3 * first, 2.0):
        yield (
            "std-exploded",
            f"The policy's standard deviation rose from {first:.2g} to {late:.2g}, in units of half the action range.",
        )
    if starts and total and starts > total / 2 and not e.as_recommended("learning_starts"):
        yield "mostly-random", f"The first {starts:,} of {total:,} steps are at random, without an update."


def taken_action_faults(e: Evidence) -> Seen:
    """Faults of how far the actions that are taken lie from those of the policy."""
    away, tried = e.late("action/off_mode"), e.values("action/off_mode")
    never = len(tried) >= 3 and tried[:3].max() < 0.01 and not e.rose  # of a deterministic policy there is no more
    if away < 0.25 and np.isfinite(e.late("losses/entropy")):
        yield (
            "acts-at-mode",
            f"Actions lie {away:.2f} times as far from the policy's mode as those that are drawn from it.",
        )
    elif never:
        yield "acts-at-mode", f"From the beginning on, actions lie within {tried[:3].max():.2g} of the policy's own."


def entropy_faults(e: Evidence) -> Seen:
    """Faults of what is paid for the entropy."""
    entropy, temperature = e.values("losses/entropy"), e.values("temperature")
    weight, target = e.config.get("entropy_coef"), first_number(e.config.get("target_entropy"))
    far = e.beyond("entropy_coef", *e.usual.get("entropy_coef", (0.0, np.inf))) > FAR and ">" not in str(weight)
    if far and len(entropy) >= 4 and len(e.values("gradient/entropy")) < 2:  # which knows
        lost = entropy[0] - np.median(entropy[len(entropy) // 2 :])
        if lost > max(0.2, 0.3 * abs(entropy[0])):
            yield (
                "entropy-opposed",
                f"The entropy fell from {entropy[0]:.2g} to {entropy[0] - lost:.2g}, though its weight is {weight}.",
            )
    greatest, most = e.greatest("losses/entropy"), e.last("action/most_entropy")
    if greatest > most + 0.1:
        yield (
            "entropy-impossible",
            f"An entropy of {greatest:.2g} nats is reported; actions within their bounds have {most:.2g} at most.",
        )
    if target is not None and target >= 0 and not e.as_recommended("target_entropy"):
        yield (
            "entropy-unreachable",
            f"The policy is to have {target:g} nats, and the temperature is {e.late('temperature'):.2g}.",
        )
    if len(temperature) == len(entropy) >= 4:
        above = np.minimum(entropy[1:], entropy[:-1]) > (target or 0.0) + 0.1  # without a target it is below 0
        if above.sum() >= 4 and np.mean(np.diff(temperature)[above] > 0) > 0.8:
            yield (
                "temperature-opposed",
                f"The temperature rose from {temperature[0]:.2g} to {temperature[-1]:.2g} although the entropy,"
                f" {np.median(entropy):.2g}, was above its target.",
            )


def advantage_faults(e: Evidence) -> Seen:
    """Faults of the advantages, and of the value behind an end."""
    followed, ends = e.values("advantage/followed"), e.last_half("value/at_ends")
    often = len(ends) >= 2 and e.late("episode/terminated") > 0.9  # rare ends are learned late
    awaited = np.median(ends) if often else np.nan
    given, usual = (config.get("normalize_advantage") for config in (e.config, e.recommended))
    errors = _standard_errors(followed) if len(followed) >= 4 else np.nan
    moves = e.late("approx_kl") > 1e-5 or e.late("network/moved") > 1e-6
    # A V that has learned nothing awaits the same everywhere; one that goes on where nothing follows, too much.
    missing = e.late("value/missing")
    learned = (missing < -2 or not e.late("explained_variance") < 0.1) and not missing > 0
    most = 2.0 if missing < -2 else 1.2  # below, V is only behind; above, it has no scale yet, or feeds on itself
    others = e.late("value/explained") < 0.1 and e.late("explained_variance") > 0.5  # targets than those of GAE
    near = not e.beyond("gamma", *e.usual.get("gamma", (0.0, 1.0)))
    ignored = near and ((learned and 0.8 < awaited < most) or (others and awaited > 1.2))
    wrong = ignored or abs(missing) > 40 or _lacks_bootstrap(e)  # the value, and so the advantages
    if ignored:
        yield (
            "ends-ignored",
            f"Where episodes terminate, the value still awaits {awaited:.0%} of what it awaits elsewhere.",
        )
    # Once hardly any entropy is left, the correlation is chance, and only its sign still tells.
    known = e.median("gradient/policy_rest", 2) > ROUNDING  # the loss itself is another one
    falls = not known and (errors < -3 or (errors < -2 and followed.mean() < -0.04))
    if falls or (not known and len(followed) >= 4 and followed.mean() < -0.06 and np.mean(followed < 0) > 0.8):
        yield (
            "advantage-opposed",
            f"The probabilities of actions fall with their advantage: the correlation is {followed.mean():.2f}.",
        )
    elif not wrong and moves and ((errors <= 2 and followed.mean() <= 0.04) or (len(followed) >= 8 and errors <= 1)):
        yield (
            "advantage-unrelated",
            f"Changes of log π and advantages have a correlation of {followed.mean():.2f}: none.",
        )
    preferred = e.late("action/preferred")
    drowned = e.late("temperature") * abs(e.late("losses/entropy")) > e.greatest("reward/largest")  # Q is of entropies
    tells = e.q_steps >= 500 and (preferred < 0.1 or not drowned)  # a new Q says nothing
    if preferred < 0.4 and tells:  # healthy runs have 0.7 or more
        yield (
            "advantage-opposed",
            f"In {preferred:.0%} of the sampled states Q of the policy's action is above that of one at random.",
        )
    elif preferred < 0.58 and e.q_steps >= 2_000 and not e.rose and e.greatest("reward/largest") != 0:
        yield (
            "q-unfollowed",
            f"In {preferred:.0%} of the sampled states Q of the policy's action is above that of one at random.",
        )
    neither = given is False and usual and not e.config.get("scale_rewards")
    largest = np.abs(e.values("losses/policy")).max(initial=0.0)
    still = e.greatest("network/moved") < 1e-3 and e.as_recommended("learning_rate")
    if len(e.values("losses/policy")) >= 4 and largest < 1e-5 and still:  # healthy runs have 0.01 somewhere
        yield (
            "advantage-unrelated",
            f"The policy's loss is at most {largest:.0e} in every line: all actions share the mean advantage.",
        )
    if neither and not e.as_recommended("normalize_advantage"):
        yield "advantage-not-normalized", "Neither advantages nor rewards are normalized."
    centred, weight = e.config.get("normalize_advantage", e.config.get("standardize")), e.values("losses/policy")
    if centred and len(weight) >= 4 and np.median(np.abs(weight)) > 0.4:  # healthy runs have less than 0.2
        yield (
            "advantage-not-normalized",
            f"The policy's loss is {np.median(weight):.2g}; it is about 0 where advantages have a mean of 0.",
        )


def target_equation_faults(e: Evidence) -> Seen:
    """Whether targets follow from the rows of an update: equations that every healthy run fulfils."""
    if not _has_targets(e):
        return
    names = ("unexplained", "beyond_ends", "missing", "other_actions")
    rest, beyond, missing, other = (e.median(f"targets/{name}") for name in names)
    if other > 0.01:
        yield "rows-of-others", f"In {other:.0%} of the rows of an update the action is not the one that was taken."
    if rest > TARGET_ROUNDING:
        said = f"{min(100.0, 100 * rest):.2g} % of the targets' squares do not follow from the rows after them"
        yield "targets-differ", f"{said}; rounding leaves 1e-12."
    cut = "Where a time limit or a rollout's end cuts an episode, targets"
    if missing > 0.01:
        yield "missing-bootstrap", f"{cut} lack {missing:.0%} of the value that follows."
    elif missing < -0.01:
        yield "targets-differ", f"{cut} have {1 - missing:.2g} times the value that follows."
    if beyond > 0.01:
        yield "ends-continued", f"{beyond:.0%} of the squares of the targets at terminations are not the reward's."


def target_part_faults(e: Evidence) -> Seen:
    """Faults of the rewards, γ, λ and entropies in the targets of V or Q, which are known to rounding."""
    names = ("discount", "trace", "other_rewards", "entropy")
    discount, trace, other, entropy = (e.median(f"targets/{name}", 2) for name in names)
    gamma, lam = (first_number(e.config.get(name)) for name in ("gamma", "gae_lambda"))
    lam = first_number(e.config.get("td_lambda")) if lam is None else lam
    exact = not e.median("targets/unexplained") > TARGET_ROUNDING or trace == trace
    if other > ROUNDING:
        either = ", or returns are standardized" if lam == 1 or "returns" in e.config else ""  # then it is the same
        yield "rewards-differ", f"The rewards in the targets differ from those paid, by {other:.2g} of squares{either}."
    if e.median("targets/less_values", 2) == 1:
        yield "targets-differ", "The targets of V are advantages: V(s) is taken off."
    if e.median("targets/forward", 2) == 1:
        yield "targets-forward", "Targets follow from the rows before them."
    if gamma is not None and exact and abs(discount - gamma) > max(1e-3, 0.1 * (1 - gamma)):
        yield "discount-differs", f"From row to row targets are discounted by {discount:.4g}, not by {gamma:g}."
    elif lam is not None and abs(trace - lam) > 0.01:
        yield "discount-differs", f"Targets are made with a λ of {trace:.3g}, not of {lam:g}."
    if (rescaled := e.median("targets/rescaled", 2)) > ROUNDING:
        said = "The targets that are learned are a y + b, where y are those of the equations"
        yield "targets-rescaled", f"{said}: they differ by {rescaled:.2g} of their squares."
    if abs(entropy - 1) > 0.01:
        name = "entropy-opposed" if entropy < 0 else "loss-differs"
        yield name, f"In the targets of Q the entropy of the next action counts {entropy:.2g} times."


def used_advantage_faults(e: Evidence) -> Seen:
    """Whether the advantages in a gradient step are those of its rows, and targets less values."""
    own, used = map(e.median, ("advantage/own", "advantage/used"))
    if not _has_targets(e):
        return
    if (least := np.fmin(own, used)) < -0.5:
        yield "advantage-opposed", f"Advantages have a correlation of {least:.2f} with what they should be."
    elif used < 0.99:
        yield "advantage-of-others", f"In a gradient step advantages have a correlation of {used:.2f} with their rows'."
    elif own < 0.99 and e.config.get("baseline", "value") == "value":
        yield "baseline-differs", f"Advantages have a correlation of {own:.2f} with targets less values."


def _has_targets(e: Evidence) -> bool:
    """Whether its targets are the returns of GAE, of what is to come, or of Q(λ)."""
    known = {"gae_lambda", "returns", "final_epsilon"} & e.config.keys()
    return bool(known) and e.config.get("returns", "to_go") == "to_go"


MISTAKES = {
    "not_zeroed": ("gradient-grows", "still has the one of the step before in it: it was not set to zero"),
    "mean_target": ("loss-of-others", "is that of one target for all rows, their mean"),
    "ends_ignored": ("ends-continued", "of Q is that of targets with a value behind terminations"),
    "online_target": ("targets-copied", "of Q is that of targets of Q itself, without target networks"),
    "followed_target": ("loss-differs", "of Q goes through its own targets: these need a detach()"),
    "own_obs": ("targets-of-others", "of Q is that of targets at s in the place of s'"),
    "own_action": ("rows-of-others", "of Q is that of Q at the policy's actions in the place of those that were taken"),
    "other_action": ("rows-of-others", "is that of Q(s, ·) at other actions than were taken"),
    "other_rows": ("rows-of-others", "is that of an action, a reward, a target or a next observation of another row"),
    "other_critic": ("critics-not-least", "of Q is that of targets of the larger of two critics, their mean, or one"),
    "advantage_target": ("targets-differ", "of V is that of advantages in the place of targets"),
    "no_clip": ("clip-differs", "is that of ratios that nothing clips"),
    "largest_clip": ("clip-differs", "is that of the larger of r A and clip(r) A, not of the smaller"),
}
"""mistakes that `run/terms.py` tries where no term explains a gradient; each with its rule and what is seen"""


def first_step_faults(e: Evidence) -> Seen:
    """Faults of what the first gradient step of an update is given, and of its targets: exact, as `gradient_faults`."""
    if (other := e.median("gradient/other_rows", 2)) > 0.01:
        yield "rows-of-others", f"{other:.0%} of the rows of a gradient step are not as they were collected."
    if (apart := e.median("gradient/old_policy", 2)) > 1e-3:
        what = "KL(π_old ‖ π)" if "min_temperature" in e.config else "|log π − log π_old|"
        yield "ratio-not-one", f"Before the first gradient step of an update {what} is already {apart:.2g}."
    for mistake, (name, what) in MISTAKES.items():
        if e.median(f"gradient/if_{mistake}", 1) < ROUNDING:
            yield name, f"To rounding, the gradient {what}."


def gradient_faults(e: Evidence) -> Seen:
    """Whether the terms of the equations' loss explain the gradients: a healthy run's to rounding."""
    rests = {part: e.median(f"gradient/{part}_rest", 2) for part in ("policy", "value")}
    weights = {part: e.median(f"gradient/{part}", 2) for part in rests}
    judged = {"policy": "actions are", "value": "it is"}
    for part, whose in (("policy", "the policy"), ("value", "V or Q")):
        if rests[part] > ROUNDING:
            share = f"{100 * rests[part]:.2g} % of the squares of the gradient of {whose}, and rounding 1e-10 %"
            yield "loss-differs", f"Training descends another loss: no term of the equations explains {share}."
        elif abs(weights[part]) < ROUNDING and (part == "policy" or e.config.get("value_coef") != 0):
            yield (
                "loss-differs",
                f"The gradient of {whose} has no part in which {judged[part]} judged.",
            )
        elif weights[part] < 0:
            name = "advantage-opposed" if part == "policy" else "loss-differs"
            yield name, f"Training raises the loss of {whose} in place of lowering it."
            return
    if (later := e.median("gradient/later_rest", 1)) > ROUNDING:
        share = f"{100 * later:.2g} % of the squares of a gradient"
        yield (
            "loss-differs",
            f"Once the policy has moved, no term of its loss explains {share}: look at its clip, or its KL.",
        )
    entropy, coef = e.values("gradient/entropy"), first_number(e.config.get("value_coef"))
    times = weights["value"] / weights["policy"] if weights["policy"] > 0 else np.nan
    if coef and (times > FAR * coef or times < coef / FAR):
        said = f"The loss of V weighs {times:.2g} times that of the policy"
        yield "loss-differs", f"{said}, and is to weigh {coef:g} times."
    surer = len(entropy) >= 2 and entropy.max() < 1e-5 and np.median(entropy) < -1e-4
    if surer and not rests["policy"] > ROUNDING:
        yield "entropy-opposed", f"The gradient lowers the entropy: that is {-np.median(entropy):.1%} of its length."


def loss_faults(e: Evidence) -> Seen:
    """The loss of V or Q, which is a square, beside half the mean squared error of its rows; and the learning rate."""
    losses = e.last_half("losses/value"), e.last_half("losses/critic")
    least = min((float(np.median(each)) for each in losses if len(each) >= 3), default=0.0)
    if least < -1e-3:
        yield "loss-below-zero", f"The loss of the value is {least:.2g} in half of the late lines."
    rates = e.last_half("learning_rate")
    if len(rates) >= 4 and np.mean(rates == 0) > 0.5:
        yield "rate-zero", f"The learning rate is 0 in {np.mean(rates == 0):.0%} of the late lines."
    names = {"losses/value", "value/loss"}
    pairs = [(line["losses/value"], line["value/loss"]) for line in e.log if names <= line.keys()]
    times = np.array([loss / right for loss, right in pairs if right > 0])
    if len(times) < 3 or {"epochs", "critic_epochs"} & e.config.keys():
        return
    if times.std() > 0.1 * abs(times.mean()):  # else it is one of another factor
        said = f"The loss of V is from {times.min():.2g} to {times.max():.2g} times half the mean squared error."
        yield "loss-of-others", said


def _standard_errors(values: np.ndarray) -> float:
    """The mean of some values in its standard errors."""
    return float(values.mean() / max(values.std(ddof=1) / np.sqrt(len(values)), 1e-9))


def value_faults(e: Evidence) -> Seen:
    """Faults of V: bootstraps, explained variance, targets that feed on themselves."""
    missing = e.last_half("value/missing")
    own, of_gae = map(e.last_half, ("explained_variance", "value/explained"))
    constant = len(own) and np.median(own) < -1
    shares = of_gae if len(of_gae) and (constant or not len(own) or np.median(of_gae) < np.median(own)) else own
    explained = float(np.median(shares)) if len(shares) >= 3 else np.nan
    losses, fits = e.values("losses/value"), e.late("losses/value")
    grew = np.median(losses[len(losses) // 4 :]) / max(losses[0], 0.05) if len(losses) >= 4 else np.nan
    if _lacks_bootstrap(e):
        yield (
            "missing-bootstrap",
            f"{np.median(missing):.0%} of the value that follows is missing, and most episodes end at a time limit.",
        )
    # Below -1 targets are constant; a weak baseline of REINFORCE, which has no λ, does no harm.
    nothing = -1 < explained < 0.05 and np.percentile(shares, 90) <= 0.15 and (constant or not fits < 1e-4)
    above = np.median(missing) * (1 - (first_number(e.config.get("gamma")) or 0.0)) if len(missing) else 0.0
    away = np.abs(missing).min() if len(missing) >= 2 else 0.0  # healthy values come nearer than 5
    steady = len(missing) >= 3 and missing.std() < 0.1 * np.median(missing)
    one_reward = (nothing or steady) and not e.is_settled and len(missing) >= 2 and missing.min() > 5
    few = (one_reward or (away > 40 and explained < 0.3)) if "gae_lambda" in e.config else away > 40 and fits < 1e-3
    few = few or ("td_lambda" in e.config and away > 7 and missing.min() > 0)
    added = e.median("gradient/if_not_zeroed", 2) < ROUNDING  # its cause is known
    if not added and grew > (7 if e.config.get("scale_rewards") else 50) and not e.rose:
        yield "value-runaway", f"The loss of V grew to {grew:,.0f} times what it was, though returns did not rise."
    elif few and e.is_paid and not e.early("value/moved") < 1e-3:  # else it has only not learned
        yield (
            "missing-bootstrap",
            f"The value has hardly more than one reward in it: r + γ V(s') lies {above:.0%} above V, early and late.",
        )
    elif "gae_lambda" in e.config and ((nothing and (not e.is_settled or away > 5)) or (explained < 0.3 and away > 20)):
        yield (
            "value-explains-nothing",
            f"The value explains {max(0.0, explained):.0%} of the variance of its targets"
            f"{', no more than a constant would' if nothing else ', and is far from what follows'}.",
        )


def q_faults(e: Evidence) -> Seen:
    """Faults of Q(s, a): what it explains of its targets, of one step from replay, or of λ-returns."""
    by_steps, by_returns = "tau" in e.config, "final_epsilon" in e.config
    shares = e.last_half("value/explained" if by_steps else "explained_variance")
    learns = (by_steps or by_returns) and e.q_steps >= 1_000 and len(shares) >= 2
    varies = e.is_paid and not e.is_settled
    if learns and varies and np.median(shares) > -1 and shares.max() < 0.3:  # healthy runs have 0.4 to 1
        yield (
            "q-explains-nothing",
            f"Q explains {max(0.0, np.median(shares)):.0%} of the variance of its targets, as a constant would.",
        )


def _lacks_bootstrap(e: Evidence) -> bool:
    """Whether a share of the value is missing, and not on its way, where most episodes end at a time limit."""
    missing = e.last_half("value/missing")
    climbs = e.begins or "min_temperature" in e.config  # REPPO's Q, which is behind for as long as returns rise
    return len(missing) >= 2 and _is_missing(missing) and e.late("episode/terminated") < 0.5 and not climbs


def replay_faults(e: Evidence) -> Seen:
    """Faults of what stands in the replay buffer, and of what is drawn from it."""
    drawn, empty = e.last_half("replay/drawn"), e.median("replay/empty")
    if empty > 0.5:
        yield (
            "replay-part",
            f"{empty:.0%} of the transitions that are drawn are of zeros alone: nothing was stored there.",
        )
    elif len(drawn) >= 3 and drawn.max() < 0.8:
        yield "replay-part", f"The transitions that are drawn are from {drawn.max():.0%} of the replay buffer alone."
    for name, least, what in (
        ("actions", 0.5, "the stored transitions the action is not the one that was taken."),
        ("next", 0.01, "the stored transitions the next observation is not the one that followed."),
        ("signs", 0.9, "the stored transitions the reward has not the sign of the one that was paid."),
        ("ends", 0.5, "the terminations none is stored."),
        ("limits", 0.5, "the steps that a limit cut off a termination is stored."),
    ):
        share = e.late(f"replay/other_{name}")
        if share > least:
            yield "replay-differs", f"In {share:.0%} of {what}"
            return


def target_faults(e: Evidence) -> Seen:
    """Faults of the targets of V and Q."""
    error, loss, newest = map(e.last_half, ("td_error/sampled", "losses/critic", "td_error/newest"))
    if len(newest) == len(error) >= 3:
        times = np.median(newest / np.maximum(error, 1e-12))
        if times > 10 and not e.rose:
            yield (
                "critic-overfits",
                f"The error of Q at the newest transitions is {times:.0f} times that at sampled ones.",
            )
    constant = e.late("losses/value") < 1e-5 and not e.late("explained_variance") > 0
    if constant and "gae_lambda" in e.config and e.late("reward/std") > 0.02 * abs(e.late("reward/mean")):
        yield "targets-alike", "The targets of V are all the same, and the rewards are not."
    if min(len(error), len(loss)) >= 2 and not e.config.get("value_range"):
        times = np.median(error) / max(np.median(loss), 1e-12)
        if times > (12 if "initial_temperature" in e.config else 8):  # the entropy is estimated otherwise
            yield (
                "targets-of-others",
                f"The squared error of Q against r + γ Q'(s', π(s')) of the stored steps is {times:.0f} times the loss"
                " that is descended.",
            )
    q, mean = e.last_half("q"), e.late("reward/mean")
    one_sign = abs(mean) > 2 * e.late("reward/std") and "initial_temperature" not in e.config  # entropies are positive
    told = e.q_steps >= 1_000 and len(q) >= 4  # a new Q says nothing
    if one_sign and told and (q * mean < 0).all() and abs(np.median(q)) > 0.2 * abs(mean):
        yield "q-opposed", f"Q is {np.median(q):.3g}, and the rewards are {mean:.3g} on average: of the other sign."
    value, missing = e.last_half("value/mean"), e.last_half("value/missing")
    one_sign = abs(mean) > e.late("reward/std") and "gae_lambda" in e.config
    if one_sign and len(value) >= 4 and missing.max(initial=-np.inf) < -1 and (value * mean < 0).all():
        yield "q-opposed", f"V is {np.median(value):.3g}, and the rewards are {mean:.3g} on average: of the other sign."


def stillness_faults(e: Evidence) -> Seen:
    """Faults of what no update moves: V, Q, target networks."""
    moved, behind, length = map(e.values, ("value/moved", "targets/behind", "targets/length"))
    usual = all(map(e.as_recommended, ("tau", "policy_delay")))
    learns = not e.config.get("freeze") and e.config.get("value_coef") != 0
    if len(moved) >= 2 and not moved.any() and "gae_lambda" in e.config and learns:
        yield "critic-still", "No update that was looked at changed a parameter of V."
    if len(behind) >= 3 and not behind.any() and first_number(e.config.get("tau")) != 1:
        name = "targets-copied" if len(set(length)) > 1 else "critic-still"
        yield name, "The weights of Q are those of its target networks, each time that they were looked at."
    flat, losses = e.last_half("gradient_norm/critic"), e.last_half("losses/critic")
    if len(flat) >= 3 and not flat.any() and len(losses) and losses.all():
        yield "critic-still", f"The gradient of Q is 0, and its loss {np.median(losses):.3g}."
    if len(length) >= 3 and np.ptp(length) == 0 and behind.any() and usual:
        yield "targets-behind", "The weights of the target networks were the same each time that they were looked at."
    elif len(behind) >= 3 and (np.diff(behind) > 0).all() and behind[-1] > 0.15 and usual:
        yield (
            "targets-behind",
            f"The target networks differ from Q's by {behind[-1]:.0%} of the length of its weights, and ever more.",
        )


def _is_missing(late: np.ndarray) -> bool:
    """Whether a share of the value is missing, and not on its way; above 1.3 there is no value at all."""
    first, last = np.split(late, [len(late) // 2])
    some = 0.2 < np.median(late) < 1.3 and np.percentile(late, 10) > 0.1
    some = some and late.std() < 0.35 * np.median(late)  # what a limit cuts off is the same share early and late
    return bool(some and last.mean() >= 0.75 * first.mean())


def network_faults(e: Evidence) -> Seen:
    """Faults of the networks: their units and gradients."""
    inactive, saturated = e.late("network/inactive"), e.late("network/saturated")
    for field in ("hidden", "critic_hidden"):
        given, usual = (config.get(field) for config in (e.config, e.recommended))
        least = min(given or (0,))
        small = usual and given is not None and 8 * least <= min(usual)
        if small and not e.as_recommended(field) and (least <= 2 or not e.rose):
            yield "network-small", f"{field} is {typed(given)}, and {typed(usual)} is recommended."
    norms, norm = e.values("gradient_norm"), e.late("gradient_norm")
    limit = first_number(e.config.get("max_grad_norm"))
    fell = e.late("losses/value") < e.early("losses/value") and not e.greatest("reward/largest") > 150
    times = 5 if norm > 100 and e.config.get("scale_rewards", False) else 15 if fell else 100
    alike = e.values("network/alike")
    if len(alike) >= 3 and alike.min() == 1:
        yield "units-alike", "At every observation all hidden units of the policy's last layer say the same."
    if inactive > 0.6:
        yield "units-inactive", f"{inactive:.0%} of the policy's hidden units are the same at every observation."
    if saturated > 0.6:
        yield "units-saturated", f"{saturated:.0%} of what the policy's hidden units say is at a bound of tanh."
    if len(norms) >= 8 and norm > times * norms[0]:
        yield "gradient-grows", f"The norm of the gradient rose from {norms[0]:.3g} to {norms[-1]:.3g}."
    if limit and norm > 30 * limit:
        yield (
            "gradient-clipped",
            f"The late gradient has a norm of {norm:.3g}, and is clipped to 1/{norm / limit:.0f} of it.",
        )


def return_faults(e: Evidence) -> Seen:
    """Faults of the returns over the whole run."""
    (first, last), fifth = e.ends, len(e.returns) // 5
    if e.gain < -5 and first.mean() - last.mean() > 0.25 * abs(first.mean()) and not e.begins:
        yield (
            "gets-worse",
            f"Returns fell from {first.mean():,.4g} in the first fifth of the episodes"
            f" to {last.mean():,.4g} in the last.",
        )
    if fifth < 10:
        return
    if e.gain <= 2 and e.returns.std() > 0:
        yield (
            "does-not-learn",
            f"Returns are {last.mean():,.4g} in the last fifth of the episodes,"
            f" and were {first.mean():,.4g} in the first: {abs(e.gain):.1f} standard errors apart.",
        )
    before = e.returns[-2 * fifth : -fifth]
    rise, error = last.mean() - before.mean(), np.hypot(last.std(), before.std()) / np.sqrt(fifth)
    arrived = np.ptp(e.returns[-max(5, fifth // 10) :]) == 0  # as in CartPole, whose return has a maximum
    if rise > 3 * error and rise > 0.05 * np.ptp(e.returns) and not arrived:
        yield (
            "still-rising",
            f"Returns were still rising, from {before.mean():,.4g} to {last.mean():,.4g} in the last two fifths of the"
            " episodes.",
        )


def fall_faults(e: Evidence) -> Seen:
    """A fall of the returns below their best."""
    window = max(10, len(e.returns) // 20)
    if len(e.returns) < 3 * window:
        return
    averages = np.convolve(e.returns, np.full(window, 1 / window), "valid")
    best, final, error = averages.max(), averages[-1], e.returns[-window:].std() / np.sqrt(window)
    if best - final > max(5 * error, 0.3 * np.ptp(averages)) and best - averages[0] > 5 * error:
        yield "fell-back", f"Returns fell from {best:,.4g} to {final:,.4g} before the end."
        first, late = e.early("network/inactive"), e.late("network/inactive")
        if late > first + 0.25:
            yield "plasticity-lost", f"Inactive units rose from {first:.0%} to {late:.0%} while returns fell."


def evaluation_faults(e: Evidence) -> Seen:
    """Faults of the evaluation."""
    last, mean = e.ends[1], e.scores.get("mean_return", e.last("evaluation/return"))
    returns, each = e.scores.get("returns", ()), e.config.get("evaluate_episodes", 20)
    bias = (e.scores.get("q_bias") or {}).get("bias", e.late("evaluation/q_bias"))
    enough, usual = len(last) >= 10, np.percentile(e.returns, (5, 95)) if len(e.returns) else np.zeros(2)
    if enough and last.mean() - mean > max(0.3 * np.ptp(usual), 3 * last.std() / np.sqrt(len(last))):
        yield (
            "evaluated-otherwise",
            f"Training ends at {last.mean():,.4g}, and the deterministic policy has {mean:,.4g} in the evaluation.",
        )
    latest, evaluated = e.lengths[-max(20, len(e.lengths) // 5) :], e.late("evaluation/length")
    longest = np.max(latest, initial=0)
    if evaluated > 1.5 * longest > 0 and np.mean(latest == longest) > 0.5:  # another time limit
        yield (
            "evaluated-otherwise",
            f"Episodes last {longest:,.0f} steps at most in training, and {evaluated:,.0f} on average in evaluations.",
        )
    if abs(bias) > 0.5 and not e.rose and e.q_steps >= 4_000:  # before, Q is only new
        yield "q-biased", f"Q {'over' if bias > 0 else 'under'}-estimates the return by {abs(bias):.0%}."
    asked, played = each if e.config.get("evaluate_every") else np.inf, len(returns) or np.inf
    if (few := min(asked, played)) < 5:
        yield "too-few-episodes", f"An evaluation has {few} {'episode' if few == 1 else 'episodes'}."
    elif asked < 10:
        yield "few-episodes", f"Each evaluation has {each} episodes, and the best may be one of luck."
    elif played < 20:
        yield (
            "few-episodes",
            f"The evaluation has {len(returns)} episodes, of standard deviation {np.std(returns):,.3g}.",
        )


SUBJECTS = (
    first_step_faults,  # first what is exact
    gradient_faults,
    target_part_faults,
    target_equation_faults,
    used_advantage_faults,
    observation_faults,
    normalization_faults,
    action_faults,
    action_part_faults,
    reward_size_faults,
    reward_faults,
    episode_faults,
    reset_faults,
    horizon_faults,
    ratio_faults,
    update_size_faults,
    exploration_faults,
    taken_action_faults,
    entropy_faults,
    advantage_faults,
    loss_faults,
    value_faults,
    q_faults,
    replay_faults,
    target_faults,
    stillness_faults,
    network_faults,
    return_faults,
    fall_faults,
    evaluation_faults,
)

OF_RATIOS = {"rollout_rows": ("num_envs", "num_steps"), "replay_ratio": ("num_updates", "update_every", "num_envs")}
"""what is made of several fields: these"""


def settings_far_out(e: Evidence) -> list[tuple[Rule, str]]:
    """A finding for each setting far outside its usual range that is not as recommended, the farthest first."""
    found = list[tuple[float, Rule, str]]()
    for field, known in read("settings.toml").items():
        low, high = known.get("usual") or e.usual.get(field, (0.0, np.inf))
        if times := known.get("times_recommended"):
            low, high = (e.recommended.get(field, 0) * each for each in times)
        if share := known.get("share_of_steps"):
            high = min(high, max(e.recommended.get(field, 0), share * e.config.get("total_steps", np.inf)))
        factor = e.beyond(field, low, high)
        means = known.get("small" if factor < 0 else "large")
        if abs(factor) < FAR - 1e-9 or not means:
            continue
        size = "far" if field in HORIZONS or np.isinf(factor) else f"{abs(factor):,.0f} times"
        side = "below" if factor < 0 else "above"
        named = [name for name in OF_RATIOS.get(field, (field,)) if name in e.config]
        change = [name for name in named if e.config[name] != e.recommended.get(name)]
        seen = f"{field} is {e.config[field]}, {size} {side} its usual range, {low:g} to {high:g}."
        remedy = f"{' '.join(f'{flag(name)} {typed(e.recommended.get(name))}' for name in change)}, as recommended"
        sure = POSSIBLE if e.rose else LIKELY
        name = f"setting-{field}".replace("_", "-")
        found.append((abs(factor), Rule(name, "settings", sure, means, remedy, known["source"]), seen))
    return [(rule, seen) for _, rule, seen in sorted(found, key=lambda each: -each[0])]


def seeds_differ(finals: Sequence[float]) -> str | None:
    """The standard deviation of the final returns over seeds is more than a fifth of their mean; our choice."""
    if len(finals) < 2 or np.std(finals) <= 0.2 * abs(np.mean(finals)):
        return None
    return (
        f"The final returns of its seeds lie from {min(finals):,.4g} to {max(finals):,.4g}:"
        " train more seeds before believing a difference."
    )
