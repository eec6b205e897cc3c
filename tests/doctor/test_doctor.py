"""The doctor: each rule fires at its fault and is silent elsewhere; causes come before consequences; remedies exist."""

import json
import re
from pathlib import Path
from typing import get_type_hints

import gymnasium as gym
import numpy as np
import pytest

import lemniscate as lem
from conftest import tiny_fields, tiny_off_policy
from lemniscate import algos
from lemniscate.cli import main
from lemniscate.doctor import Attendance, Evidence, diagnose, rules
from lemniscate.doctor.evidence import usual_ranges, with_ratios
from lemniscate.doctor.rules import HINT, RULES, seeds_differ, settings_far_out
from lemniscate.run.fields import field_help, read
from lemniscate.run.metrics import read_metrics
from lemniscate.system.files import write_json

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "doctor.md").read_text()
NOISE = np.random.default_rng(0).normal(size=400)
RISES = list(np.arange(400) + NOISE)
FLAT = list(NOISE)

OTHER_METRICS = {"approx_kl", "clip_fraction", "learning_rate", "policy_std", "explained_variance", "gradient_norm"}


def evidence(
    algorithm="ppo",
    returns=FLAT,
    lengths=None,
    scores=None,
    repeats=None,
    varies=None,
    steps=4_000,
    changed=(),
    **metrics,
):
    """Evidence with a line for each value of the metrics, and the same returns in equal parts."""
    kind = algos.find(algorithm).Config
    config, usual = with_ratios(kind().to_json()), usual_ranges(field_help(kind))
    count = max([8, *map(len, metrics.values())])
    lines = [{"step": steps * (i + 1) // count} for i in range(count)]
    for name, values in metrics.items():
        for line, value in zip(lines, values, strict=False):
            line[name.replace("__", "/")] = value
    lengths = [50 + i % 7 for i in range(len(returns))] if lengths is None else lengths
    for line, part, its in zip(lines, np.array_split(returns, count), np.array_split(lengths, count), strict=True):
        line |= {"episode/returns": list(part), "episode/lengths": list(its)}
    tried = {name: {str(value)} for name, value in config.items()}
    given = with_ratios({**kind().to_json(), "total_steps": steps, **dict(changed)})
    return Evidence(given, config, tried, usual, lines, scores or {}, repeats, varies)


def names(*args, **kwargs):
    return [one.name for one in diagnose(evidence(*args, **kwargs)) if one.sure != HINT]


EXACT = {
    # what is seen: the rule, evidence in which it fires, evidence just beside it
    "an action that was not taken": (
        "rows-of-others",
        {"targets__other_actions": 0.5},
        {"targets__other_actions": 0.0},
    ),
    "another policy than acted": ("ratio-not-one", {"gradient__old_policy": 0.1}, {"gradient__old_policy": 1e-5}),
    "a loss that is raised": (
        "advantage-opposed",
        {"gradient__policy": -1.0, "gradient__policy_rest": 0.0},
        {"gradient__policy": 1.0, "gradient__policy_rest": 0.0},
    ),
    "an error that is raised": ("loss-differs", {"gradient__value": -1.0}, {"gradient__value": 1.0}),
    "no gradient": ("loss-differs", {"gradient__policy": 0.0}, {"gradient__policy": 1.0}),
    "a value that weighs too much": (
        "loss-differs",
        {"gradient__policy": 1.0, "gradient__value": 4.0},
        {"gradient__policy": 1.0, "gradient__value": 2.0},
    ),
    "an entropy that is punished": ("entropy-opposed", {"gradient__entropy": -0.01}, {"gradient__entropy": 0.01}),
    "a bootstrap that lacks": ("missing-bootstrap", {"targets__missing": 1.0}, {"targets__missing": 0.0}),
    "a bootstrap of twice": ("targets-differ", {"targets__missing": -1.0}, {"targets__missing": 0.0}),
    "another λ": ("discount-differs", {"targets__trace": 0.5}, {"targets__trace": 0.95}),
    "a discount where targets do not follow": (
        "discount-differs",
        {"targets__discount": 0.9, "targets__unexplained": 1.0, "targets__trace": 0.95},
        {"targets__discount": 0.9, "targets__unexplained": 1.0},
    ),
    "an entropy that is taken off targets": ("entropy-opposed", {"targets__entropy": -1.0}, {"targets__entropy": 1.0}),
    "an entropy that targets lack": ("loss-differs", {"targets__entropy": 0.0}, {"targets__entropy": 1.0}),
    "another loss once the policy has moved": (
        "loss-differs",
        {"gradient__later_rest": 1e-3},
        {"gradient__later_rest": 1e-9},
    ),
    **{
        mistake: (name, {f"gradient__if_{mistake}": 1e-12}, {f"gradient__if_{mistake}": 1e-3})
        for mistake, (name, _) in rules.MISTAKES.items()
    },
}


@pytest.mark.parametrize("case", EXACT)
def test_what_equations_show_is_named(case):
    name, there, beside = EXACT[case]
    assert name in names(**{metric: [value] * 3 for metric, value in there.items()})
    assert name not in names(**{metric: [value] * 3 for metric, value in beside.items()})


def test_an_evaluation_with_another_time_limit_is_named():
    longer = {"evaluation__length": [100.0] * 8}
    assert "evaluated-otherwise" in names(lengths=[25] * 400, **longer)
    assert "evaluated-otherwise" not in names(lengths=[25, *range(5, 24)] * 20, **longer), "most episodes ended before"
    assert "evaluated-otherwise" not in names(lengths=[80] * 400, **longer)


def test_one_lucky_episode_does_not_hide_an_evaluation_of_another_kind():
    worse = {"mean_return": -100.0, "returns": [-100.0] * 20}
    assert "evaluated-otherwise" in names(returns=[1000.0, *FLAT[1:]], scores=worse)


CASES = {
    # rule: evidence in which it fires, evidence just beside it
    "rate-zero": ({"learning_rate": [1e-3] + [0.0] * 7}, {"learning_rate": [1e-3] * 7 + [0.0]}),
    "loss-below-zero": ({"losses__value": [-1.0] * 8}, {"losses__value": [0.0] * 8}),
    "reset-without-effect": ({"observation__goes_on": [1.0] * 8}, {"observation__goes_on": [0.9] * 8}),
    "targets-differ": ({"targets__unexplained": [0.02] * 8}, {"targets__unexplained": [1e-9] * 8}),
    "discount-differs": (
        {"targets__discount": [1.0101] * 8, "targets__unexplained": [0.0] * 8},
        {"targets__discount": [0.9905] * 8, "targets__unexplained": [0.0] * 8},
    ),
    "ends-continued": ({"targets__beyond_ends": [0.02] * 3}, {"targets__beyond_ends": [0.02] * 2}),
    "baseline-differs": ({"advantage__own": [0.9] * 8}, {"advantage__own": [0.995] * 8}),
    "advantage-of-others": ({"advantage__used": [0.3] * 8}, {"advantage__used": [0.995] * 8}),
    "loss-of-others": (
        {"algorithm": "a2c", "losses__value": list(np.linspace(1, 3, 8)), "value__loss": [1.0] * 8},
        {"algorithm": "a2c", "losses__value": [2.0] * 8, "value__loss": [1.0] * 8},
    ),
    "rewards-differ": ({"targets__other_rewards": [0.1] * 2}, {"targets__other_rewards": [1e-12] * 2}),
    "targets-rescaled": ({"targets__rescaled": [0.1] * 2}, {"targets__rescaled": [1e-12] * 2}),
    "targets-forward": ({"targets__forward": [1.0] * 2}, {"targets__forward": [0.0] * 2}),
    "critics-not-least": (
        {"algorithm": "sac", "gradient__if_other_critic": [1e-12] * 2},
        {"algorithm": "sac", "gradient__if_other_critic": [1e-3] * 2},
    ),
    "clip-differs": ({"gradient__if_no_clip": [1e-12] * 2}, {"gradient__if_no_clip": [1e-3] * 2}),
    "rows-of-others": ({"gradient__other_rows": [0.5] * 3}, {"gradient__other_rows": [0.0] * 3}),
    "targets-copied": (
        {"algorithm": "td3", "targets__behind": [0.0] * 4, "targets__length": [1.0, 2.0, 3.0, 4.0]},
        {"algorithm": "td3", "targets__behind": [0.1] * 4, "targets__length": [1.0, 2.0, 3.0, 4.0]},
    ),
    "loss-differs": ({"gradient__policy_rest": [1e-5] * 3}, {"gradient__policy_rest": [1e-9] * 3}),
    "seed-ignored": ({"repeats": False}, {"repeats": True}),
    "constant-observation": ({"observation__constant": [1.0] * 8}, {"observation__constant": [0.99] * 8}),
    "exploding-observation": (
        {"observation__largest": [1.0, 10.0, 1e3, 1e3, 1e4, 1e4, 1e5, 1e5]},
        {"observation__largest": [1.0, 5.0, 200.0, 200.0, 250.0, 290.0, 250.0, 250.0]},
    ),
    "large-observation": (
        {"observation__largest": [900.0] * 8, "changed": {"normalize_observations": False}},
        {"observation__largest": [900.0] * 8},
    ),
    "action-without-effect": ({"action__effect": [0.01, -0.01] * 4}, {"action__effect": [0.5] + [0.0] * 7}),
    "action-part": (
        {"action__weakest": [0.001, -0.002] * 4, "action__effect": [0.5] * 8},
        {"action__weakest": [0.3] + [0.001] * 7, "action__effect": [0.5] * 8},
    ),
    "action-half": ({"action__half": [0.001, 0.0] * 4}, {"action__half": [0.3] + [0.001] * 7}),
    "q-unfollowed": (
        {"algorithm": "td3", "action__preferred": [0.5] * 8, "reward__largest": [1.0] * 8, "steps": 30_000},
        {"algorithm": "td3", "action__preferred": [0.5] * 8, "reward__largest": [0.0] * 8, "steps": 30_000},
    ),
    "steps-short": ({"observation__pace": [0.01] * 5 + [0.1] * 3}, {"observation__pace": [0.01] * 3 + [0.1] * 5}),
    "exploration-still": (
        {"algorithm": "pqn", "epsilon": [1.0] * 8, "changed": {"final_epsilon": 0.01}},
        {"algorithm": "pqn", "epsilon": [1.0] * 7 + [0.9], "changed": {"final_epsilon": 0.01}},
    ),
    "units-alike": ({"network__alike": [1.0] * 8}, {"network__alike": [1.0] * 7 + [0.9]}),
    "observation-of-another": (
        {"action__beside": [0.5] * 8, "action__effect": [0.01] * 8},
        {"action__beside": [0.5] * 8, "action__effect": [0.4] * 8},
    ),
    "action-late": (
        {"action__late": [0.5] * 8, "action__effect": [0.01] * 8},
        {"action__late": [0.5] * 8, "action__effect": [0.4] * 8},
    ),
    "observation-repeated": ({"observation__repeated": [0.7] * 8}, {"observation__repeated": [0.3] * 8}),
    "observation-part": (
        {"observation__constant": [0.5] * 8, "observation__predicted": [0.9] * 8},
        {"observation__constant": [0.5] * 7 + [0.1], "observation__predicted": [0.9] * 8},
    ),
    "observation-noisy": ({"observation__predicted": [0.1] * 8}, {"observation__predicted": [0.1] * 2 + [0.8] * 6}),
    "reward-rare": (
        {"reward__zero": [0.99] * 8, "reward__largest": [5.0] * 8},
        {"reward__zero": [0.5] * 4 + [0.99] * 4, "reward__largest": [5.0] * 8},
    ),
    "ratio-always-one": (
        {"approx_kl": [0.0] * 8, "losses__entropy": list(np.linspace(1.0, 0.5, 8))},
        {"approx_kl": [1e-8] * 8, "losses__entropy": list(np.linspace(1.0, 0.5, 8))},
    ),
    "observation-clipped": (
        {"observation__at_limits": [0.9] * 8, "observation__repeated": [0.9] * 8},
        {"observation__at_limits": [0.9] * 3 + [0.1] * 5},
    ),
    "action-by-sign": ({"action__by_sign": [0.9] * 8}, {"action__by_sign": [0.1] + [0.9] * 7}),
    "critic-still": (
        {"algorithm": "sac", "targets__behind": [0.0] * 8},
        {"algorithm": "sac", "targets__behind": [0.0] * 7 + [0.01]},
    ),
    "network-small": (
        {"algorithm": "ddpg", "changed": {"critic_hidden": []}},
        {"algorithm": "ddpg", "changed": {"critic_hidden": [64]}},
    ),
    "replay-differs": (
        {"algorithm": "sac", "replay__other_limits": [1.0] * 8},
        {"algorithm": "sac", "replay__other_limits": [0.4] * 8},
    ),
    "q-explains-nothing": (
        {"algorithm": "ddpg", "steps": 30_000, "value__explained": [0.1] * 8, "reward__explained": [0.9] * 8},
        {"algorithm": "ddpg", "steps": 30_000, "value__explained": [0.1] * 7 + [0.9], "reward__explained": [0.9] * 8},
    ),
    "replay-part": (
        {"algorithm": "td3", "replay__drawn": [1.0] * 4 + [0.5] * 4},
        {"algorithm": "td3", "replay__drawn": [0.5] * 4 + [0.99] * 4},
    ),
    "entropy-impossible": (
        {"algorithm": "sac", "losses__entropy": [1.4] + [-1.0] * 7, "action__most_entropy": [0.69] * 8},
        {"algorithm": "sac", "losses__entropy": [0.7] + [-1.0] * 7, "action__most_entropy": [0.69] * 8},
    ),
    "acts-at-mode": (
        {"action__off_mode": [0.1] * 8, "losses__entropy": [1.0] * 8},
        {"action__off_mode": [0.1] * 3 + [1.0] * 5, "losses__entropy": [1.0] * 8},
    ),
    "replay-repeated": (
        {"algorithm": "sac", "replay__repeated": [1.0] * 8},
        {"algorithm": "sac", "replay__repeated": [0.3] * 8},
    ),
    "targets-behind": (
        {"algorithm": "td3", "targets__behind": [0.1, 0.2, 0.5, 0.6]},
        {"algorithm": "td3", "targets__behind": [0.6, 0.5, 0.55, 0.6]},
    ),
    "value-runaway": (
        {"losses__value": [0.8] + [8.0] * 7},
        {"losses__value": [0.8] + [8.0] * 7, "changed": {"scale_rewards": False}},
    ),
    "step-refused": (
        {"algorithm": "trpo", "step_fraction": [0.0] * 8, "gradient_norm": [1.0] * 8},
        {"algorithm": "trpo", "step_fraction": [0.0] * 7 + [0.5], "gradient_norm": [1.0] * 8},
    ),
    "entropy-opposed": (
        {"losses__entropy": [1.0, 0.5, 0.2, 0.1] * 2, "changed": {"entropy_coef": 0.5}},
        {"losses__entropy": [1.0, 0.9, 0.9, 0.9] * 2, "changed": {"entropy_coef": 0.5}},
    ),
    "q-opposed": (
        {"algorithm": "td3", "steps": 30_000, "q": [-1.0] * 8, "reward__mean": [1.0] * 8, "reward__std": [0.1] * 8},
        {
            "algorithm": "td3",
            "steps": 30_000,
            "q": [-1.0] * 7 + [1.0],
            "reward__mean": [1.0] * 8,
            "reward__std": [0.1] * 8,
        },
    ),
    "starts-alike": (
        {"observation__starts_alike": [1.0] * 8, "observation__whole": [0.0] * 8},
        {"observation__starts_alike": [1.0] * 8, "observation__whole": [1.0] * 8},
    ),
    "end-not-reported": (
        {"observation__jumps_every": [25.0] * 4},
        {"observation__jumps_every": [25.0] * 3 + [13.0]},
    ),
    "too-few-episodes": (
        {"changed": {"evaluate_every": 1_000, "evaluate_episodes": 2}},
        {"changed": {"evaluate_every": 1_000, "evaluate_episodes": 8}},
    ),
    "advantage-opposed": (
        {"advantage__followed": [-0.2, -0.1] * 4},
        {"advantage__followed": [-0.3, 0.2] * 4},
    ),
    "advantage-unrelated": (
        {"advantage__followed": [-0.02, 0.02] * 4, "approx_kl": [0.01] * 8},
        {"advantage__followed": [0.03, 0.07] * 4, "approx_kl": [0.01] * 8},
    ),
    "ends-ignored": (
        {"value__at_ends": [0.1] * 4 + [0.95, 0.98] * 2, "episode__terminated": [1.0] * 8},
        {"value__at_ends": [0.95] * 4 + [0.6, 0.7] * 2, "episode__terminated": [1.0] * 8},
    ),
    "gradient-grows": ({"gradient_norm": [30.0] + [250.0] * 8}, {"gradient_norm": [30.0] + [140.0] * 8}),
    "ends-early": (
        {
            "returns": list(np.linspace(-90.0, -10.0, 400)),
            "lengths": [90] * 200 + [10] * 200,
            "episode__terminated": [1.0] * 8,
        },
        {"returns": list(np.linspace(-90.0, -10.0, 400)), "lengths": [90] * 400, "episode__terminated": [1.0] * 8},
    ),
    "reward-zero": ({"reward__largest": [0.0] * 8, "returns": [0.0] * 400}, {"reward__largest": [0.0] * 7 + [1.0]}),
    "reward-by-time": ({"reward__by_time": [0.95] * 8}, {"reward__by_time": [0.95] * 3 + [0.1] * 5}),
    "reward-by-episode": (
        {"reward__within": [0.0] * 8, "reward__std": [1.0] * 8},
        {"reward__within": [0.0] * 7 + [0.01], "reward__std": [1.0] * 8},
    ),
    "reward-late": ({"reward__before": [0.3] * 8}, {"reward__before": [0.3] * 3 + [0.1] * 5}),
    "failure-goes-on": (
        {"reward__zero": [0.5] * 4 + [0.99] * 4, "episode__terminated": [0.0] * 8, "reward__mean": [0.01] * 8},
        {"reward__zero": [0.5] * 4 + [0.99] * 4, "episode__terminated": [0.0] * 8, "reward__mean": [-0.01] * 8},
    ),
    "reward-offset": (
        {"reward__mean": [-500.0] * 8, "reward__std": [4.0] * 8, "reward__largest": [510.0] * 8},
        {"reward__mean": [-500.0] * 8, "reward__std": [0.0] * 8},
    ),
    "reward-unexplained": (
        {"reward__explained": [0.0] * 8, "reward__std": [1.0] * 8},
        {"reward__explained": [0.1] * 8, "reward__std": [1.0] * 8},
    ),
    "every-return-alike": ({"returns": [7.0] * 400}, {"returns": [7.0] * 399 + [8.0]}),
    "limit-as-termination": (
        {"lengths": [50] * 300 + [33] + [50] * 99, "episode__terminated": [1.0] * 8},
        {"lengths": [50] * 400, "episode__terminated": [0.0] * 8},
    ),
    "short-episodes": ({"lengths": [1] * 400}, {"lengths": [3] * 400}),
    "reward-large": (
        {"reward__largest": [300.0] * 8, "changed": {"scale_rewards": False}},
        {"reward__largest": [300.0] * 8},
    ),
    "reward-small": ({"reward__largest": [1e-3] * 8}, {"reward__largest": [1e-3] * 7 + [1.0]}),
    "ratio-not-one": (
        {"approx_kl": [0.02] * 8, "learning_rate": [1e-4] * 2 + [1e-6] * 7},
        {"approx_kl": [0.02] * 8, "learning_rate": [1e-4] * 8},
    ),
    "temperature-opposed": (
        {"algorithm": "sac", "temperature": list(np.linspace(1.0, 2.0, 8)), "losses__entropy": [0.6] * 8},
        {"algorithm": "sac", "temperature": list(np.linspace(1.0, 0.5, 8)), "losses__entropy": [0.6] * 8},
    ),
    "targets-alike": (
        {"losses__value": [1e-7] * 8, "reward__std": [1.0] * 8, "reward__mean": [-5.0] * 8},
        {"losses__value": [1e-7] * 8, "reward__std": [0.0] * 8, "reward__mean": [-5.0] * 8},
    ),
    "targets-of-others": (
        {"algorithm": "td3", "td_error__sampled": [2.0] * 8, "losses__critic": [0.1] * 8},
        {"algorithm": "td3", "td_error__sampled": [0.6] * 8, "losses__critic": [0.1] * 8},
    ),
    "normalizer-frozen": (
        {"normalizer__count": [500.0] * 8},
        {"normalizer__count": list(np.linspace(500.0, 4_000.0, 8))},
    ),
    "normalizer-stale": ({"normalizer__offset": [6.0] * 8}, {"normalizer__offset": [6.0] * 3 + [1.0] * 5}),
    "missing-bootstrap": (
        {"value__missing": [2.0] + [0.4] * 8, "episode__terminated": [0.0] * 8},
        {"value__missing": [2.0, 0.4, 0.4] + [0.05] * 6, "episode__terminated": [0.0] * 8},
    ),
    "advantage-not-normalized": (
        {"changed": {"normalize_advantage": False, "scale_rewards": False}},
        {"changed": {"normalize_advantage": False}},
    ),
    "mostly-random": (
        {"algorithm": "sac", "changed": {"learning_starts": 3_900}},
        {"algorithm": "sac", "changed": {"learning_starts": 1_000}},
    ),
    "horizon-short": (
        {"changed": {"gamma": 0.9}, "lengths": [1_000] * 400},
        {"changed": {"gamma": 0.9}, "lengths": [200] * 400},
    ),
    "entropy-unreachable": (
        {"algorithm": "sac", "changed": {"target_entropy": 5.0}, "temperature": [1.0, 9.0]},
        {"algorithm": "sac", "changed": {"target_entropy": -5.0}, "temperature": [1.0, 9.0]},
    ),
    "kl-too-large": ({"approx_kl": [0.05] * 8}, {"approx_kl": [0.05] * 3 + [0.015] * 5}),
    "ratios-clipped": ({"clip_fraction": [0.5] * 8}, {"clip_fraction": [0.3] * 8}),
    "policy-still": ({"approx_kl": [1e-9] * 8}, {"approx_kl": [1e-9] * 8, "returns": RISES}),
    "entropy-collapsed": (
        {"losses__entropy": [1.0] + [0.01] * 8},
        {"losses__entropy": [1.0, 0.8, 0.6, 0.4] + [0.01] * 5},
    ),
    "std-exploded": ({"policy_std": [0.6] + [4.0] * 8}, {"policy_std": [0.6] + [1.5] * 8}),
    "actions-at-bounds": ({"action__at_bounds": [0.95] * 8}, {"action__at_bounds": [0.5] * 8}),
    "value-explains-nothing": ({"explained_variance": [0.02] * 8}, {"explained_variance": [0.4] * 8}),
    "gradient-clipped": ({"gradient_norm": [90.0] * 8}, {"gradient_norm": [20.0] * 8}),
    "units-saturated": ({"network__saturated": [0.9] * 8}, {"network__saturated": [0.3] * 8}),
    "units-inactive": ({"network__inactive": [0.8] * 8}, {"network__inactive": [0.3] * 8}),
    "plasticity-lost": (
        {"network__inactive": [0.1] * 3 + [0.5] * 5, "returns": [*range(300), *[20] * 100]},
        {"network__inactive": [0.1] * 3 + [0.5] * 5, "returns": RISES},
    ),
    "q-biased": (
        {"algorithm": "td3", "scores": {"q_bias": {"bias": 0.8}}, "steps": 30_000},
        {"algorithm": "td3", "scores": {"q_bias": {"bias": 0.3}}, "steps": 30_000},
    ),
    "critic-overfits": (
        {"algorithm": "sac", "td_error__newest": [20.0] * 8, "td_error__sampled": [1.0] * 8},
        {"algorithm": "sac", "td_error__newest": [3.0] * 8, "td_error__sampled": [1.0] * 8},
    ),
    "gets-worse": ({"returns": RISES[::-1]}, {"returns": RISES}),
    "no-episode": ({"returns": [], "lengths": []}, {}),
    "evaluated-otherwise": (
        {"returns": RISES, "scores": {"mean_return": 20.0, "returns": [20.0] * 100}},
        {"returns": RISES, "scores": {"mean_return": 380.0, "returns": [380.0] * 100}},
    ),
    "does-not-learn": ({}, {"returns": RISES}),
    "fell-back": ({"returns": [*range(300), *[20] * 100]}, {"returns": RISES}),
    "still-rising": ({"returns": RISES}, {"returns": list(np.minimum(np.arange(400), 200) + NOISE)}),
    "few-episodes": ({"scores": {"returns": [1.0, 2.0] * 4}}, {"scores": {"returns": [1.0] * 100}}),
}


def test_what_is_certain_is_named_first_of_its_kind_and_hints_last():
    order = [(rule.sure == HINT, rules.KINDS.index(rule.kind), rule.sure != rules.CERTAIN) for rule in RULES]
    assert order == sorted(order)


def test_a_value_that_has_learned_nothing_or_too_little_ignores_no_ends():
    shown = {"value__at_ends": [0.95] * 8, "episode__terminated": [1.0] * 8}
    assert "ends-ignored" in names(**shown, explained_variance=[0.5] * 8, value__missing=[-1.0] * 8)
    assert "ends-ignored" not in names(**shown, explained_variance=[0.01] * 8, value__missing=[-1.0] * 8)
    assert "ends-ignored" in names(**shown, explained_variance=[-1.5] * 8, value__missing=[-7.0] * 8)
    assert "ends-ignored" not in names(**shown, explained_variance=[0.5] * 8, value__missing=[0.6] * 8)


def test_an_evaluation_of_one_episode_is_of_chance():
    assert names(scores={"returns": [1.0]}) == ["too-few-episodes"]
    assert names(scores={"returns": [1.0]}, changed={"evaluate_every": 1_000}) == ["too-few-episodes"]
    one = {"returns": RISES, "scores": {"mean_return": 20.0, "returns": [20.0]}}
    assert names(**one) == ["too-few-episodes"]  # and not evaluated otherwise


def test_a_start_that_is_the_same_is_named_unless_observations_are_whole_numbers():
    assert "starts-alike" not in names(observation__starts_alike=[1.0] * 7 + [0.0], observation__whole=[0.0] * 8)


def test_rewards_that_their_age_explains_beyond_what_is_seen_tell_the_time():
    assert names(reward__by_age=[0.1] * 3 + [0.9] * 5) == ["reward-by-time"]
    assert "reward-by-time" not in names(reward__by_age=[0.9] * 3 + [0.1] * 5)


def test_a_layer_of_one_unit_is_named_even_where_returns_rose():
    assert "network-small" in names(returns=RISES, changed={"hidden": [64, 1]})
    assert "network-small" not in names(returns=RISES, changed={"hidden": [8, 8]})


def test_a_horizon_of_a_tenth_of_the_recommended_is_named_in_shorter_episodes():
    assert "horizon-short" in names(changed={"gamma": 0.8}, lengths=[100] * 400)
    assert "horizon-short" not in names(changed={"gamma": 0.8}, lengths=[60] * 400)
    assert "horizon-short" not in names(changed={"gamma": 0.92}, lengths=[200] * 400)


def test_a_policy_whose_units_are_inactive_stands_still_for_that():
    shown = {"network__inactive": [1.0] * 8, "approx_kl": [1e-9] * 8}
    assert names(**shown) == ["units-inactive"]


def test_a_start_that_no_seed_changes_is_named_though_no_episode_has_ended():
    whole = {"observation__whole": [0.0] * 8}
    assert "starts-alike" in names(**whole, varies=False)
    assert "starts-alike" not in names(**whole, varies=True)
    assert "starts-alike" not in names(observation__whole=[1.0] * 8, varies=False)


def test_rewards_that_stop_for_good_where_no_episode_ends_are_of_failures_that_go_on():
    shown = {"reward__zero": [0.96] * 8, "reward__largest": [1.0] * 8, "reward__mean": [0.01] * 8}
    assert names(**shown, episode__terminated=[0.0] * 8, reward__age=[0.02] * 8) == ["failure-goes-on"]
    assert names(**shown, episode__terminated=[0.0] * 8, reward__age=[0.9] * 8) == ["reward-rare"]
    assert names(**shown, episode__terminated=[0.5] * 8, reward__age=[0.02] * 8) == ["reward-rare"]


def test_a_policy_without_a_gradient_stands_still():
    shown = {"algorithm": "td3", "steps": 30_000, "reward__largest": [1.0] * 8, "action__preferred": [0.5] * 8}
    assert names(**shown, gradient_norm__actor=[0.1] * 4 + [0.0] * 4) == ["policy-still"]
    assert names(**shown, gradient_norm__actor=[0.0] * 4 + [0.1] * 4) == ["q-unfollowed"]


def test_a_value_whose_targets_are_not_those_of_gae_and_that_goes_on_behind_ends_ignores_them():
    shown = {"episode__terminated": [1.0] * 8, "value__missing": [0.5] * 8, "explained_variance": [0.7] * 8}
    assert "ends-ignored" in names(**shown, value__at_ends=[1.6] * 8, value__explained=[-0.3] * 8)
    assert "ends-ignored" not in names(**shown, value__at_ends=[1.6] * 8, value__explained=[0.7] * 8)
    assert "ends-ignored" not in names(**shown, value__at_ends=[0.5] * 8, value__explained=[-0.3] * 8)


def test_a_value_that_no_update_moves_is_named():
    assert names(value__moved=[0.0] * 4) == ["critic-still"]
    assert "critic-still" not in names(value__moved=[0.0] * 3 + [0.1])


def test_a_value_of_one_reward_lacks_its_bootstrap_and_a_reward_of_noise_does_not():
    shown = {"explained_variance": [-0.2] * 8, "value__missing": [70.0, 20.0, 90.0, 50.0]}
    assert names(**shown, reward__explained=[0.5] * 8) == ["missing-bootstrap"]
    assert names(**shown, reward__explained=[0.05] * 8) == ["value-explains-nothing"]
    assert names(**(shown | {"value__missing": [70.0, 9.0, 3.0, 1.0]}), reward__explained=[0.5] * 8) == [
        "value-explains-nothing"
    ]


def test_a_divergence_that_does_not_fall_with_the_learning_rate_is_that_of_another_policy():
    rates = list(np.linspace(1e-3, 0.0, 40))
    shown = {"changed": {"desired_kl": None}, "learning_rate": rates}
    assert "ratio-not-one" in names(approx_kl=[0.05] * 40, **shown)
    assert "ratio-not-one" not in names(approx_kl=list(np.linspace(0.05, 0.0, 40)), **shown)
    assert "ratio-not-one" not in names(approx_kl=[0.05] * 40, **(shown | {"learning_rate": [1e-3] * 40}))


def test_a_value_far_from_what_follows_explains_nothing_though_the_returns_are_all_alike():
    shown = {"explained_variance": [0.02] * 8, "returns": [-500.0 - i % 2 for i in range(400)]}
    assert names(**shown, value__missing=[50.0, -150.0] * 4) == ["value-explains-nothing"]
    assert names(**shown, value__missing=[50.0, 0.4] * 4) == []
    learns = {"explained_variance": [0.1] * 8, "returns": RISES}
    assert names(**learns, value__missing=[50.0, -150.0] * 4) == ["value-explains-nothing"]
    assert names(**learns, value__missing=[50.0, -15.0] * 4) == []


def test_noise_is_no_reward_however_long_an_episode_gets():
    noise = {"reward__explained": [0.0] * 8, "reward__std": [0.5] * 8, "returns": RISES}
    assert names(**noise, reward__mean=[0.5] * 8) == ["reward-unexplained"]
    assert names(**noise, reward__mean=[-5.0] * 8) == []  # a reward for a step that is rare


def test_where_rewards_do_not_vary_there_is_nothing_to_explain():
    """InvertedPendulum: 1 for each step, but 0 where it falls, which is in few of the looks."""
    given = {
        "reward__std": [0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.08, 0.1],
        "reward__mean": [0.99] * 8,
        "returns": [50.0 + i % 7 for i in range(99)],
    }
    assert names(**given, reward__explained=[0.8, 0.0, 0.0, 0.0, 0.0, 0.0, 0.7, 0.7]) == []
    assert names(**given, reward__explained=[0.0] * 8) == ["reward-unexplained"]


def test_a_temperature_rises_where_the_entropy_is_below_its_target():
    rises = {"temperature": list(np.linspace(1.0, 2.0, 8)), "losses__entropy": [-2.0] * 8}
    assert names("sac", **rises) == []
    assert names("sac", **rises, changed={"target_entropy": -3.0}) == ["temperature-opposed"]


def test_targets_that_no_update_moves_are_behind_however_near_they_are():
    shown = {"targets__behind": [0.19, 0.18, 0.17, 0.16]}
    assert names("sac", **shown, targets__length=[32.5] * 4) == ["targets-behind"]
    assert names("sac", **shown, targets__length=[32.5] * 3 + [32.6]) == []


def test_a_gradient_that_grows_while_the_loss_of_the_value_falls_is_named_sooner():
    grows = {"gradient_norm": [1.4] + [40.0] * 8}
    assert names("a2c", **grows, losses__value=[1.2] + [0.1] * 8) == ["gradient-grows"]
    assert "gradient-grows" not in names("a2c", **grows, losses__value=[1.2] + [20.0] * 8)


def test_what_is_large_from_the_beginning_does_not_explode():
    large = {"observation__largest": [1e5] + [2e5] * 7}
    assert names(**large) == []
    assert names(**large, changed={"normalize_observations": False}) == ["large-observation"]
    few = {"observation__largest": [900.0] * 8, "changed": {"normalize_observations": False, "activation": "relu"}}
    assert names(**few, observation__predicted=[0.9] * 8) == ["large-observation"]
    assert names(**few) == []


def test_numbers_that_never_change_are_no_noise():
    still = {"observation__constant": [0.75] * 8, "returns": RISES}
    assert names(**still, observation__predicted=[0.9] * 8) == []
    assert names(**still, observation__predicted=[0.1] * 8) == ["observation-part"]
    assert names(observation__constant=[0.75] * 8) == []  # of many numbers, such as contacts, many stand still


def test_what_noise_hides_is_not_said_of_actions():
    shown = {"action__effect": [0.0] * 8}
    assert names(**shown) == ["action-without-effect"]
    assert names(**shown, observation__predicted=[0.1] * 8) == ["observation-noisy"]


def test_one_of_two_metrics_that_are_compared_is_no_evidence():
    assert "critic-overfits" not in names("sac", td_error__newest=[20.0] * 8)


def test_a_policy_that_never_moves_is_still_whatever_its_algorithm_logs():
    assert "policy-still" in names("a2c", network__moved=[0.0] * 8)
    assert "policy-still" not in names("a2c", network__moved=[0.0] * 7 + [1e-6])


def test_rounded_observations_are_not_taken_for_noise():
    noisy = {"observation__predicted": [0.1] * 8}
    assert names(**noisy, observation__whole=[1.0] * 8) == ["observation-repeated"]
    assert names(**noisy, observation__whole=[0.5] * 8) == ["observation-noisy"]


def test_targets_that_are_behind_by_a_setting_are_no_fault_of_the_learner():
    behind = {"targets__behind": [0.1, 0.2, 0.5, 0.6]}
    assert names("td3", **behind, changed={"policy_delay": 100}) == ["setting-policy-delay"]


def test_advantages_without_relation_are_seen_where_no_divergence_is_logged():
    unrelated = {"advantage__followed": [-0.02, 0.02] * 4}
    assert "advantage-unrelated" in names("a2c", **unrelated, network__moved=[1e-3] * 8)
    assert "advantage-unrelated" not in names("a2c", **unrelated, network__moved=[0.0] * 8)


def test_actions_that_are_paid_have_an_effect_though_the_next_observation_shows_none():
    shown = {"action__effect": [0.0] * 8}
    assert names(**shown, action__paid=[0.01] * 8) == ["action-without-effect"]
    assert names(**shown, action__paid=[0.8] * 8) == []


def test_settings_of_algorithms_of_ones_own_may_be_fewer():
    assert with_ratios({"num_updates": 4, "num_envs": 2})["replay_ratio"] == 2
    assert "replay_ratio" not in with_ratios({"num_envs": 2})


def test_what_chance_explains_of_few_rows_is_no_effect():
    assert names("td3", action__effect=[0.065, 0.014, 0.006, 0.011]) == ["action-without-effect"]
    assert names("td3", action__effect=[0.15, 0.014, 0.006, 0.011]) == []


def test_a_value_that_is_worse_than_a_constant_explains_nothing():
    assert names("a2c", explained_variance=[-0.5] * 8) == ["value-explains-nothing"]
    assert names("a2c", explained_variance=[-2.0] * 8) == []  # of targets that are all the same


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("every-return-alike", {"returns": [-500.0] * 400}),
        ("action-by-sign", {"action__by_sign": [0.9] * 8}),
        ("ends-ignored", {"value__at_ends": [0.95] * 8, "episode__terminated": [1.0] * 8}),
        ("advantage-unrelated", {"advantage__followed": [-0.02, 0.02] * 4, "approx_kl": [0.01] * 8}),
    ],
)
def test_what_a_setting_brings_about_gives_way_to_it(name, shown):
    assert name in names(**shown)
    assert names(**shown, changed={"learning_rate": 0.1}) == ["setting-learning-rate"]


def test_where_every_return_is_alike_the_environment_stands_still_and_not_its_observation():
    assert names(observation__repeated=[0.7] * 8, returns=[50.0] * 400) == ["every-return-alike"]


def test_returns_that_have_arrived_rise_no_more():
    arrived = [*np.linspace(20, 480, 300), *[500] * 100]
    assert "still-rising" not in {one.name for one in diagnose(evidence(returns=arrived))}


def test_an_advantage_is_opposed_where_its_sign_is_though_sizes_vary():
    collapsed = [-0.09, -0.34, -0.1, -0.04, -0.002, -0.07, 0.03]
    assert names(advantage__followed=collapsed, approx_kl=[0.01] * 7) == ["advantage-opposed"]
    small = [each / 4 for each in collapsed]
    assert names(advantage__followed=small, approx_kl=[0.01] * 7) == ["advantage-unrelated"]


def test_observations_that_explode_once_are_named():
    assert names(observation__largest=[100.0, 80.0, 2e4, 7e10, 1e4, 150.0, 70.0, 230.0]) == ["exploding-observation"]
    assert names(observation__largest=[100.0, 80.0, 90.0, 9e4, 100.0, 150.0, 70.0, 230.0]) == []


def test_advantages_that_are_not_centred_are_named():
    weights = {"losses__policy": [5.6, 7.9] * 4}
    assert names("reinforce", **weights) == ["advantage-not-normalized"]
    assert names("reinforce", **weights, changed={"standardize": False}) == []
    assert names("ppo", losses__policy=[-0.6] * 8) == ["advantage-not-normalized"]
    assert names("ppo", losses__policy=[-0.2] * 8) == []
    stale = {"learning_rate": [1e-6] * 8, "approx_kl": [0.05] * 8}
    assert names("ppo", losses__policy=[-0.6] * 8, **stale) == ["ratio-not-one"]


def test_the_sign_of_the_bonus_takes_the_place_of_its_weight():
    fell = {"losses__entropy": [1.0, 0.5, 0.2, 0.1] * 2}
    assert names(**fell, changed={"entropy_coef": 0.5}) == ["entropy-opposed"]
    assert names(losses__entropy=[1.0] * 8, changed={"entropy_coef": 0.5}) == ["setting-entropy-coef"]
    assert names(**fell, changed={"entropy_coef": "0.5>0"}) == ["setting-entropy-coef"]


def test_estimates_of_the_kl_that_differ_tell_of_other_actions():
    other = {"old_approx_kl": [0.08] * 8, "approx_kl": [0.01] * 8, "advantage__followed": [-0.07] * 8}
    assert names(**other) == ["ratio-not-one"]
    assert names(**other | {"old_approx_kl": [0.012] * 8}) == ["advantage-opposed"]


def test_a_value_of_one_reward_is_named_without_gae_too():
    one = {"value__missing": [93.0] * 8, "losses__value": [1e-5] * 8, "reward__std": [0.0] * 8}
    assert names("reinforce", **one) == ["missing-bootstrap"]
    assert names("reinforce", **one | {"losses__value": [1.0] * 8}) == []
    still = {"value__moved": [1e-4] * 8}
    assert names("reinforce", **one, **still) == []


def test_ends_that_v_ignores_may_feed_on_themselves():
    beyond = {"value__at_ends": [1.5] * 8, "episode__terminated": [1.0] * 8, "value__missing": [-3.0] * 8}
    assert names(**beyond) == ["ends-ignored"]
    assert names(**beyond | {"value__missing": [-1.0] * 8}) == []
    assert names(**beyond, changed={"gamma": 0.3}) == ["setting-gamma"]


def test_one_look_is_too_few_for_a_ratio_that_is_not_one():
    def falls(lines):
        rates = list(np.linspace(1e-3, 1e-5, lines))
        return names(approx_kl=[0.03] * lines, learning_rate=rates, changed={"desired_kl": None})

    assert falls(18) == []
    assert falls(40) == ["ratio-not-one"]


def test_q_of_entropies_tells_nothing_of_signs():
    of_entropies = {"q": [1.0] * 8, "reward__mean": [-1.0] * 8, "reward__std": [0.1] * 8}
    assert names("sac", **of_entropies) == []
    hot = {"temperature": [100.0] * 8, "losses__entropy": [0.7] * 8, "reward__largest": [8.0] * 8}
    assert "advantage-opposed" not in names("sac", action__preferred=[0.1] * 8, steps=30_000, **hot)
    cold = hot | {"temperature": [0.1] * 8}
    assert "advantage-opposed" in names("sac", action__preferred=[0.1] * 8, steps=30_000, **cold)


def test_a_value_that_is_not_to_learn_stands_still():
    assert names(value__moved=[0.0] * 4, changed={"value_coef": 0.0}) == ["setting-value-coef"]


def test_what_follows_of_repeated_observations_is_not_named_beside_them():
    repeated = {"observation__repeated": [0.7] * 8, "observation__pace": [0.01] * 8}
    still = {"action__effect": [0.0] * 8, "action__share": [0.0] * 8}
    assert names(**repeated, **still) == ["observation-repeated"]
    assert names(observation__pace=[0.01] * 8, **still) == ["action-without-effect", "steps-short"]


def test_a_policy_that_descends_q_is_named():
    assert names("td3", action__preferred=[0.5] * 3 + [0.2] * 5, steps=30_000) == ["advantage-opposed"]
    assert names("td3", action__preferred=[0.05] * 3 + [0.5] * 5, steps=30_000) == ["q-unfollowed"]
    assert names("td3", action__preferred=[0.05] * 3 + [0.5] * 5, steps=30_000, returns=RISES) == []
    assert names("td3", action__preferred=[0.05] * 3 + [0.7] * 5, steps=30_000) == []
    few = {"update_every": 128}
    assert "advantage-opposed" not in names("td3", action__preferred=[0.1] * 8, steps=30_000, changed=few)
    begun = {"learning_starts": 29_600}
    assert "advantage-opposed" not in names("td3", action__preferred=[0.1] * 8, steps=30_000, changed=begun)


def test_a_q_without_a_gradient_stands_still():
    flat = {"losses__critic": [40.0] * 8, "steps": 30_000}
    assert names("sac", gradient_norm__critic=[3.0] * 3 + [0.0] * 5, **flat) == ["critic-still"]
    assert names("sac", gradient_norm__critic=[0.0] * 7 + [1.0], **flat) == []


def test_both_ends_of_a_schedule_are_looked_at():
    assert names(changed={"entropy_coef": "0>0.5"}) == ["setting-entropy-coef"]
    assert names(changed={"learning_rate": "3e-4>0"}) == []


def test_rollouts_of_a_few_steps_are_named_however_many_environments_there_are():
    assert names(changed={"num_steps": 2, "num_envs": 512}) == ["setting-num-steps"]


def test_rollouts_that_leave_few_updates_are_named_in_a_short_run_alone():
    large = {"num_envs": 16, "num_steps": 1_024}
    assert names(changed=large | {"total_steps": 100_000}) == ["setting-rollout-rows"]  # 6 updates
    assert names(changed=large | {"total_steps": 1_000_000}) == []
    assert names(changed={"total_steps": 10_000}) == []  # few updates of the recommended size


def test_two_choices_that_do_the_same_are_named():
    assert names(action__alike=[0.001] * 8, action__effect=[0.5] * 8) == ["action-part"]
    assert names(action__alike=[0.001] + [0.05] * 7, action__effect=[0.5] * 8) == []
    assert names(action__alike=[0.001] * 8, action__effect=[0.01] * 8) == ["action-without-effect"]


def test_a_value_of_one_reward_is_named_where_all_rewards_are_one():
    far = {"value__missing": [6.0] + [95.0] * 7, "explained_variance": [-29.0] * 8}
    assert names(reward__std=[0.0] * 8, **far) == ["missing-bootstrap"]
    assert names(reward__std=[0.0] * 8, advantage__followed=[-0.02, 0.02] * 4, **far) == ["missing-bootstrap"]


def test_a_policy_that_is_still_because_it_has_collapsed_is_named_so():
    assert names(approx_kl=[0.01] * 3 + [0.0] * 5, losses__entropy=[0.7, 0.6, 0.5, 0.1] + [1e-4] * 4) == [
        "entropy-collapsed"
    ]


def test_an_entropy_that_the_algorithm_chooses_has_not_collapsed():
    assert "entropy-collapsed" in names(policy_std=[1.0, 0.5] + [0.01] * 6)
    assert "entropy-collapsed" not in names("reppo", policy_std=[1.0, 0.5] + [0.01] * 6)
    assert "policy-still" in names("reppo", policy_std=[1.0, 0.5] + [0.01] * 6, approx_kl=[0.01] * 3 + [0.0] * 5)


def test_slow_steps_come_before_rewards_that_time_explains():
    assert names(observation__pace=[0.01] * 8, reward__by_time=[0.95] * 8) == ["steps-short"]


def test_of_a_q_that_has_hardly_learned_no_bias_is_told():
    assert names("sac", scores={"q_bias": {"bias": 0.8}}, steps=4_000) == []


def test_returns_that_fall_while_q_begins_are_no_finding():
    assert "gets-worse" not in names("td3", returns=RISES[::-1], steps=19_000)
    assert "gets-worse" in names("td3", returns=RISES[::-1], steps=30_000)
    assert "gets-worse" not in names("pqn", returns=RISES[::-1], steps=50_000)
    assert "gets-worse" in names("pqn", returns=RISES[::-1], steps=500_000)


def test_advantages_that_are_followed_by_chance_alone_are_unrelated_however_strongly():
    assert names(advantage__followed=[0.4, -0.3] * 8, approx_kl=[0.01] * 16) == ["advantage-unrelated"]
    assert names(advantage__followed=[0.4, 0.0] * 8, approx_kl=[0.01] * 16) == []


@pytest.mark.parametrize(
    ("moved", "changed", "found"), [(1e-5, {}, True), (0.1, {}, False), (1e-5, {"learning_rate": 1e-9}, False)]
)
def test_a_loss_of_the_mean_advantage_is_named_and_none_of_a_rate_that_moves_nothing(moved, changed, found):
    """A policy's loss of 0 is that of shapes that broadcast; where the rate moves nothing, ratios of 1 say so too."""
    seen = names(losses__policy=[1e-8, -1e-8] * 4, network__moved=[moved] * 8, changed=changed)
    assert ("advantage-unrelated" in seen) == found


def test_what_chance_explains_of_the_first_look_is_no_late_action():
    first = {"action__effect": [0.06, 0.01, 0.0] + [0.0] * 5}
    assert "action-late" not in names(**first, action__late=[0.2] + [0.03] * 7)
    assert "action-late" in names(**first, action__late=[0.7, 0.23, 0.21] + [0.2] * 5)


def test_an_advantage_that_falls_by_two_standard_errors_is_opposed():
    followed = [0.009, -0.141, -0.134, -0.057, 0.005, 0.016, -0.011, -0.074]
    metrics = {"approx_kl": [0.01] * 8, "advantage__followed": followed}
    assert names(**metrics) == ["advantage-opposed"]
    assert "advantage-opposed" not in names(**metrics | {"advantage__followed": [x + 0.02 for x in followed]})


def test_a_q_of_returns_explains_them():
    """PQN's Q, of λ-returns; where every return is alike there is nothing left to explain."""
    metrics = {"algorithm": "pqn", "steps": 50_000, "explained_variance": [0.05] * 8, "reward__explained": [0.9] * 8}
    assert names(**metrics) == ["q-explains-nothing"]
    assert "q-explains-nothing" not in names(**metrics | {"explained_variance": [0.05] * 7 + [0.6]})
    assert "q-explains-nothing" not in names(**metrics | {"reward__explained": [0.0] * 8})


def test_rewards_that_time_explains_later_are_what_the_policy_has_made_of_them():
    assert names(reward__by_time=[0.9] * 8) == ["reward-by-time"]
    assert names("trpo", reward__by_time=[0.1] + [0.9] * 7, kl=[0.9] * 8) == ["kl-too-large"]


@pytest.mark.parametrize("column", ["actions", "next", "signs", "ends", "limits"])
def test_what_is_stored_otherwise_is_named_by_its_column_and_before_what_follows(column):
    metrics = {f"replay__other_{each}": [float(each == column)] * 8 for each in ("actions", "next", "signs", "ends")}
    metrics["replay__other_limits"] = [float(column == "limits")] * 8
    follows = {"td_error__newest": [20.0] * 8, "td_error__sampled": [1.0] * 8}
    assert names("sac", **metrics, **follows) == ["replay-differs"]
    assert names("sac", **metrics, **follows, replay__repeated=[1.0] * 8) == ["replay-repeated"]  # which says more


def test_a_deterministic_policy_is_near_its_mode():
    assert "acts-at-mode" not in names("td3", action__off_mode=[0.1] * 8)
    alone = {"action__off_mode": [0.003] * 8, "action__effect": [0.0] * 8}
    assert names("td3", **alone) == ["acts-at-mode"]  # actions that are never varied show no effect


AT_MODE = {"action__off_mode": [0.0] * 8, "losses__entropy": [1.0] * 8}
UNRELATED = {"advantage__followed": [0.01, -0.01] * 4}


@pytest.mark.parametrize(
    ("algorithm", "cause", "metrics"),
    [
        ("sac", "targets-behind", {"targets__behind": [0.1, 0.2, 0.5, 0.6], "action__preferred": [0.3] * 8}),
        (
            "ppo",
            "critic-still",
            {
                "value__moved": [0.0] * 8,
                "losses__value": [0.0] * 8,
                "reward__mean": [1.0] * 8,
                "reward__std": [1.0] * 8,
            },
        ),
        ("ppo", "acts-at-mode", AT_MODE | {"approx_kl": [0.0] * 8}),
        ("ppo", "acts-at-mode", AT_MODE | UNRELATED | {"approx_kl": [0.01] * 8}),
        ("sac", "acts-at-mode", AT_MODE | {"action__preferred": [0.5] * 8, "reward__largest": [1.0] * 8}),
        ("ppo", "advantage-opposed", AT_MODE | {"advantage__followed": [-0.2, -0.1] * 4}),
        ("ppo", "kl-too-large", UNRELATED | {"approx_kl": [0.9] * 8}),
    ],
)
def test_a_cause_in_the_learner_is_named_alone(algorithm, cause, metrics):
    assert names(algorithm, **metrics, steps=30_000) == [cause]


def test_rewards_that_are_centred_are_not_of_the_other_sign():
    assert names("sac", replay__other_signs=[0.5] * 8) == []


def test_a_value_without_targets_of_its_own_is_judged_by_those_of_gae():
    assert names(value__explained=[0.0] * 8, losses__value=[0.5] * 8) == ["value-explains-nothing"]


def test_a_new_q_of_the_other_sign_is_not_named():
    opposed = {"q": [-1.0] * 8, "reward__mean": [1.0] * 8, "reward__std": [0.1] * 8}
    assert "q-opposed" not in names("td3", **opposed, steps=1_500)
    assert "q-opposed" in names("td3", **opposed, steps=12_000)


def test_a_v_of_the_other_sign_is_named():
    opposed = {"value__mean": [3.0] * 8, "value__missing": [-2.0] * 8, "reward__mean": [-6.0] * 8}
    assert names(**opposed, reward__std=[3.0] * 8) == ["q-opposed"]
    assert names(**opposed, reward__std=[9.0] * 8) == []  # rewards of both signs
    assert names(**opposed | {"value__mean": [3.0] * 7 + [-1.0]}, reward__std=[3.0] * 8) == []
    assert names(**opposed | {"value__mean": [-3.0] * 8}, reward__std=[3.0] * 8) == []  # V is too large


def test_a_value_that_is_behind_by_ever_other_shares_lacks_no_bootstrap():
    limited = {"episode__terminated": [0.0] * 8}
    assert names(value__missing=[0.9, 1.0] * 4, **limited) == ["missing-bootstrap"]
    assert names(value__missing=[0.5, 1.2] * 4, **limited) == []


def test_a_value_that_stays_a_tenth_of_what_follows_has_one_reward_in_it():
    shown = {"explained_variance": [0.1] * 8, "losses__value": [0.5] * 8, "reward__explained": [0.9] * 8}
    assert names(value__missing=[13.0, 14.0] * 4, **shown) == ["missing-bootstrap"]
    assert names(value__missing=[13.0, 6.0] * 4, **shown) == []


def test_a_value_is_judged_by_the_targets_of_gae_too():
    own = {"explained_variance": [0.95] * 8, "losses__value": [0.5] * 8}
    assert names(**own, value__explained=[0.6] * 8) == []
    assert names(**own, value__explained=[0.0] * 8) == ["value-explains-nothing"]
    constant = {"explained_variance": [-1e9] * 8, "losses__value": [0.0] * 8}
    assert names(**constant, value__explained=[0.0] * 8) == ["value-explains-nothing"]
    assert names(**constant) == []


def test_of_reppo_the_sign_the_divergence_and_the_bootstrap_are_judged():
    assert "advantage-opposed" in names("reppo", action__preferred=[0.05] * 8, steps=100_000)
    assert "kl-too-large" in names("reppo", kl=[0.5] * 8)
    assert "missing-bootstrap" in names("reppo", value__missing=[30.0] * 8, reward__explained=[0.5] * 8)
    assert names("reppo", value__missing=[0.5] * 8, episode__terminated=[0.0] * 8) == []  # Q is on its way


def test_every_rule_has_a_case():
    assert CASES.keys() == {rule.name for rule in RULES}


@pytest.mark.parametrize("seed", range(60))
def test_no_rule_fails_whatever_there_is_in_a_log(seed):
    rng = np.random.default_rng(seed)
    metrics = sorted({name for fires, _ in CASES.values() for name in fires if "__" in name} | OTHER_METRICS)
    values = np.array([0.0, -1.0, 1e-12, 0.5, 1.0, 150.0, 1e30, np.inf, np.nan])
    chosen = {
        name: rng.choice(values, size=rng.integers(1, 12)).tolist() for name in metrics if rng.random() < rng.random()
    }
    episodes = rng.integers(0, 60)
    returns = rng.choice([0.0, 1.0, -3.0, 1e9], size=episodes) * rng.choice([0.0, 1.0, rng.normal()], size=episodes)
    scores = {"mean_return": float(rng.choice(values)), "returns": [1.0] * rng.integers(0, 30), "q_bias": None}
    given = evidence(
        rng.choice(list(algos.ALGORITHMS)),
        returns=list(returns),
        lengths=list(rng.integers(1, 4, size=episodes)),
        scores=rng.choice(np.array([scores, {}])),
        repeats=None,
        **chosen,
    )
    for one in diagnose(given):
        assert one.seen
        assert one.remedy
        assert len(one.steps) == len(one.values)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_rule_fires_at_its_fault_and_is_silent_beside_it_and_without_metrics(rule):
    fires, silent = CASES[rule.name]
    found = {one.name: one for one in diagnose(evidence(**fires))}
    assert rule.name in found
    assert found[rule.name].sure == rule.sure
    assert rule.name not in {one.name for one in diagnose(evidence(**silent))}
    assert rule.name in {"does-not-learn"} or rule.name not in {one.name for one in diagnose(evidence())}


@pytest.mark.parametrize(
    ("algorithm", "changed", "name"),
    [
        ("ppo", {"learning_rate": 0.01}, "setting-learning-rate"),
        ("ppo", {"learning_rate": "1e-5>0"}, "setting-learning-rate"),
        ("ppo", {"gamma": 0.5}, "setting-gamma"),
        ("ppo", {"gae_lambda": 0.5}, "setting-gae-lambda"),
        ("ppo", {"entropy_coef": 0.1}, "setting-entropy-coef"),
        ("ppo", {"initial_log_std": -4.0}, "setting-initial-log-std"),
        ("ppo", {"num_envs": 1}, "setting-rollout-rows"),
        ("sac", {"tau": 1.0}, "setting-tau"),
        ("sac", {"num_updates": 20}, "setting-replay-ratio"),
        ("sac", {"buffer_size": 1_000}, "setting-buffer-size"),
        ("sac", {"batch_size": 4}, "setting-batch-size"),
        ("trpo", {"max_kl": 1.0}, "setting-max-kl"),
        ("pqn", {"final_epsilon": 1.0}, "setting-final-epsilon"),
    ],
)
def test_a_setting_far_outside_its_usual_range_is_named_first_and_its_remedy_is_the_recommended_run(
    algorithm, changed, name
):
    first = diagnose(evidence(algorithm, changed=changed))[0]
    assert first.name == name
    flags = dict(re.findall(r"--([a-z-]+) ([^ ,]+)", first.remedy))
    config = algos.find(algorithm).Config()
    hints = get_type_hints(type(config), include_extras=True)
    cure = {
        field: read(field, hints[field], value) for field, value in ((k.replace("-", "_"), v) for k, v in flags.items())
    }
    assert config.replace(**{**changed, **cure}) == config


@pytest.mark.parametrize(
    ("algorithm", "changed"),
    [
        ("ppo", {"learning_rate": 1e-3}),
        ("ppo", {"gamma": 0.9, "clip": 0.1, "epochs": 15}),
        ("ppo", {"num_envs": 64, "num_steps": 64}),
        ("ppo", {"desired_kl": None, "max_grad_norm": None, "target_kl": None}),
        ("sac", {"buffer_size": 10_000}),  # all of the run
        ("sac", {"num_envs": 8, "num_updates": 8}),
    ],
)
def test_a_usual_setting_is_not_named(algorithm, changed):
    assert not settings_far_out(evidence(algorithm, changed=changed))


@pytest.mark.parametrize("algorithm", algos.ALGORITHMS)
def test_the_defaults_and_all_presets_are_never_named(algorithm):
    for preset in [None, *lem.presets.of(algorithm)]:
        changed = preset.config.to_json() if preset else {}
        e = evidence(algorithm, changed=changed, steps=changed.get("total_steps", 4_000))
        tried = {name: {*e.tried.get(name, ()), str(value)} for name, value in e.config.items()}
        assert not settings_far_out(Evidence(e.config, e.recommended, tried, e.usual, e.log, {}))


def test_beside_a_cause_its_consequences_are_not_named():
    symptoms = {"approx_kl": [0.5] * 8, "clip_fraction": [0.9] * 8, "explained_variance": [0.0] * 8}
    assert names(**symptoms) == ["kl-too-large", "ratios-clipped", "value-explains-nothing"]
    assert names(**symptoms, repeats=False) == ["seed-ignored"]
    assert names(**symptoms, changed={"learning_rate": 0.1}) == ["setting-learning-rate"]


@pytest.mark.parametrize("algorithm", algos.ALGORITHMS)
def test_no_remedy_names_a_flag_that_the_algorithm_does_not_have(algorithm):
    config = algos.find(algorithm).Config().to_json()
    known = {*config, "episodes", "stochastic", "env_args"}
    for rule in RULES:
        remedy = rule.remedy_for(config)
        assert remedy[0].isupper() or remedy.startswith("--")
        assert {flag.replace("-", "_") for flag in re.findall(r"--([a-z-]+)", remedy)} <= known
        memory = "--network gru" in rule.remedy and "sequence_length" in config  # where one can be learned with
        assert ("--network gru" in remedy) == memory


def test_no_remedy_is_to_turn_on_what_is_on():
    rule = next(rule for rule in RULES if rule.name == "reward-large")
    config = algos.find("ppo").Config().to_json()
    assert "--scale-rewards" in rule.remedy_for(config | {"scale_rewards": False})
    assert "--scale-rewards" not in rule.remedy_for(config | {"scale_rewards": True})


def test_a_remedy_that_is_in_force_already_is_left_out():
    rule = next(rule for rule in RULES if rule.name == "fell-back")
    config = algos.find("ppo").Config().to_json()
    assert "--desired-kl none" in rule.remedy_for(config)
    assert "--final-learning-rate" not in rule.remedy_for(config)  # it is 0
    annealed = rule.remedy_for(config | {"desired_kl": None, "final_learning_rate": 0.5})
    assert "--desired-kl" not in annealed
    assert "--final-learning-rate 0" in annealed


def test_the_page_has_a_paragraph_for_each_rule_and_no_other():
    anchors = re.findall(r"^### ([a-z-]+)$", PAGE, re.MULTILINE)
    assert set(anchors) == {rule.name for rule in RULES} | {"setting"}
    for rule in RULES:
        for part in (rule.means, rule.source, rule.remedy.split("; ")[0]):
            assert part in " ".join(PAGE.split())
        for page in re.findall(r"^docs/[a-z_/]+\.md", rule.source):
            assert (ROOT / page).exists()


def test_the_page_has_a_row_for_each_setting():
    for name, known in rules.read("settings.toml").items():
        assert f"| `{name}` | {known.get('small', '–')} | {known.get('large', '–')} | {known['source']} |" in PAGE


def test_seeds_that_differ_are_pointed_at():
    assert "from 100 to 200" in seeds_differ([100.0, 200.0])
    assert seeds_differ([100.0, 101.0]) is None
    assert seeds_differ([100.0]) is None


def test_the_verb_and_the_command_agree_on_a_run(tmp_path, capsys):
    run = lem.train("ppo", "Countdown-v0", run=tmp_path / "r", progress=False, **tiny_fields(gamma=0.3, num_steps=64))
    found = lem.diagnose(run)
    assert "setting-gamma" in [one.name for one in found]
    assert lem.diagnose(str(run.path)) == lem.diagnose(run.policy) == found
    main(["doctor", str(run.path), "--json"])
    out, err = capsys.readouterr()
    assert [one["name"] for one in json.loads(out)["runs"][str(run.path)]] == [one.name for one in found]
    assert "--gamma 0.99, as recommended" in err
    main(["check", str(run.path)])  # its earlier name
    assert capsys.readouterr().err == err


@pytest.mark.long
def test_a_sweep_is_each_of_its_runs(tmp_path, capsys):
    fields = tiny_fields(entropy_coef=0.5, num_steps=64, total_steps=512)
    del fields["seed"]
    sweep = lem.train_sweep(["ppo"], "toy:Matching-v0", seeds=[1, 2], run=tmp_path / "s", progress=False, **fields)
    main(["doctor", str(sweep.path), "--json"])
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert len(runs) == 2
    assert {found[0]["name"] for found in runs.values()} == {"setting-entropy-coef"}


def test_a_run_of_replay_is_diagnosed(tmp_path):
    run = lem.train("sac", "Pendulum-v1", run=tmp_path / "r", progress=False, **tiny_off_policy(tau=1.0))
    assert "setting-tau" in [one.name for one in lem.diagnose(run)]


def test_what_is_no_run_is_a_sentence(tmp_path):
    with pytest.raises(lem.UserError, match=r"config\.json"):
        lem.diagnose(tmp_path)


def test_an_environment_that_is_gone_costs_a_rule_and_no_more(tmp_path):
    run = lem.train("ppo", "Countdown-v0", run=tmp_path / "r", progress=False, **tiny_fields())
    record = json.loads((run.path / "config.json").read_text())
    assert "seed-ignored" not in [one.name for one in lem.diagnose(run)]
    record["config"]["env"] = "nowhere:Env"
    write_json(run.path / "config.json", {name: value for name, value in record.items() if name != "crc32"})
    assert "seed-ignored" not in [one.name for one in lem.diagnose(run.path)]


class Zeros(gym.ObservationWrapper):
    """Of the observation, only zeros."""

    def observation(self, observation):
        return 0 * observation


def test_what_is_certain_is_said_once_while_a_run_is_trained(tmp_path, capsys):
    fields = tiny_fields("CartPole-v1", total_steps=32 * 40, wrappers=(f"{__name__}:Zeros",))
    lem.train("ppo", "CartPole-v1", run=tmp_path / "r", **fields)
    looks = [line for line in read_metrics(tmp_path / "r") if "reward/mean" in line]
    assert len(looks) > 4  # from the fourth on it speaks
    said = [line for line in capsys.readouterr().err.splitlines() if "The policy sees nothing" in line]
    assert len(said) == 1
    assert "Look at what step() returns" in said[0]
    lem.train("ppo", "CartPole-v1", run=tmp_path / "quiet", progress=False, **fields)
    assert "sees nothing" not in capsys.readouterr().err
    assert lem.diagnose(tmp_path / "quiet")[0].name == "constant-observation"


def test_of_a_healthy_run_nothing_is_said(tmp_path, capsys):
    lem.train("ppo", "Matching-v0", run=tmp_path / "r", **tiny_fields("Matching-v0", total_steps=32 * 20))
    said = capsys.readouterr().err
    assert not [rule.name for rule in RULES if rule.means in said]


class Seedless(gym.Wrapper):
    """Resets that do not use the seed."""

    def reset(self, *, seed=None, options=None):
        return self.env.reset(options=options)


def test_an_environment_that_does_not_use_its_seed_is_found_out(tmp_path):
    fields = tiny_fields("CartPole-v1", wrappers=(f"{__name__}:Seedless",))
    run = lem.train("ppo", "CartPole-v1", run=tmp_path / "r", progress=False, **fields)
    assert lem.diagnose(run)[0].name == "seed-ignored"


def test_final_returns_of_a_sweep_that_differ_much_are_pointed_at(tmp_path, capsys):
    for seed, final in ((1, 10.0), (2, 100.0)):
        fields = tiny_fields("Matching-v0", seed=seed)
        run = lem.train("ppo", "Matching-v0", run=tmp_path / f"ppo-{seed}", progress=False, **fields)
        write_json(run.path / "final.json", {"mean_return": final, "step": 256})
    write_json(tmp_path / "sweep.json", {"seeds": [1, 2], "configs": {"ppo": run.policy.config.to_json()}})
    main(["doctor", str(tmp_path)])
    assert "final returns of its seeds lie from 10 to 100" in capsys.readouterr().err


def test_reset_rows_that_no_normalizer_sees_are_no_frozen_one():
    """REINFORCE with whole episodes counts more steps than it learns from; so do episodes of one step."""
    seen = {"normalizer__count": list(np.linspace(250, 1_900, 8))}
    assert "normalizer-frozen" in names(**seen | {"normalizer__count": list(np.linspace(250, 1_000, 8))})
    assert "normalizer-frozen" not in names(**seen)
    assert "normalizer-frozen" not in names(
        algorithm="reinforce", changed={"episodes": 1}, normalizer__count=[250.0] * 8
    )


def test_a_policy_that_is_frozen_is_to_stand_still():
    assert "policy-still" in names(approx_kl=[0.0] * 8)
    assert "policy-still" not in names(approx_kl=[0.0] * 8, changed={"freeze": ["policy"]})


@pytest.mark.parametrize("was_paid", [False, True])
def test_what_is_said_of_rewards_in_training_is_of_all_episodes(was_paid, capsys):
    """A look sees the newest steps alone, of which none may have been paid."""
    attend = Attendance(algos.find("ppo").Config(env="CartPole-v1"))
    attend.was_paid = was_paid
    for step in range(6):
        attend(step, {"reward/largest": 0.0, "reward/std": 0.0, "reward/zero": 1.0})
    assert ("Every reward was 0" in capsys.readouterr().err) != was_paid


def test_a_ratio_of_fields_of_which_an_algorithm_of_ones_own_lacks_one_is_told_of_the_others():
    given = {"num_updates": 64, "num_envs": 1}
    found = settings_far_out(Evidence(with_ratios(given), {"num_updates": 1, "replay_ratio": 1.0}, {}, {}, [], {}))
    assert [rule.name for rule, _ in found] == ["setting-replay-ratio"]


def test_an_advantage_that_is_turned_round_is_opposed_whatever_it_is_compared_with():
    for name in ("advantage__own", "advantage__used"):
        assert names(**{name: [-1.0] * 8}) == ["advantage-opposed"]


def test_what_an_update_learns_from_is_judged_by_equations_that_it_has():
    """REINFORCE may weigh by the return of the episode, or without a baseline; others have no λ."""
    off = {"targets__unexplained": [0.5] * 8, "advantage__own": [0.5] * 8}
    assert names(algorithm="reinforce", **off) == ["targets-differ", "baseline-differs"]
    assert names(algorithm="reinforce", changed={"returns": "episode"}, **off) == []
    assert names(algorithm="reinforce", changed={"baseline": "none"}, advantage__own=[0.5] * 8) == []
    assert names(algorithm="reppo", **off) == []
    several = {"losses__value": list(np.linspace(1, 3, 8)), "value__loss": [1.0] * 8}
    assert names(algorithm="ppo", **several) == []


def test_a_share_of_random_actions_that_moves_away_from_its_end_does_not_follow_its_schedule():
    given = {"algorithm": "pqn", "changed": {"final_epsilon": 0.05}}
    assert names(epsilon=list(np.linspace(0.05, 1.0, 8)), **given) == ["exploration-still"]
    assert names(epsilon=list(np.linspace(1.0, 0.05, 8)), **given) == []


def test_rows_that_nobody_has_stored_are_a_part_of_the_buffer():
    rows = {"replay__empty": [0.99] * 8, "replay__repeated": [0.99] * 8, "replay__drawn": [1.0] * 8}
    assert names(algorithm="ddpg", **rows) == ["replay-part"]
