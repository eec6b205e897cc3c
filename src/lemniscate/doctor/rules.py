"""What can be wrong with a run: faults, each with what shows it and what that means.

A rule is a function of the `Evidence` that answers with what it saw, in words with numbers, or with nothing; its
docstring says what that means. Its remedy and its source are in `rules.toml`; settings far outside their usual range,
which is in their help, are in `settings.toml`. The thresholds were chosen on one half of the runs with injected faults
of `benchmarks/doctor.py`, six of them with a look at the other half: `docs/doctor.md` has how often all this is right.
"""

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lemniscate.doctor.evidence import HORIZONS, Evidence, first_number
from lemniscate.run.fields import field_of, flag, typed

Sees = Callable[[Evidence], str | None]

CERTAIN, LIKELY, POSSIBLE, HINT = "certain", "likely", "possible", "hint"
"""how sure a finding is; a hint is no fault, but what to do next"""

CAUSES = ("environment", "learner", "settings")
KINDS = (*CAUSES, "symptom", "judgement")
"""causes before consequences: where a finding of a cause is certain or likely, symptoms are its own"""


def read(name: str) -> dict[str, dict[str, Any]]:
    """The tables of a file of TOML beside this one."""
    return tomllib.loads(Path(__file__).with_name(name).read_text("utf-8"))


@dataclass(frozen=True)
class Rule:
    """A fault.

    Attributes:
        name: its anchor in `docs/doctor.md`.
        sees: what shows it, a sentence with numbers; None where nothing does.
        means: what that means.
        kind: one of `KINDS`.
        sure: how sure a finding of it is.
        remedy: what to change: alternatives, of which those are named whose flags the algorithm has.
        source: where that is known from.
        metric: the metric to draw beside it.
    """

    name: str
    sees: Sees
    means: str
    kind: str
    sure: str
    remedy: str
    source: str
    metric: str = "episode/return"

    def remedy_for(self, config: Mapping[str, object]) -> str:
        """The alternatives whose flags are fields of the Config, or of no Config, and are not on already."""
        kept = [clause for clause in self.remedy.split("; ") if _may_help(clause, config)]
        text = " or ".join(kept or ["Look at docs/faq.md"])
        return text[0].upper() + text[1:]


def _may_help(clause: str, config: Mapping[str, object]) -> bool:
    options = [(field_of(option), off) for option, off in re.findall(r"(--[a-z-]+)( off)?", clause)]
    return all(name in OF_COMMANDS or (name in config and (off or config[name] is not True)) for name, off in options)


OF_COMMANDS = ("episodes", "stochastic", "env_kwargs")
"""options that are no fields"""

TABLE = read("rules.toml")
RULES: list[Rule] = []


def rule(sees: Sees) -> Sees:
    """Enter a function of the evidence among the rules; its docstring is what its finding means."""
    name, means = sees.__name__.replace("_", "-"), " ".join((sees.__doc__ or "").split())
    RULES.append(Rule(name, sees, means, **TABLE[name]))
    return sees


# --- of the environment ---------------------------------------------------------------------------------------------


@rule
def seed_ignored(e: Evidence) -> str | None:
    """The environment does not use the seed of reset(): no run of it can be repeated, nor resumed to the same bits."""
    return "Two resets with the same seed began with different observations." if e.repeats is False else None


@rule
def constant_observation(e: Evidence) -> str | None:
    """The policy sees nothing, and can learn no more than one action for all time."""
    if not e.sees_nothing:
        return None
    return "Every number of the observation was the same in all of the newest rows, each time that they were looked at."


@rule
def observation_clipped(e: Evidence) -> str | None:
    """Observations are cut off at limits, or were divided by too little: little more than signs is left of them."""
    share = e.late("observation/at_limits")
    return f"{share:.0%} of the observed numbers stand at an end of their range." if share > 0.5 else None


@rule
def observation_repeated(e: Evidence) -> str | None:
    """Observations stay as they are while the environment moves: they are rounded, old, or of too little."""
    share = e.early("observation/repeated")
    if not share > 0.5 or e.sees_nothing or observation_clipped(e):
        return None
    return f"After {share:.0%} of the steps the observation was the same as before."


@rule
def observation_noisy(e: Evidence) -> str | None:
    """Observations are mostly noise: one says little of the next."""
    share = e.late("observation/predicted")
    if not share < 0.25 or e.sees_nothing or observation_repeated(e):
        return None
    return f"An observation explains {max(0.0, share):.0%} of the next one."


@rule
def exploding_observation(e: Evidence) -> str | None:
    """A sensor drifts, or a simulation has become unstable: nothing that was learned at its beginning holds later."""
    first, late = e.early("observation/largest"), e.late("observation/largest")
    if not (late > 1e5 or late > 300 * max(first, 1.0)):
        return None
    return f"Observations reached {late:.3g} in the last half of the run, and {first:.3g} at its beginning."


@rule
def action_without_effect(e: Evidence) -> str | None:
    """The environment does not use its actions, or too little to be seen: nothing can be learned."""
    effects, shares = e.values("action/effect"), e.values("action/share")
    if len(effects) < 3 or e.rose or e.sees_nothing or action_late(e):
        return None
    first = slice(max(3, len(effects) // 4))
    if not (effects[first].max() < 0.02 or (len(shares) and shares[first].max() < 0.001)):
        return None
    explained = shares if len(shares) else effects
    return f"Actions explain {max(0.0, explained[first].max()):.2%} of how observations change."


@rule
def action_late(e: Evidence) -> str | None:
    """An action takes effect some steps after it: what a step brings says nothing of its own action."""
    now, late = e.early("action/effect"), e.early("action/late")
    if not (late > 0.15 and late > 3 * max(now, 0.0)):
        return None
    return f"Earlier actions explain {late:.0%} of how observations change, and the present one {max(now, 0.0):.0%}."


@rule
def action_by_sign(e: Evidence) -> str | None:
    """Actions are cut off far inside the bounds that the environment declares: only their signs count."""
    share = e.early("action/by_sign")
    if not share > 0.5:
        return None
    return f"Of what actions do not explain of how observations change, their signs explain {share:.0%}."


@rule
def reward_zero(e: Evidence) -> str | None:
    """No reward was ever met, so that every action is as good as any other."""
    if e.greatest("reward/largest") != 0 or (len(e.returns) and np.abs(e.returns).max() > 0):
        return None
    return "Every reward was 0."


@rule
def reward_rare(e: Evidence) -> str | None:
    """Nearly every step is without a reward: which of the actions before it has brought it, is hard to learn."""
    share = e.early("reward/zero")
    if not share > 0.9 or not e.greatest("reward/largest") > 0:
        return None
    return f"{share:.1%} of the rewards at the beginning were 0."


@rule
def reward_by_time(e: Evidence) -> str | None:
    """The reward tells the time, and not what was done."""
    share = e.late("reward/by_time")
    return f"Time alone explains {share:.0%} of the rewards within an episode." if share > 0.8 else None


@rule
def reward_unexplained(e: Evidence) -> str | None:
    """The reward does not depend on the action, nor on what is observed: it is noise to the learner."""
    explained = e.values("reward/explained")
    if (
        len(explained) < 3
        or not np.median(explained) < 0.02
        or not e.late("reward/std") > 1e-6
        or e.rose
        or e.sees_nothing
    ):
        return None
    return f"Observations and actions explain {max(0.0, float(np.median(explained))):.1%} of the rewards' variance."


@rule
def no_episode(e: Evidence) -> str | None:
    """There is no return to judge by."""
    return "No whole episode ended in training." if e.log and not len(e.returns) else None


@rule
def short_episodes(e: Evidence) -> str | None:
    """Episodes end before anything can be done."""
    if len(e.lengths) < 20 or np.percentile(e.lengths, 90) > 2:
        return None
    return f"Nine of ten episodes took no more than {np.percentile(e.lengths, 90):.0f} steps."


@rule
def every_return_alike(e: Evidence) -> str | None:
    """Nothing that the policy did changed its return: the reward is constant, or an end is never reached."""
    alike = len(e.returns) >= 10 and np.ptp(e.returns) <= 1e-6 * (1 + abs(e.returns[0]))
    if not alike or np.abs(e.returns).max() == 0 or short_episodes(e):
        return None
    return f"All {len(e.returns):,} episodes had the same return, {e.returns[0]:,.4g}, whatever was done."


@rule
def limit_as_termination(e: Evidence) -> str | None:
    """A time limit is reported as a termination: learning takes the value there to be 0."""
    late = e.lengths[len(e.lengths) // 2 :]
    if len(late) < 5 or np.ptp(late) > 0 or late[0] < 10 or not e.late("episode/terminated") > 0.9:
        return None
    return f"Each of the last {len(late):,} episodes terminated after exactly {late[0]:,.0f} steps."


@rule
def reward_large(e: Evidence) -> str | None:
    """The first errors of the value are so large that the policy and the value do not learn at one rate."""
    largest, scaled = e.greatest("reward/largest"), e.config.get("scale_rewards", False)
    if not largest > (1000 if scaled else 150):  # LunarLander, which is learned unscaled too, has 100
        return None
    return f"Rewards reach {largest:,.3g}{'' if scaled else ', and are not scaled'}."


@rule
def reward_small(e: Evidence) -> str | None:
    """The reward is lost beside entropy and the error of a new value."""
    largest = e.greatest("reward/largest")
    return f"No reward is larger than {largest:.2g}." if 0 < largest < 0.03 else None


@rule
def large_observation(e: Evidence) -> str | None:
    """Units of the first layer are at their bounds at every observation."""
    late, most = e.late("observation/largest"), 200 if e.config.get("activation") == "tanh" else 20_000
    if e.config.get("normalize_observations", True) or not late > most:
        return None
    return f"Observations reach {late:.3g}, and are not normalized."


# --- of the learner -------------------------------------------------------------------------------------------------


@rule
def ratio_not_one(e: Evidence) -> str | None:
    """The policy that learns is not the one that acted: a normalizer, dropout or a stale log-probability is between."""
    kl, rate = e.late("approx_kl"), e.late("learning_rate")
    if e.config.get("desired_kl") is None or not (rate < 3e-6 and kl > 1e-3):
        return None
    return f"The KL divergence is {kl:.2g} although the learning rate has fallen to {rate:.1g}, which moves nothing."


@rule
def ratio_always_one(e: Evidence) -> str | None:
    """The probability ratio is 1 whatever was learned: log π_old is taken from the policy that learns."""
    kl, entropy = e.values("approx_kl"), e.values("losses/entropy")
    if (
        e.config.get("epochs", 1) < 2
        or min(len(kl), len(entropy)) < 4
        or np.abs(kl).max() > 1e-9
        or np.ptp(entropy) < 1e-3
    ):
        return None
    return f"Every update's KL divergence is 0, though the entropy went from {entropy[0]:.3g} to {entropy[-1]:.3g}."


@rule
def advantage_opposed(e: Evidence) -> str | None:
    """The policy is led away from what is better: the sign of the loss or of the advantage is wrong."""
    followed = e.values("advantage/followed")
    if len(followed) < 4 or not _standard_errors(followed) < -3:
        return None
    return f"The probabilities of actions fall with their advantage: the correlation is {followed.mean():.2f}."


@rule
def ends_ignored(e: Evidence) -> str | None:
    """The value goes on where an episode has terminated: targets add what follows an end, of the next episode even."""
    late = e.last_half("value/at_ends")
    if len(late) < 2 or not e.late("episode/terminated") > 0.9:  # rare ends are learned late
        return None
    if not 0.8 < np.median(late) < 1.2:  # below, V is only behind; above, it has no scale yet
        return None
    return f"Where episodes terminate, V still awaits {np.median(late):.0%} of what it awaits elsewhere."


@rule
def advantage_unrelated(e: Evidence) -> str | None:
    """The policy moves, and not towards what was better: advantages are those of other rows, or of other actions."""
    followed = e.values("advantage/followed")
    if len(followed) < 4 or advantage_opposed(e) or ends_ignored(e) or not e.late("approx_kl") > 1e-5:
        return None
    if _standard_errors(followed) > 2 or followed.mean() > 0.04:
        return None
    return f"Changes of log π and advantages have a correlation of {followed.mean():.2f}: none."


def _standard_errors(values: np.ndarray) -> float:
    """The mean of some values in its standard errors."""
    return float(values.mean() / max(values.std(ddof=1) / np.sqrt(len(values)), 1e-9))


@rule
def gradient_grows(e: Evidence) -> str | None:
    """The gradient grows from step to step: gradients add up, as without zero_grad."""
    norms = e.values("gradient_norm")
    if len(norms) < 8:
        return None
    late = np.median(norms[len(norms) // 2 :])
    if not late > (5 if late > 100 and e.config.get("scale_rewards", False) else 100) * norms[0]:
        return None
    return f"The norm of the gradient rose from {norms[0]:.3g} to {norms[-1]:.3g}."


@rule
def replay_repeated(e: Evidence) -> str | None:
    """A transition ends where it began: both observations are one array, which has been written to again."""
    share = e.late("replay/repeated")
    if not share > 0.9 or observation_repeated(e) or e.sees_nothing:
        return None
    return f"In {share:.0%} of the sampled transitions the next observation is the same as the observation."


@rule
def targets_behind(e: Evidence) -> str | None:
    """The target networks do not follow: Q learns one reward and what was believed at first."""
    behind = e.values("targets/behind")
    if len(behind) < 3 or not (np.diff(behind) > 0).all() or not behind[-1] > 0.15:
        return None
    if not e.as_recommended("tau"):  # a setting far out is named as such
        return None
    return f"The target networks differ from Q's by {behind[-1]:.0%} of the length of its weights, and ever more."


@rule
def normalizer_frozen(e: Evidence) -> str | None:
    """Observations are normalized with the statistics of other ones."""
    count, steps = e.values("normalizer/count"), [line["step"] for line in e.log if "normalizer/count" in line]
    if not len(count) or not e.config.get("normalize_observations", True) or count[-1] > 0.5 * steps[-1]:
        return None
    return f"The normalizer has seen {count[-1]:,.0f} observations of {steps[-1]:,} steps."


@rule
def normalizer_stale(e: Evidence) -> str | None:
    """The observations have moved away from what the normalizer knows: a drift, or statistics of another task."""
    offset = e.late("normalizer/offset")
    return (
        f"The newest observations lie {offset:.1f} standard deviations off their running mean." if offset > 4 else None
    )


@rule
def advantage_not_normalized(e: Evidence) -> str | None:
    """The size of a step hangs on that of the rewards."""
    given, usual = (config.get("normalize_advantage") for config in (e.config, e.recommended))
    if given is not False or not usual or e.config.get("scale_rewards") or e.as_recommended("normalize_advantage"):
        return None
    return "Neither advantages nor rewards are normalized."


@rule
def mostly_random(e: Evidence) -> str | None:
    """Most of what was collected is random play."""
    starts, total = e.config.get("learning_starts"), e.config.get("total_steps")
    if starts is None or total is None or e.as_recommended("learning_starts") or starts <= total / 2:
        return None
    return f"The first {starts:,} of {total:,} steps are at random, without an update."


@rule
def horizon_short(e: Evidence) -> str | None:
    """The policy sees a small part of its episode ahead."""
    gamma, recommended = (first_number(config.get("gamma")) for config in (e.config, e.recommended))
    if gamma is None or recommended is None or e.as_recommended("gamma") or gamma >= recommended:
        return None
    if e.beyond("gamma", *e.usual.get("gamma", (0.0, 1.0))):  # a setting far out is named as such
        return None
    ahead, length = 1 / (1 - gamma), np.median(e.lengths) if len(e.lengths) else 0
    if not length > 25 * ahead:
        return None
    return f"With gamma {gamma:g} some {ahead:.0f} steps ahead count, and episodes last {length:,.0f}."


@rule
def entropy_unreachable(e: Evidence) -> str | None:
    """More entropy is asked for than actions within their bounds can have: the temperature rises without an end."""
    given = first_number(e.config.get("target_entropy"))
    if given is None or e.as_recommended("target_entropy") or given < 0:
        return None
    return f"The policy is to have {given:g} nats, and the temperature is {e.late('temperature'):.2g}."


# --- symptoms -------------------------------------------------------------------------------------------------------


@rule
def missing_bootstrap(e: Evidence) -> str | None:
    """The value ends where the time limit does, as if nothing followed: the bootstrap of truncated steps is missing."""
    late = e.last_half("value/missing")
    if len(late) < 2 or not (0.2 < np.median(late) < 1.3 and np.percentile(late, 10) > 0.1):  # above: no value at all
        return None
    if late[len(late) // 2 :].mean() < 0.75 * late[: len(late) // 2].mean():  # it is on its way
        return None
    if not e.late("episode/terminated") < 0.5 or ("tau" in e.config and e.log[-1]["step"] < 20_000):  # Q comes slowly
        return None
    return f"{np.median(late):.0%} of the value that follows is missing, and most episodes end at a time limit."


@rule
def kl_too_large(e: Evidence) -> str | None:
    """Each update takes the policy so far that what was collected says little about where it arrives."""
    kl = e.late("approx_kl")
    target = next(filter(None, map(first_number, map(e.config.get, ("target_kl", "desired_kl", "max_kl")))), None)
    if not kl > (2 * target if target else 0.1):
        return None
    beside = f"{kl / target:.0f} times its target of {target:g}" if target else "and 0.003 to 0.03 is usual"
    return f"The KL divergence of the late updates is {kl:.2g}, {beside}."


@rule
def ratios_clipped(e: Evidence) -> str | None:
    """Most of the gradient is cut off by the clip."""
    share = e.late("clip_fraction")
    return f"{share:.0%} of the late probability ratios are clipped." if share > 0.4 else None


@rule
def policy_still(e: Evidence) -> str | None:
    """The gradient does not reach the policy, or its step is too small."""
    kl = e.late("approx_kl")
    return (
        f"The KL divergence of the late updates is {kl:.1g}: the policy hardly moves."
        if kl < 1e-6 and not e.rose
        else None
    )


@rule
def entropy_collapsed(e: Evidence) -> str | None:
    """The policy has stopped exploring before it has learned."""
    std, entropy = e.values("policy_std"), e.values("losses/entropy")
    spread, name = (std, "standard deviation") if len(std) else (entropy, "entropy")
    chosen = {"initial_temperature", "min_temperature"} & set(e.config)  # SAC and REPPO choose their entropy
    if len(spread) < 8 or chosen or spread[0] <= 0 or e.gain > 10:
        return None
    left = spread[len(spread) // 4] / spread[0]
    return (
        f"After a quarter of the run the policy's {name} is {max(0.0, left):.0%} of what it was."
        if left < 0.1
        else None
    )


@rule
def std_exploded(e: Evidence) -> str | None:
    """The entropy bonus is worth more than the reward, and actions are cut at their bounds."""
    first, late = e.early("policy_std"), e.late("policy_std")
    if not late > max(3 * first, 2.0):
        return None
    return f"The policy's standard deviation rose from {first:.2g} to {late:.2g}, in units of half the action range."


@rule
def actions_at_bounds(e: Evidence) -> str | None:
    """The policy knows full force in one direction or the other alone, where its gradient is cut off."""
    share = e.late("action/at_bounds")
    return f"{share:.0%} of the actions lie at or beyond a bound." if share > 0.9 and not e.rose else None


@rule
def q_biased(e: Evidence) -> str | None:
    """The policy follows the errors of Q."""
    bias = (e.scores.get("q_bias") or {}).get("bias", e.late("evaluation/q_bias"))
    if not abs(bias) > 0.5 or e.rose:
        return None
    return f"Q {'over' if bias > 0 else 'under'}-estimates the return by {abs(bias):.0%}."


@rule
def critic_overfits(e: Evidence) -> str | None:
    """Q knows what is in the replay buffer by heart, and not what happens now."""
    times = e.last_half("td_error/newest") / np.maximum(e.last_half("td_error/sampled"), 1e-12)
    if len(times) < 3 or not np.median(times) > 10 or e.rose:
        return None
    return f"The error of Q at the newest transitions is {np.median(times):.0f} times that at sampled ones."


@rule
def plasticity_lost(e: Evidence) -> str | None:
    """Ever fewer units learn."""
    first, late = e.early("network/inactive"), e.late("network/inactive")
    if not late > first + 0.25 or not fell_back(e):
        return None
    return f"Inactive units rose from {first:.0%} to {late:.0%} while returns fell."


@rule
def units_inactive(e: Evidence) -> str | None:
    """Most of the network has no part in what the policy does."""
    share = e.late("network/inactive")
    return f"{share:.0%} of the policy's hidden units are the same at every observation." if share > 0.6 else None


@rule
def units_saturated(e: Evidence) -> str | None:
    """Units at a bound of tanh have no gradient, and say no more than a sign: weights or observations are too large."""
    share = e.late("network/saturated")
    return f"{share:.0%} of what the policy's hidden units say is at a bound of tanh." if share > 0.6 else None


@rule
def gradient_clipped(e: Evidence) -> str | None:
    """Every step has the length of the clip, usually because the value's loss is large."""
    norm, limit = e.late("gradient_norm"), first_number(e.config.get("max_grad_norm"))
    if not limit or not norm > 30 * limit:
        return None
    return f"The late gradient has a norm of {norm:.3g}, and is clipped to 1/{norm / limit:.0f} of it."


@rule
def value_explains_nothing(e: Evidence) -> str | None:
    """The baseline takes no variance away; the observations may not hold what decides the return."""
    explained, late = e.late("explained_variance"), e.ends[1]
    settled = len(late) > 0 and late.std() <= 0.05 * abs(late.mean())  # there is nothing left to explain
    if (
        not -0.3 < explained < 0.05 or settled or np.percentile(e.last_half("explained_variance"), 90) > 0.15
    ):  # below -0.3 targets are constant
        return None
    if "gae_lambda" not in e.config:  # a weak baseline of REINFORCE does no harm
        return None
    return (
        f"The value explains {max(0.0, explained):.0%} of the variance of its targets, no more than a constant would."
    )


@rule
def gets_worse(e: Evidence) -> str | None:
    """The policy learns the opposite: usually the sign of a loss, of the advantage or of the reward."""
    first, last = e.ends
    if not (e.gain < -5 and first.mean() - last.mean() > 0.25 * abs(first.mean())):
        return None
    return (
        f"Returns fell from {first.mean():,.4g} in the first fifth of the episodes to {last.mean():,.4g} in the last."
    )


# --- of the judgement -----------------------------------------------------------------------------------------------


@rule
def evaluated_otherwise(e: Evidence) -> str | None:
    """The policy needs its noise, or the evaluation is of another environment."""
    last, mean = e.ends[1], e.scores.get("mean_return", e.last("evaluation/return"))
    if len(last) < 10:
        return None
    gap, spread = last.mean() - mean, np.ptp(e.returns)
    if not gap > max(0.3 * spread, 3 * last.std() / np.sqrt(len(last))):
        return None
    return f"Training ends at {last.mean():,.4g}, and the deterministic policy has {mean:,.4g} in the evaluation."


@rule
def does_not_learn(e: Evidence) -> str | None:
    """Nothing was learned in so many steps, and no rule says why."""
    first, last = e.ends
    if len(last) < 10 or e.gain > 2 or e.returns.std() == 0:
        return None
    return (
        f"Returns are {last.mean():,.4g} in the last fifth of the episodes, and were {first.mean():,.4g} in the first."
    )


@rule
def ends_early(e: Evidence) -> str | None:
    """A step costs more than it brings, so that the policy learns to end its episodes; right where an end is a goal."""
    fifth = len(e.lengths) // 5
    if fifth < 4 or not e.returns[-fifth:].mean() < 0 or not e.gain > 5 or not e.late("episode/terminated") > 0.9:
        return None
    first, last = np.median(e.lengths[: max(10, fifth // 10)]), np.median(e.lengths[-fifth:])
    return f"Returns rose while episodes went from {first:.0f} steps to {last:.0f}." if last < 0.6 * first else None


@rule
def starts_alike(e: Evidence) -> str | None:
    """The policy knows one beginning, and its evaluation asks no other: it may be helpless elsewhere."""
    alike = e.values("observation/starts_alike")
    return "Every episode began with the same observation." if len(alike) > 2 and alike.min() == 1 else None


@rule
def fell_back(e: Evidence) -> str | None:
    """The final policy is not the best one."""
    window = max(10, len(e.returns) // 20)
    if len(e.returns) < 3 * window:
        return None
    averages = np.convolve(e.returns, np.full(window, 1 / window), "valid")
    fall, error = averages.max() - averages[-1], e.returns[-window:].std() / np.sqrt(window)
    if fall <= 5 * error or fall <= 0.3 * np.ptp(averages) or averages.max() - averages[0] <= 5 * error:
        return None
    return f"Returns fell from {averages.max():,.4g} to {averages[-1]:,.4g} before the end."


@rule
def still_rising(e: Evidence) -> str | None:
    """The run ended before it had learned what it can."""
    fifth = len(e.returns) // 5
    if fifth < 10:
        return None
    before, last = e.returns[-2 * fifth : -fifth], e.returns[-fifth:]
    gain, error = last.mean() - before.mean(), np.hypot(last.std(), before.std()) / np.sqrt(fifth)
    if gain <= 3 * error or gain <= 0.05 * np.ptp(e.returns):
        return None
    return f"Returns were still rising, from {before.mean():,.4g} to {last.mean():,.4g} in the last two fifths."


@rule
def few_episodes(e: Evidence) -> str | None:
    """Another set of starts would give another mean."""
    returns, each = e.scores.get("returns", ()), e.config.get("evaluate_episodes", 20)
    if e.config.get("evaluate_every") and each < 10:
        return f"Each evaluation has {each} {'episode' if each == 1 else 'episodes'}, and the best may be one of luck."
    if not 0 < len(returns) < 20:
        return None
    return f"The evaluation has {len(returns)} episodes, of standard deviation {np.std(returns):,.3g}."


# --- of the settings ------------------------------------------------------------------------------------------------

FAR = 3.0
"""the factor outside of its usual range from which on a setting is named"""

OF_RATIOS = {"rollout_rows": ("num_envs", "num_steps"), "replay_ratio": ("num_updates", "update_every", "num_envs")}
"""what is made of several fields: these"""


def settings_far_out(e: Evidence) -> Sequence[tuple[Rule, str]]:
    """A finding for each setting far outside its usual range that is not as recommended, the farthest first."""
    found = list[tuple[float, Rule, str]]()
    for field, known in read("settings.toml").items():
        low, high = known.get("usual") or e.usual.get(field, (0.0, np.inf))
        if times := known.get("times_recommended"):
            low, high = (e.recommended.get(field, 0) * each for each in times)
        factor = e.beyond(field, low, high)
        means = known.get("small" if factor < 0 else "large")
        if abs(factor) < FAR or not means:
            continue
        size = "far" if field in HORIZONS or np.isinf(factor) else f"{abs(factor):,.0f} times"
        side = "below" if factor < 0 else "above"
        change = [name for name in OF_RATIOS.get(field, (field,)) if e.config[name] != e.recommended.get(name)]
        seen = f"{field} is {e.config[field]}, {size} {side} its usual range, {low:g} to {high:g}."
        remedy = f"{' '.join(f'{flag(name)} {typed(e.recommended.get(name))}' for name in change)}, as recommended"
        sure = POSSIBLE if e.rose else LIKELY
        name = f"setting-{field}".replace("_", "-")
        found.append((abs(factor), Rule(name, lambda _: None, means, "settings", sure, remedy, known["source"]), seen))
    return [(rule, seen) for _, rule, seen in sorted(found, key=lambda each: -each[0])]


def seeds_differ(finals: Sequence[float]) -> str | None:
    """The standard deviation of the final returns over seeds is more than a fifth of their mean; our choice."""
    if len(finals) < 2 or np.std(finals) <= 0.2 * abs(np.mean(finals)):
        return None
    return (
        f"The final returns of its seeds lie from {min(finals):,.4g} to {max(finals):,.4g}:"
        " train more seeds before believing a difference."
    )
