"""How often the doctor is right: runs with injected faults, and healthy runs.

    .venv/bin/python benchmarks/doctor.py faults --half even --seeds 101      of these the thresholds are chosen
    .venv/bin/python benchmarks/doctor.py faults --half odd --seeds 1 2 3     the half of the table
    .venv/bin/python benchmarks/doctor.py faults --half unseen                faults that nobody had in mind
    .venv/bin/python benchmarks/doctor.py faults --half unseen-too            and others, after rules for these
    .venv/bin/python benchmarks/doctor.py faults --half unseen-three          and others again
    .venv/bin/python benchmarks/doctor.py faults --half unseen-four           and again; and unseen-five, unseen-six
    .venv/bin/python benchmarks/doctor.py faults --half elsewhere --seeds 1   under other algorithms, elsewhere
    .venv/bin/python benchmarks/doctor.py healthy
    .venv/bin/python benchmarks/doctor.py remedies --seeds 1 2 3
    .venv/bin/python benchmarks/doctor.py cost
    .venv/bin/python benchmarks/doctor.py table
    … --runs DIR           keep the runs there; one that is there is not trained again, only diagnosed

A fault counts as named first where the first finding is one of its names, hints left out. Each row of
`benchmarks/results/doctor.jsonl` is one run. The faults are those of `faulty.py`, and settings.
"""

import argparse
import re
import shutil
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

import faulty
import unseen
import unseen_five
import unseen_four
import unseen_six
import unseen_three
import unseen_too
from common import append, provenance, rows
from elsewhere import ELSEWHERE

import lemniscate as lem
from lemniscate import presets
from lemniscate.algos import ALGORITHMS, find
from lemniscate.errors import NonFiniteError, UserError
from lemniscate.run import run as loop
from lemniscate.run import updates
from lemniscate.run.fields import read

ON = {"CartPole-v1": 50_000, "LunarLander-v3": 120_000, "HalfCheetah-v5": 120_000}
"""environments of faults under PPO, with the steps of a run"""
OFF = {"Pendulum-v1": 3_000, "Reacher-v5": 3_000, "InvertedPendulum-v5": 3_000}
"""environments of faults under SAC"""
BOX = {"HalfCheetah-v5": 120_000, "Pendulum-v1": 60_000, "InvertedPendulum-v5": 60_000}
"""environments of faults under PPO that continuous actions have"""
LIMITED = {"Pendulum-v1": 60_000, "Reacher-v5": 60_000, "MountainCar-v0": 60_000}
"""environments whose episodes end at a short time limit"""
QUICK = {"learning_starts": 1_000, "log_every": 100}
"""fields of SAC in a short run"""

FAULTS: dict[str, tuple[str, Mapping[str, int], Mapping[str, Any], tuple[str, ...]]] = {
    # fault: algorithm, environments, fields or the name of a change in `faulty.LEARNERS`, names that are right
    "reward never nonzero": ("ppo", ON, {"wrappers": ("faulty:NoReward",)}, ("reward-zero",)),
    "rewards too large": (
        "ppo", ON, {"wrappers": ("faulty:ScaledReward(scale=10000)",), "scale_rewards": False}, ("reward-large",)
    ),
    "rewards too small": (
        "ppo", ON, {"wrappers": ("faulty:ScaledReward(scale=0.0001)",), "scale_rewards": False}, ("reward-small",)
    ),
    "rewards of noise": ("ppo", ON, {"wrappers": ("faulty:NoisyReward",)}, ("reward-unexplained",)),
    "rewards that tell the time": ("ppo", ON, {"wrappers": ("faulty:TimedReward",)}, ("reward-by-time",)),
    "one return for all": ("ppo", ON, {"wrappers": ("faulty:SameReturn",)}, ("every-return-alike",)),
    "constant observations": ("ppo", ON, {"wrappers": ("faulty:Frozen",)}, ("constant-observation",)),
    "exploding observations": ("ppo", ON, {"wrappers": ("faulty:Drifting",)}, ("exploding-observation",)),
    "observations in another unit": (
        "ppo", ON, {"wrappers": ("faulty:Degrees",), "normalize_observations": False}, ("large-observation",)
    ),
    "actions without effect": ("ppo", ON, {"wrappers": ("faulty:Deaf",)}, ("action-without-effect",)),
    "a limit as a termination": ("ppo", ON, {"wrappers": ("faulty:LimitAsEnd",)}, ("limit-as-termination",)),
    "ends that are not reported": ("ppo", ON, {"wrappers": ("faulty:Endless",)}, ("no-episode",)),
    "episodes of one step": ("ppo", ON, {"wrappers": ("faulty:OneStep",)}, ("short-episodes",)),
    "a seed without effect": ("ppo", ON, {"wrappers": ("faulty:Seedless",)}, ("seed-ignored",)),
    "learning rate too high": (
        "ppo", ON, {"learning_rate": 0.03, "desired_kl": None}, ("setting-learning-rate", "kl-too-large")
    ),
    "learning rate too low": (
        "ppo", ON, {"learning_rate": 3e-6, "desired_kl": None}, ("setting-learning-rate", "policy-still")
    ),
    "γ too small": ("ppo", ON, {"gamma": 0.5}, ("setting-gamma",)),
    "entropy bonus too large": ("ppo", ON, {"entropy_coef": 0.3}, ("setting-entropy-coef",)),
    "clip too small": ("ppo", ON, {"clip": 0.001}, ("setting-clip",)),
    "too many epochs": ("ppo", ON, {"epochs": 60, "desired_kl": None}, ("setting-epochs", "kl-too-large")),
    "minibatches too small": ("ppo", ON, {"minibatch_size": 16, "epochs": 4}, ("setting-minibatch-size",)),
    "rollouts too short": (
        "ppo", ON, {"num_envs": 2, "num_steps": 32, "minibatch_size": 64}, ("setting-rollout-rows",)
    ),
    "λ of one step": ("ppo", ON, {"gae_lambda": 0.2}, ("setting-gae-lambda",)),
    "value without weight": ("ppo", ON, {"value_coef": 1e-4}, ("setting-value-coef",)),
    "gradient cut to nothing": ("ppo", ON, {"max_grad_norm": 1e-4}, ("setting-max-grad-norm",)),
    "advantages not normalized": (
        "ppo", ON, {"normalize_advantage": False, "scale_rewards": False}, ("advantage-not-normalized",)
    ),
    "σ collapsed": ("ppo", BOX, {"initial_log_std": -6.0}, ("setting-initial-log-std",)),
    "σ exploded": ("ppo", BOX, {"initial_log_std": 2.5}, ("setting-initial-log-std",)),
    "a ratio that is not 1": ("ppo", ON, "another log-probability", ("ratio-not-one",)),
    "a frozen normalizer": ("ppo", ON, "a normalizer that stops", ("normalizer-frozen",)),
    "a policy that is frozen": ("ppo", ON, {"freeze": ("policy",)}, ("policy-still",)),
    "the sign of the advantage": ("ppo", ON, "the sign of the advantage", ("advantage-opposed", "gets-worse")),
    "a value of other rows": ("ppo", ON, "targets of other rows", ("value-explains-nothing",)),
    "saturated units": ("ppo", ON, "weights that are too large", ("units-saturated",)),
    "no target networks": ("sac", OFF, QUICK | {"tau": 1.0}, ("setting-tau",)),
    "targets that stand still": ("sac", OFF, QUICK | {"tau": 1e-5}, ("setting-tau",)),
    "replay ratio too high": (
        "sac", OFF, QUICK | {"num_updates": 16, "total_steps": 2_200}, ("setting-replay-ratio", "critic-overfits")
    ),
    "replay ratio too low": ("sac", OFF, QUICK | {"update_every": 20}, ("setting-replay-ratio",)),
    "replay buffer too small": ("sac", OFF, QUICK | {"buffer_size": 300}, ("setting-buffer-size",)),
    "mostly at random": (
        "sac", OFF, QUICK | {"learning_starts": 2_900, "total_steps": 3_000}, ("mostly-random",)
    ),
    "temperature too high": ("sac", OFF, QUICK | {"initial_temperature": 100.0}, ("setting-initial-temperature",)),
    "entropy asked for too high": ("sac", OFF, QUICK | {"target_entropy": 5.0}, ("entropy-unreachable",)),
    "critic's rate too high": (
        "sac", OFF, QUICK | {"critic_learning_rate": 0.1}, ("setting-critic-learning-rate",)
    ),
    "policy's rate too high": ("sac", OFF, QUICK | {"actor_learning_rate": 0.1}, ("setting-actor-learning-rate",)),
    "no bootstrap at time limits": ("ppo", LIMITED, "no bootstrap at time limits", ("missing-bootstrap",)),
    "batches too small": ("sac", OFF, QUICK | {"batch_size": 4}, ("setting-batch-size",)),
}  # fmt: skip

UNSEEN = {
    "reward only at the end": ("reward-rare",),
    "a life that costs": ("ends-early",),
    "observations as whole numbers": ("observation-repeated", "constant-observation"),
    "observations under noise": ("observation-noisy",),
    "actions that are too weak": ("action-without-effect",),
    "actions that come late": ("action-late",),
    "few updates in all": ("setting-rollout-rows", "setting-minibatch-size"),
    "a learning rate that rises": ("setting-learning-rate", "kl-too-large"),
    "Adam's ε too large": ("setting-adam-eps", "policy-still"),
    "many environments, one gradient step": ("setting-replay-ratio",),
    "a policy that waits": ("setting-policy-delay",),
    "old probabilities of the new policy": ("ratio-always-one",),
    "episodes that run into each other": ("ends-ignored",),
    "advantages of other steps": ("advantage-unrelated",),
    "no zero_grad": ("gradient-grows",),
    "the best of single episodes": ("too-few-episodes", "few-episodes"),
}
"""names that are right for the faults of `unseen.py`"""
UNSEEN_TOO = {
    "observations at their limits": ("observation-clipped",),
    "frames that are shown again": ("observation-repeated",),
    "bounds in another unit": ("action-by-sign",),
    "the same start each time": ("starts-alike",),
    "an entropy out of reach": ("entropy-unreachable",),
    "bins that are too narrow": ("setting-value-range",),
    "noise that drowns the policy": ("setting-noise-std", "actions-at-bounds"),
    "targets that stay": ("targets-behind",),
    "an array with two names": ("replay-repeated",),
    "a column times a row": ("policy-still", "advantage-unrelated"),
}
"""names that are right for the faults of `unseen_too.py`"""
UNSEEN_THREE = {
    "a running total": ("reward-by-time",),
    "positions without speeds": ("action-late",),
    "a battery that is never charged": (),
    "parts in the order of a set": (),
    "a trust region of next to nothing": ("setting-max-kl", "policy-still"),
    "a decay factor for ε": ("setting-final-epsilon",),
    "a temperature that cannot fall": ("setting-min-temperature",),
    "a critic without hidden layers": ("network-small",),
    "a policy that descends Q": ("advantage-opposed", "gets-worse"),
    "critics that nobody asks": ("critic-still",),
    "actions that were not taken": ("advantage-unrelated",),
    "one target for all actions": (),
}
"""names that are right for the faults of `unseen_three.py`; none where there is no rule"""
UNSEEN_FOUR = {
    "a constant in the reward": ("reward-offset",),
    "sensors that are not connected": ("observation-part",),
    "units from millionths to millions": ("large-observation",),
    "failures that end nothing": ("failure-goes-on",),
    "a reward for the beginning": ("reward-by-episode",),
    "a reward that comes a step late": ("reward-late",),
    "a motor without a cable": ("action-part",),
    "observations of a while ago": ("action-late",),
    "a watchdog that nobody knows of": ("limit-as-termination",),
    "a coin for a reward": ("reward-unexplained",),
    "rewards cut off at zero": ("reward-zero",),
    "one array for all copies": ("observation-of-another",),
    "targets that pull Q back": ("targets-behind",),
    "a temperature that runs away": ("temperature-opposed",),
    "ends that Q does not know of": ("ends-ignored",),
    "a value of the advantages": ("value-explains-nothing",),
    "a ratio upside down": ("advantage-opposed", "gets-worse"),
}
"""names that are right for the faults of `unseen_four.py`; none where there is no rule"""
UNSEEN_FIVE = {
    "a servo that nobody observes": ("action-late",),
    "steps that are too short": ("steps-short",),
    "a motor that does not run backwards": ("action-half",),
    "two choices that are one": ("action-part",),
    "a limit before the goal": ("every-return-alike",),
    "an entropy bonus that grows": ("setting-entropy-coef",),
    "two steps to a rollout": ("setting-num-steps",),
    "weights that are all alike": ("units-alike",),
    "a Q that cannot be negative": ("critic-still",),
    "one less γ": ("missing-bootstrap",),
    "ε of a whole number": ("exploration-still",),
    "no gradient of Q": ("q-unfollowed",),
}
"""names that are right for the faults of `unseen_five.py`; none where there is no rule"""
UNSEEN_SIX = {
    "observations that grow": ("exploding-observation",),
    "sizes of advantages": ("advantage-not-normalized",),
    "a minus in the target": ("q-opposed",),
    "rows that do not belong together": ("ratio-not-one",),
    "a value that counts for nothing": ("setting-value-coef",),
    "a temperature far too high": ("setting-initial-temperature",),
    "a reward for each action alone": ("missing-bootstrap",),
    "forwards in time": ("value-runaway",),
    "no ends": ("ends-ignored", "value-runaway"),
    "limits are ends": ("missing-bootstrap",),
    "the wrong way": ("step-refused",),
    "a bonus with a minus": ("entropy-opposed",),
}
"""names that are right for the faults of `unseen_six.py`"""
SETS = (
    (UNSEEN, unseen.UNSEEN),
    (UNSEEN_TOO, unseen_too.UNSEEN_TOO),
    (UNSEEN_THREE, unseen_three.UNSEEN_THREE),
    (UNSEEN_FOUR, unseen_four.UNSEEN_FOUR),
    (UNSEEN_FIVE, unseen_five.UNSEEN_FIVE),
    (UNSEEN_SIX, unseen_six.UNSEEN_SIX),
)
FAULTS |= {name: (*faults[name][:3], right) for named, faults in SETS for name, right in named.items()}
for name, algorithm, env, steps, change in ELSEWHERE:
    FAULTS[f"{name}: {algorithm}, {env}"] = (algorithm, {env: steps}, change or FAULTS[name][2], FAULTS[name][3])
OF_SETS = {
    name: change
    for each in (unseen, unseen_too, unseen_three, unseen_four, unseen_five, unseen_six)
    for name, change in each.LEARNERS.items()
}
LEARNERS = faulty.LEARNERS | {name: lambda _, change=change: change() for name, change in OF_SETS.items()}
"""the library with a fault in it, as a context, for the name of an algorithm"""

BY_OPTIONS = {"large-observation", "reward-large", "reward-small", "advantage-not-normalized", "mostly-random",
              "entropy-unreachable"}  # fmt: skip
"""findings whose remedy is an option"""
CURED_IN = {
    "ppo": {"CartPole-v1": 50_000, "InvertedPendulum-v5": 100_000, "HalfCheetah-v5": 200_000},
    "sac": {"Pendulum-v1": 6_000, "InvertedPendulum-v5": 6_000},
}
"""environments in which a remedy is tried, with the steps of a run; a fault may have its own"""

HEALTHY = ("CartPole-v1", "Acrobot-v1", "LunarLander-v3", "Pendulum-v1", "MountainCarContinuous-v0", "HalfCheetah-v5",
           "Hopper-v5", "Walker2d-v5", "Ant-v5", "Swimmer-v5", "InvertedPendulum-v5", "Reacher-v5",
           "InvertedDoublePendulum-v5", "BipedalWalker-v3", "Pusher-v5", "Humanoid-v5")  # fmt: skip
MOST = {"sac": 4_000, "td3": 4_000, "ddpg": 4_000}
"""steps of a healthy run at most; of other algorithms 60,000"""


def trained(path: Path, algorithm: str, env: str, fault: str | None = None, **fields: Any) -> Path:
    """The directory of a run, which is trained if it is not there; a loss that is not finite ends it."""
    if not (path / "metrics.jsonl").exists():
        shutil.rmtree(path, ignore_errors=True)
        with LEARNERS[fault](algorithm) if fault else nullcontext():
            try:
                lem.train(algorithm, env, run=path, progress=False, **fields)
            except NonFiniteError as error:
                print(error)
        shutil.rmtree(path / "checkpoints", ignore_errors=True)
    return path


def one_fault(name: str, env: str, seed: int, folder: Path) -> list[str]:
    """The names of the findings on a run with a fault, in their order."""
    algorithm, steps, change, _ = FAULTS[name]
    fields = {"preset": "default", "seed": seed, "total_steps": steps[env], "checkpoint_every": 10_000_000}
    fault = change if isinstance(change, str) else None
    fields |= {} if fault else change
    path = folder / f"{name}-{env}-{seed}".replace(" ", "_").replace("/", "_")
    found = lem.diagnose(trained(path, algorithm, env, fault, **fields))
    return [one.name for one in found if one.sure != "hint" or one.name in FAULTS[name][3]]


def healthy_runs() -> list[tuple[str, str, str, int]]:
    """(algorithm, environment, preset, seed): all presets of these environments, and the defaults elsewhere."""
    found = []
    for algorithm in ALGORITHMS:
        own = {(preset.config.env, preset.name) for preset in presets.of(algorithm)}
        for env in HEALTHY:
            names = sorted(name for its, name in own if its == env) or ["default"]
            found += [(algorithm, env, name, 1) for name in names]
    return found


def one_healthy(algorithm: str, env: str, preset: str, seed: int, folder: Path) -> list[str] | None:
    """The names of the findings on a healthy run; None where the algorithm cannot learn the environment."""
    path = folder / f"{algorithm}-{env}-{preset}-{seed}"
    try:
        config = lem.config_for(algorithm, env, preset)
        steps = min(config.total_steps, MOST.get(algorithm, 60_000))
        steps = max(steps, 1_100 * config.num_envs)  # so that an episode ends
        fields = {"preset": preset, "seed": seed, "total_steps": steps, "compile": "off"}
        if algorithm in MOST:
            fields["learning_starts"] = min(config.learning_starts, steps // 4)
            fields["log_every"] = 100
        found = lem.diagnose(trained(path, algorithm, env, **fields))
    except UserError as error:
        print(algorithm, env, preset, error)
        return None
    return [one.name for one in found if one.sure != "hint"]


def curable(name: str) -> bool:
    """Whether options alone cure the fault: not where the environment or the learner has to be mended."""
    return any(one.startswith("setting-") or one in BY_OPTIONS for one in FAULTS[name][3])


def trained_return(path: Path, algorithm: str, env: str, seed: int, fields: Mapping[str, Any]) -> float:
    """The mean return of the final policy over 20 episodes, in the unit of the environment's own reward."""
    if not (path / "return").exists():
        shutil.rmtree(path, ignore_errors=True)
        shared = {"preset": "default", "seed": seed, "compile": "off", "progress": False}
        run = lem.train(algorithm, env, run=path, **shared, **fields)
        scale = re.search(r"scale=([\d.]+)", str(fields.get("wrappers", "")))
        mean = lem.evaluate(run.policy, episodes=20).mean_return
        (path / "return").write_text(str(mean / (float(scale[1]) if scale else 1)))
    return float((path / "return").read_text())


def remedied(algorithm: str, env: str, fields: Mapping[str, Any], remedy: str) -> dict[str, Any]:
    """Fields with the options that a remedy names; one that it names without a value takes the recommended one."""
    usual = lem.config_for(algorithm, env, "default")
    hints = get_type_hints(find(algorithm).Config)
    found = dict(fields)
    for option, text in re.findall(r"--([a-z-]+)(?: (none|on|off|[\d._e-]*\d))?", remedy):
        field = option.replace("-", "_")
        found[field] = read(field, hints[field], text) if text else getattr(usual, field) or True
    return found


def cured(name: str, env: str, seed: int, folder: Path) -> list[float]:
    """Mean returns of the final policies: with the fault, with the doctor's remedies, and without the fault.

    The remedy of the first finding is applied, the run is trained again, and so on, up to three times.
    """
    algorithm, _, change, _ = FAULTS[name]
    total = change.get("total_steps", CURED_IN[algorithm][env])
    healthy = {"total_steps": total, **(QUICK if algorithm == "sac" else {})}
    healthy |= {name: change[name] for name in ("desired_kl",) if name in change}  # which would adapt a fault away
    path = folder / f"{name}-{env}-{seed}".replace(" ", "_")
    fields = {**healthy, **change}
    with_fault = trained_return(path, algorithm, env, seed, fields)
    shared = "-".join(f"{value}" for value in healthy.values())
    without = trained_return(folder / f"{algorithm}-{env}-{seed}-{shared}", algorithm, env, seed, healthy)
    config_of = partial(lem.config_for, algorithm, env, "default")
    with_remedy = with_fault
    for visit in range(3):
        first = next((one.remedy for one in lem.diagnose(path) if one.sure != "hint"), "")
        before, fields = fields, remedied(algorithm, env, fields, first)
        if config_of(**fields) == config_of(**before):
            break
        if config_of(**fields) == config_of(**healthy):
            return [with_fault, without, without]  # the same run, to the bit
        path = path.with_name(f"{path.name}-remedy-{visit}")
        with_remedy = trained_return(path, algorithm, env, seed, fields)
    return [with_fault, with_remedy, without]


def cost() -> None:
    """The share of training that the signals take, those of gradients too, measured inside the run, one thread."""
    spent, inside = [0.0], [False]

    def timed(measure: Callable[..., Any]) -> Callable[..., Any]:
        def of(*args: Any, **rest: Any) -> Any:
            if inside[0]:  # one of them calls another
                return measure(*args, **rest)
            inside[0], began = True, time.perf_counter()
            try:
                return measure(*args, **rest)
            finally:
                spent[0] += time.perf_counter() - began
                inside[0] = False

        return of

    loop.signals, loop.acted_with = timed(loop.signals), timed(loop.acted_with)
    for name in ("minibatch_signals", "old_policy_signals", "gradient_signals", "mistake_signals"):
        setattr(updates, name, timed(getattr(updates, name)))
    for algorithm, env, steps in (
        ("ppo", "CartPole-v1", 50_000),
        ("ppo", "HalfCheetah-v5", 200_000),
        ("sac", "Pendulum-v1", 8_000),
    ):
        spent[0] = 0.0
        with tempfile.TemporaryDirectory() as scratch:
            fields = {"total_steps": steps, "compile": "off", "progress": False}
            run = lem.train(algorithm, env, preset="default", run=f"{scratch}/run", **fields)
        print(f"{algorithm} {env}: {spent[0] / run.seconds:.2%} of {run.seconds:.0f} s", flush=True)


HALVES = {name: "elsewhere" if ":" in name else ("even", "odd")[i % 2] for i, name in enumerate(FAULTS)}
HALVES |= dict.fromkeys(UNSEEN, "unseen") | dict.fromkeys(UNSEEN_TOO, "unseen-too")
HALVES |= dict.fromkeys(UNSEEN_THREE, "unseen-three") | dict.fromkeys(UNSEEN_FOUR, "unseen-four")
HALVES |= dict.fromkeys(UNSEEN_FIVE, "unseen-five") | dict.fromkeys(UNSEEN_SIX, "unseen-six")


def table(half: str | None) -> None:
    """The shares of faults that are named, by fault, the false alarms, and what remedies gave."""
    judged = {(row["fault"], row["env"], row["seed"]): row["found"] for row in rows("doctor") if "fault" in row}
    by_fault = defaultdict(list)
    for (fault, _, seed), found in judged.items():
        if seed < 100 and half in (None, HALVES[fault]):
            right = FAULTS[fault][3]
            by_fault[fault].append((found[:1] and found[0] in right, any(name in right for name in found[:3])))
    for fault, each in by_fault.items():
        first, third = (sum(map(bool, column)) for column in zip(*each, strict=True))
        print(f"| {fault} | {', '.join(FAULTS[fault][3])} | {first} of {len(each)} | {third} of {len(each)} |")
    every = [pair for each in by_fault.values() for pair in each]
    if every:
        first, third = (sum(map(bool, column)) / len(every) for column in zip(*every, strict=True))
        print(f"| all | | {first:.1%} | {third:.1%} |")
    fine = {
        (row["algorithm"], row["env"], row["preset"], row["seed"]): row["found"]
        for row in rows("doctor")
        if "preset" in row
    }
    alarms = {key: found for key, found in fine.items() if found}
    print(f"false alarms: {len(alarms)} of {len(fine)}", alarms)
    cures = {(row["remedy"], row["env"], row["seed"]): row["returns"] for row in rows("doctor") if "remedy" in row}
    for name, env in dict.fromkeys(key[:2] for key in cures):
        each = [returns for key, returns in cures.items() if key[:2] == (name, env)]
        means = (f"{sum(column) / len(each):,.1f}" for column in zip(*each, strict=True))
        print(f"| {name} | {env} | {len(each)} | {' | '.join(means)} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["faults", "healthy", "remedies", "cost", "table"])
    parser.add_argument(
        "--half",
        choices=[
            "even",
            "odd",
            "unseen",
            "unseen-too",
            "unseen-three",
            "unseen-four",
            "unseen-five",
            "unseen-six",
            "elsewhere",
        ],
    )
    parser.add_argument("--only", nargs="+", help="these faults, or algorithms of healthy runs")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    parser.add_argument("--runs", type=Path)
    given = parser.parse_args()
    with nullcontext(given.runs) if given.runs else tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        names = [name for name, half in HALVES.items() if given.half in (None, half)]
        for name in names if given.what == "faults" else []:
            for env in FAULTS[name][1] if not given.only or name in given.only else ():
                for seed in given.seeds:
                    found = one_fault(name, env, seed, folder)
                    append("doctor", {"fault": name, "env": env, "seed": seed, "found": found, **provenance()})
                    right = found[:1] and found[0] in FAULTS[name][3]
                    print("✓" if right else "✗", name, env, seed, found, flush=True)
        for algorithm, env, preset, seed in healthy_runs() if given.what == "healthy" else ():
            if given.only and algorithm not in given.only:
                continue
            found = one_healthy(algorithm, env, preset, seed, folder)
            if found is not None:
                row = {"algorithm": algorithm, "env": env, "preset": preset, "seed": seed, "found": found}
                append("doctor", row | provenance())
                print("✗" if found else "✓", algorithm, env, preset, found, flush=True)
        for name in (given.only or filter(curable, FAULTS)) if given.what == "remedies" else ():
            for env in [env for env in CURED_IN[FAULTS[name][0]] if env in {**FAULTS[name][1], **BOX}]:
                for seed in given.seeds:
                    returns = cured(name, env, seed, folder)
                    row = {"remedy": name, "env": env, "seed": seed, "returns": returns}
                    append("doctor", row | provenance())
                    print(name, env, seed, *(f"{value:.1f}" for value in returns), flush=True)
        if given.what == "cost":
            cost()
        if given.what == "table":
            table(given.half)
