"""Seeds, environments and their statistics: the right ones pass, each well-known mistake is named."""

import random
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation

import lemniscate as lem
from course_findings import says
from lemniscate import course

# --- seeds ---


def seeds(python=True, numpy=True, torch_=True, cudnn=True, benchmark=True, seed=None):
    def set_seeds(asked):
        number = asked if seed is None else seed
        if python:
            random.seed(number)
        if numpy:
            np.random.seed(number)  # noqa: NPY002
        if torch_:
            torch.manual_seed(number)
        if cudnn:
            torch.backends.cudnn.deterministic = True
        if benchmark:
            torch.backends.cudnn.benchmark = False

    return set_seeds


def test_seeds_are_set_and_the_check_leaves_none_behind():
    before = random.getstate(), torch.get_rng_state(), torch.backends.cudnn.benchmark
    deterministic = torch.are_deterministic_algorithms_enabled()
    assert course.check(seeds(), "set_seeds")
    assert course.check(lem.set_seeds)
    assert random.getstate() == before[0]
    assert torch.equal(torch.get_rng_state(), before[1])
    assert torch.backends.cudnn.benchmark == before[2]
    assert torch.are_deterministic_algorithms_enabled() == deterministic


@pytest.mark.parametrize(
    ("forgotten", "words"),
    [
        ({"python": False}, "random.seed(seed) is missing"),
        ({"numpy": False}, "np.random.seed(seed) is missing"),
        ({"torch_": False}, "torch.manual_seed(seed) is missing"),
        ({"cudnn": False}, "cudnn.deterministic = True is missing"),
        (
            {"benchmark": False},
            "benchmark mode may choose other kernels in each run. Likely: cudnn.benchmark = False is missing",
        ),
        ({"seed": 42}, "seeded by another number than the argument"),
    ],
)
def test_a_forgotten_seed_is_named(forgotten, words):
    says(seeds(**forgotten), "set_seeds", words)


# --- environments ---


def vector(number):
    return SyncVectorEnv([partial(gym.make, "CartPole-v1")] * number)


def normalized(number, update=True):
    envs = NormalizeObservation(vector(number))
    envs.update_running_mean = update
    return envs


def test_two_vectors_pass():
    assert course.check(lambda n_envs, n_eval_envs, train_device: (vector(n_envs), vector(n_eval_envs)), "make_envs")

    def made(env_name, n_envs, n_eval_envs):
        return lem.make_vec(env_name, n_envs), lem.make_vec(env_name, n_eval_envs)

    plain = course.check(made, "make_envs")
    assert plain
    assert "Note: neither normalizes observations" in plain.sentence
    both = course.check(lambda n_envs, n_eval_envs: (normalized(n_envs), normalized(n_eval_envs, False)), "make_envs")
    assert str(both) == "✓ make_envs: right."


def one_for_both(n_envs, n_eval_envs):
    envs = vector(n_envs)
    return envs, envs


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda n_envs, n_eval_envs: vector(n_envs), "should return two vector environments"),
        (one_for_both, "both are the same environments"),
        (lambda n_envs, n_eval_envs: (vector(n_eval_envs), vector(n_envs)), "n_envs and n_eval_envs are exchanged"),
        (lambda n_envs, n_eval_envs: (vector(n_envs), vector(n_envs)), "and 3 and 3 made"),
        (lambda n_envs, n_eval_envs: (normalized(n_envs), vector(n_eval_envs)), "only one of the two normalizes"),
        (lambda n_envs, n_eval_envs: (normalized(n_envs), normalized(n_eval_envs)), "eval_envs.update_running_mean"),
        (lambda n_envs, n_eval_envs: (normalized(n_envs, False), normalized(n_eval_envs, False)), "never change"),
        (lambda n_envs, wind: None, "its parameter wind is none of those"),
    ],
)
def test_other_vectors_do_not(make, words):
    says(make, "make_envs", words)


def rms(envs):
    while not hasattr(envs, "obs_rms"):
        envs = envs.env
    return envs.obs_rms


def sync_envs(train_envs, eval_envs):
    mine, theirs = rms(eval_envs), rms(train_envs)
    mine.mean, mine.var, mine.count = theirs.mean.copy(), theirs.var.copy(), theirs.count


def std_for_variance(train_envs, eval_envs):
    sync_envs(train_envs, eval_envs)
    rms(eval_envs).var = np.sqrt(rms(train_envs).var)


def mean_alone(train_envs, eval_envs):
    rms(eval_envs).mean = rms(train_envs).mean.copy()


def goes_on_counting(train_envs, eval_envs):
    sync_envs(train_envs, eval_envs)
    eval_envs.env.update_running_mean = True


def on_the_outside(train_envs, eval_envs):
    eval_envs.obs_rms = rms(train_envs)


@pytest.mark.parametrize(
    ("sync", "words"),
    [
        (lambda train_envs, eval_envs: None, "the mean of evaluation is not that of training"),
        (lambda train_envs, eval_envs: sync_envs(eval_envs, train_envs), "copies in the wrong direction"),
        (mean_alone, "the variance of evaluation is not that of training"),
        (std_for_variance, "it is the standard deviation"),
        (goes_on_counting, "an evaluation changes the statistics"),
        (on_the_outside, "not set in the wrapper that normalizes"),
    ],
)
def test_statistics_are_copied_whole_and_one_way(sync, words):
    assert str(course.check(sync_envs)) == "✓ sync_envs: right."
    says(sync, "sync_envs", words)
