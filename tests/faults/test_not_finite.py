"""NaN, infinity and huge numbers anywhere: named before anything learns from them, and never saved."""

import itertools
import math
from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from safetensors.torch import load_file

import lemniscate as lem
from helpers import require_in_own_process
from lemniscate.algos import ALGORITHMS, find
from lemniscate.cli import main

IN_GYMNASIUM = [name for name in ALGORITHMS if not find(name).Config.differentiates]

pytestmark = [pytest.mark.filterwarnings(f"ignore::{kind}") for kind in ("UserWarning", "RuntimeWarning")]
"""of Gymnasium, on what is injected"""

BAD = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf, "1e300": 1e300}
STEPS = 64


class Injected(gym.Env):
    """Five steps an episode; from the step `at` of all environments on, `value` stands in `where`."""

    count = 0

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    metadata = {"measures": ("height",), "render_modes": []}  # noqa: RUF012

    def __init__(self, where="", value=0.0, at=20, scale=1.0, box=False):
        self.where, self.value, self.at, self.scale = where, float(value), at, scale
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32) if box else gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._obs("reset"), {}

    def step(self, action):
        assert np.isfinite(action).all()
        self.t += 1
        Injected.count += 1
        obs = self._obs("final" if self.t == 5 else "observation")
        reward = self.value if self._is_due("reward") else self.scale * self.np_random.normal()
        return obs, reward, self.t == 5, False, {"height": self.value if self._is_due("measure") else 1.0}

    def _is_due(self, where):
        return self.where == where and self.count >= self.at

    def _obs(self, where):
        obs = self.scale * self.np_random.normal(size=3)
        if self._is_due(where):
            obs[1] = self.value
        return obs


def fields_of(algorithm, **fields):
    """Fields of a run of a moment, with checkpoints, and evaluations of a few episodes."""
    common = {"num_envs": 2, "hidden": (8,), "total_steps": STEPS, "checkpoint_every": 32, "keep_checkpoints": 9}
    common |= {"evaluate_episodes": 2, "compile": "off", "backend": "gymnasium"}
    small = {"num_steps": 8, "minibatch_size": 8, "critic_minibatch_size": 8, "critic_hidden": (8,)}
    small |= {"learning_starts": 16, "log_every": 8, "batch_size": 8}
    return {**common, **{name: x for name, x in small.items() if name in find(algorithm).Config.names()}, **fields}


def is_off_policy(algorithm):
    return algorithm in ("ddpg", "td3", "sac")


def needs_box(algorithm):
    return is_off_policy(algorithm) or algorithm == "reppo"


def content(run):
    return {file: file.read_bytes() for file in sorted((run / "checkpoints").rglob("*")) if file.is_file()}


def ending(run, algorithm, **fields):
    """How a run ends: what it says, or "finished". Whatever it has saved is finite, and can be loaded."""
    before, Injected.count = {}, 0

    def look(step, metrics, policy):
        before.update(content(run))

    kept = {name: fields.pop(name) for name in ("env_kwargs",) if name in fields}
    try:
        lem.train(
            algorithm, Injected, run=run, progress=False, callbacks=look, **kept, **fields_of(algorithm, **fields)
        )
        how = "finished"
    except lem.NonFiniteError as error:
        how = str(error)
    for file in run.glob("checkpoints/*/*.safetensors"):
        for name, tensor in load_file(file).items():
            assert tensor.isfinite().all(), (file, name, how)
    assert not list(run.rglob("*.tmp"))
    after = content(run)
    assert all(after.get(file) == text for file, text in before.items())
    if after:
        lem.load(run)
    return how


WHERE = {"observation": "observation", "reset": "observation", "final": "observation", "reward": "reward"}


def injections():
    for where, name in itertools.product(WHERE, BAD):
        for at in (0, 11, 20, 30):
            yield where, name, at


@pytest.mark.parametrize("algorithm", IN_GYMNASIUM)
@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.faults), 37])
def test_a_number_that_is_not_finite_is_named_with_its_environment_and_step(tmp_path, algorithm, every):
    counts = Counter()
    for number, (where, name, at) in enumerate(itertools.islice(injections(), 0, None, every)):
        injected = {"where": where, "value": BAD[name], "at": at, "box": needs_box(algorithm)}
        if not math.isfinite(BAD[name]):  # JSON holds none
            injected["value"] = name
        said = ending(tmp_path / str(number), algorithm, env_kwargs=injected)
        shown = "inf" if name == "1e300" else name
        assert said.startswith(f"The {WHERE[where]} of environment "), (said, injected)
        assert f" is {shown} in the step after " in said, said
        counts["named"] += 1
    print(f"{algorithm}: {counts['named']} injected, all named with quantity, environment and step")


SCALES = (0.0, 1e-38, 1e15, 1e30, 1e37)


@pytest.mark.parametrize("algorithm", IN_GYMNASIUM)
@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.faults), 15])
@pytest.mark.one_in(2)
def test_huge_and_constant_numbers_are_learned_from_or_named(tmp_path, algorithm, every):
    counts, off_policy = Counter(), is_off_policy(algorithm)
    scaling = [{}, {"normalize_observations": not off_policy}, {"normalize_observations": off_policy}]
    cases = [({"scale": scale}, more) for scale in SCALES for more in scaling]
    cases += [({"where": where, "value": 1e38, "at": 9}, more) for where in WHERE for more in scaling]
    cases += [({"where": "measure", "value": name, "at": 5}, {"evaluate_every": 16}) for name in ("nan", "inf")]
    for number, (injected, more) in enumerate(itertools.islice(cases, 0, None, every)):
        own = {"scale_rewards": False} if not off_policy and number % 2 else {}
        how = ending(
            tmp_path / str(number), algorithm, env_kwargs={**injected, "box": needs_box(algorithm)}, **own, **more
        )
        assert how == "finished" or "step" in how, how
        counts["finished" if how == "finished" else "named"] += 1
    print(f"{algorithm}: {dict(counts)}, 0 non-finite tensors saved")


def rates(algorithm):
    names = [
        name
        for name in find(algorithm).Config.names()
        if name in {"learning_rate", "actor_learning_rate", "critic_learning_rate", "max_kl"}
    ]
    return [{name: rate} for name in names for rate in (1e38, 1e30, 1e19, 1e10)] + [dict.fromkeys(names, 1e38)]


@pytest.mark.parametrize("algorithm", IN_GYMNASIUM)
@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.faults), 8])
def test_parameters_that_overflow_are_neither_acted_with_nor_saved(tmp_path, algorithm, every):
    counts = Counter()
    for number, fields in enumerate(itertools.islice(rates(algorithm), 0, None, every)):
        if algorithm == "ppo":
            fields["desired_kl"] = None
        box = {"box": needs_box(algorithm) or (number % 2 == 0 and algorithm != "pqn")}
        how = ending(tmp_path / str(number), algorithm, env_kwargs=box, **fields)
        assert how == "finished" or "step" in how, how
        counts["finished" if how == "finished" else "named"] += 1
    print(f"{algorithm}: {dict(counts)} with absurd step sizes, 0 non-finite tensors saved")


def test_the_sentence_of_a_parameter_names_it_and_the_step(tmp_path, capsys):
    words = "train a2c --env CartPole-v1 --num-envs 4 --num-steps 16 --total-steps 640 --learning-rate 1e38"
    assert main([*words.split(), "--run", str(tmp_path / "r"), "--backend", "gymnasium"]) == 1
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert "ends at step" in said, said
    assert "Training stopped; the last checkpoint is as it was." in said


@pytest.mark.faults
@pytest.mark.parametrize("algorithm", ["ppo", "td3"])
def test_a_compiled_run_stops_in_the_same_way(tmp_path, algorithm):
    require_in_own_process(__name__, f"require_stops(Path({str(tmp_path)!r}), {algorithm!r})", "eager")


def require_stops(tmp_path, algorithm):
    """With absurd step sizes, and with rewards that are not numbers."""
    for number, fields in enumerate(rates(algorithm)[:2]):
        if algorithm == "ppo":
            fields["desired_kl"] = None
        how = ending(tmp_path / str(number), algorithm, env_kwargs={"box": True}, compile="on", **fields)
        assert how == "finished" or "step" in how, how
    named = ending(
        tmp_path / "reward", algorithm, env_kwargs={"where": "reward", "value": "nan", "box": True}, compile="on"
    )
    assert named.startswith("The reward of environment "), named
