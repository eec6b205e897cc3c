"""Seeds, environments and their statistics: the right ones pass, each well-known mistake is named."""

import copy
import functools
import os
import random
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward, RecordEpisodeStatistics

import lemniscate as lem
from course_findings import Solutions, passes_from_a_file, says
from lemniscate import course

ALL = Solutions()
is_right, is_wrong = ALL.is_right, ALL.is_wrong

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
        (lambda a, b, c, d, e, wind: None, "its parameter wind is none of those"),
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


# --- in other styles ---


@is_right("set_seeds")
def with_more(zahl, streng=True):
    os.environ["PYTHONHASHSEED"] = str(zahl)
    for seed in (random.seed, np.random.seed, torch.manual_seed):
        seed(zahl)
    torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = streng, not streng
    torch.use_deterministic_algorithms(streng, warn_only=True)


@is_right("set_seeds")
def where_there_is_a_gpu(seed: int = 0) -> None:
    seeds(cudnn=False, benchmark=False)(seed)
    if torch.cuda.is_available():
        torch.cuda.manual_seed_all(seed)
        torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark = True, False


@is_right("set_seeds")
def with_generators(seed, /, *, device="cpu"):
    seeds()(int(seed))
    return np.random.default_rng(seed), torch.Generator().manual_seed(seed)


def hidden(function):
    """A decorator without `functools.wraps`."""

    def logging(*args, **options):
        return function(*args, **options)

    return logging


class Setup:
    set_seeds = staticmethod(seeds())

    @classmethod
    def seed_all(cls, seed):
        cls.set_seeds(seed)

    def __call__(self, seed):
        self.set_seeds(seed)


for solution in (Setup.set_seeds, Setup.seed_all, Setup(), hidden(seeds()), functools.wraps(seeds())(hidden(seeds()))):
    is_right("set_seeds")(solution)


def after(*more):
    """Seeds, and calls that undo them; each is given the seed."""
    return lambda seed: [call(seed) for call in (seeds(), *more)]


for words, solution in {
    "NumPy is not seeded": lambda seed: [seeds(numpy=False)(seed), np.random.default_rng(seed)],
    "torch is not seeded": lambda seed: [seeds(torch_=False)(seed), torch.cuda.manual_seed_all(seed)],
    "torch.manual_seed(seed)": lambda seed: [seeds(torch_=False)(seed), torch.Generator().manual_seed(seed)],
    "another number": seeds(seed=0),
    "NumPy is seeded by another number": after(lambda seed: np.random.seed(seed + 1)),  # noqa: NPY002
    "torch is seeded by another number": after(lambda seed: torch.seed()),
    "random is seeded by another number": after(lambda seed: random.seed()),
    "random.seed(seed) is missing": lambda seed: None,
    "it raised SystemExit": lambda seed: exit(),
    "it raised NameError": lambda seed: seed_everything(seed),  # noqa: F821
}.items():
    is_wrong("set_seeds", words)(solution)


class Tensors:
    """No wrapper of Gymnasium, and without its spaces."""

    def __init__(self, envs):
        self._inner, self.num_envs = envs, envs.num_envs

    def reset(self, **options):
        return torch.as_tensor(self._inner.reset(**options)[0]), {}

    def close(self):
        self._inner.close()


def wrapped(number):
    """Without spaces, too."""
    envs = Tensors(vector(number))
    envs.reset = envs._inner.reset
    return envs


def rescaled(env_id, number):
    return SyncVectorEnv([lambda: gym.wrappers.RescaleAction(gym.make(env_id), -1, 1)] * number)


def sharing(n_envs, n_eval_envs):
    train, evaluation = normalized(n_envs), normalized(n_eval_envs, False)
    evaluation.obs_rms = train.obs_rms
    return RecordEpisodeStatistics(train), evaluation


class Laboratory:
    def vector(self, number, update):
        return normalized(number, update)

    def make_envs(self, n_envs, n_eval_envs):
        return self.vector(n_envs, True), self.vector(n_eval_envs, False)


for solution in (
    sharing,
    Laboratory.make_envs,
    lambda n_envs, n_eval_envs: (NormalizeReward(normalized(n_envs)), NormalizeReward(normalized(n_eval_envs, False))),
    lambda n_envs, n_eval_envs, train_device: [normalized(n_envs), normalized(n_eval_envs, False)],
    lambda anzahl, anzahl_test, ort="cpu": (Tensors(normalized(anzahl)), Tensors(normalized(anzahl_test, False))),
    lambda num_envs, num_eval_envs, device, seed=0: [gym.make_vec("CartPole-v1", n) for n in (num_envs, num_eval_envs)],
    lambda env_id, n_envs, n_eval_envs, **options: [lem.make_vec(env_id, n) for n in (n_envs, n_eval_envs)],
    lambda n_envs, n_eval_envs, env_name="No-v0": [rescaled(env_name, n) for n in (n_envs, n_eval_envs)],
    lambda *numbers: [vector(number) for number in numbers],
    lambda **numbers: (vector(numbers["n_envs"]), vector(numbers["n_eval_envs"])),
    hidden(lambda n_envs, n_eval_envs, train_device: (vector(n_envs), vector(n_eval_envs))),
):
    is_right("make_envs")(solution)


def on_the_outer_wrapper(n_envs, n_eval_envs):
    train, evaluation = (RecordEpisodeStatistics(normalized(n)) for n in (n_envs, n_eval_envs))
    evaluation.update_running_mean = False
    return train, evaluation


def around_one(n_envs, n_eval_envs):
    envs = vector(n_envs)
    return NormalizeObservation(envs), envs


for words, solution in {
    "evaluation changes the statistics": on_the_outer_wrapper,
    "both are the same": around_one,
    "NormalizeReward in place of": lambda *numbers: [NormalizeReward(vector(number)) for number in numbers],
    "and 1 and 1 made": lambda n_envs, n_eval_envs: (vector(1), vector(1)),
    "actions of training": lambda n_envs, n_eval_envs: (
        rescaled("Pendulum-v1", n_envs),
        gym.make_vec("Pendulum-v1", n_eval_envs),
    ),
    "observations of training": lambda n_envs, n_eval_envs: (vector(n_envs), gym.make_vec("Acrobot-v1", n_eval_envs)),
    "one of them is not wrapped": lambda n_envs, n_eval_envs: (Tensors(vector(n_envs)), wrapped(n_eval_envs)),
    "two vector environments": lambda n_envs, n_eval_envs: [gym.make("CartPole-v1") for _ in range(2)],
    "should return two": lambda n_envs, n_eval_envs: None,
    "it raised NameNotFound": lambda n_envs, n_eval_envs: gym.make_vec("Nothing-v0", n_envs),
    "it raised SystemExit": lambda n_envs, n_eval_envs: exit(),
}.items():
    is_wrong("make_envs", words)(solution)


def whole(source, target):
    target.env.obs_rms = copy.deepcopy(source.env.obs_rms)


def in_place(quelle, ziel):
    """For normalizers in one wrapper."""
    quelle, ziel = quelle.env, ziel.env
    ziel.obs_rms.mean[:] = quelle.obs_rms.mean
    np.copyto(ziel.obs_rms.var, quelle.obs_rms.var)
    ziel.obs_rms.count = quelle.obs_rms.count


def by_name(eval_envs, train_envs):
    for name in ("mean", "var", "count"):
        setattr(rms(eval_envs), name, getattr(rms(train_envs), name))


def shared(envs, test_envs):
    test_envs.env.obs_rms, test_envs.env.update_running_mean = rms(envs), False


def without_number(train_env, eval_env):
    rms(eval_env).mean, rms(eval_env).var = rms(train_env).mean + 0, rms(train_env).var + 0


for solution in (whole, in_place, by_name, shared, without_number, hidden(sync_envs), staticmethod(sync_envs).__func__):
    is_right("sync_envs")(solution)


def synced(change):
    def sync(train_envs, eval_envs):
        sync_envs(train_envs, eval_envs)
        change(rms(train_envs), rms(eval_envs))

    return sync


for words, solution in {
    "the mean of evaluation is not": synced(lambda train, mine: setattr(mine, "mean", 0 * mine.mean)),
    "the mean of evaluation": lambda train_envs, eval_envs: sync_envs(train_envs, copy.deepcopy(eval_envs)),
    "it is the variance": synced(lambda train, mine: vars(mine).update(mean=mine.var, var=mine.mean)),
    "the variance of evaluation": synced(lambda train, mine: setattr(mine, "var", np.ones(4))),
    "the statistics of training have changed": synced(lambda train, mine: setattr(train, "mean", 0 * mine.mean)),
    "of training have changed": synced(lambda train, mine: setattr(train, "var", np.ones(4))),
    "is not that of training": lambda train_envs, eval_envs: rms(eval_envs).update(rms(train_envs).mean[None]),
    "it raised AttributeError": synced(lambda train, mine: train.running_mean),
    "it raised SystemExit": synced(lambda train, mine: exit()),
}.items():
    is_wrong("sync_envs", words)(solution)


@pytest.mark.parametrize(("name", "solution"), ALL.right)
def test_a_right_one_in_another_style_passes(name, solution):
    environment = dict(os.environ)
    passes_from_a_file(solution, name)
    assert dict(os.environ) == environment


@pytest.mark.parametrize(
    ("name", "solution", "words"), ALL.wrong, ids=[f"{name}-{words}" for name, _, words in ALL.wrong]
)
def test_another_mistake_is_named(name, solution, words):
    says(solution, name, words)
