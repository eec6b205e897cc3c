"""What a Config takes, what it makes of it, and what it says of the rest."""

import json
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any, Literal

import numpy as np
import pytest
import torch

import lemniscate as lem
from lemniscate.algos import ALGORITHMS, find, ppo
from lemniscate.api.training import config_for
from lemniscate.errors import UserError
from lemniscate.run.config import RunConfig
from lemniscate.run.fields import read
from lemniscate.types import Schedule


@dataclass(frozen=True, kw_only=True)
class Config(RunConfig):
    """One field of each kind."""

    plain: float = 1.0
    whole: int = 1
    flag: bool = True
    word: str | None = None
    which: Literal["a", "b"] | float = "a"
    words: tuple[str, ...] = ()
    arguments: dict[str, Any] = field(default_factory=dict)


@pytest.mark.parametrize(
    ("name", "value", "kept"),
    [
        ("total_steps", 1e6, 1_000_000),
        ("total_steps", np.int64(3), 3),
        ("total_steps", np.float64(1e5), 100_000),
        ("total_steps", torch.tensor(7), 7),
        ("seed", np.uint32(2**32 - 1), 2**32 - 1),
        ("gamma", np.float32(0.5), 0.5),
        ("gamma", 1, 1.0),
        ("hidden", [32, 16.0], (32, 16)),
        ("hidden", np.array([32, 16]), (32, 16)),
        ("hidden", (), ()),
        ("hidden", range(1, 3), (1, 2)),
        ("max_grad_norm", None, None),
        ("normalize_advantage", np.bool_(False), False),
    ],
)
def test_numbers_of_every_kind_become_pythons(name, value, kept):
    value = getattr(ppo.Config(**{name: value}), name)
    assert value == kept
    assert type(value) is type(kept)
    assert all(type(item) is int for item in (value if isinstance(value, tuple) else ()))


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("epochs", 1.5, "epochs must be a whole number from 1 to 10,000, not 1.5."),
        ("epochs", True, "epochs must be a whole number from 1 to 10,000, not True."),
        ("epochs", float("nan"), "epochs must be a whole number from 1 to 10,000, not nan."),
        ("epochs", float("inf"), "epochs must be a whole number from 1 to 10,000, not inf."),
        ("epochs", "3", "epochs must be a whole number from 1 to 10,000, not '3'."),
        ("epochs", None, "epochs must be a whole number from 1 to 10,000, not None."),
        ("seed", -1, "seed must be a whole number from 0 to 4,294,967,295, not -1."),
        ("gamma", 2, "gamma must be a number from 0 to 1, not 2."),
        ("target_kl", 0, "target_kl must be a number above 0 or None, not 0."),
        ("hidden", 64, "hidden must be several numbers, such as (64, 64), not 64."),
        ("hidden", "64", "hidden must be several numbers, such as (64, 64), not '64'."),
        ("hidden", [8, 0], "hidden must be a whole number from 1 to 1,000,000, not 0."),
        ("activation", "x", "activation must be one of tanh, relu, elu, silu, not 'x'."),
        ("normalize_advantage", "no", "normalize_advantage must be True or False, not 'no'."),
        ("env", 3, "env must be a text, not 3."),
        (
            "clip",
            "x>0.2",
            "clip must be a number above 0, or a schedule 'FIRST>LAST' of two such numbers, not 'x>0.2'.",
        ),
        (
            "entropy_coef",
            "0.01>-1",
            "entropy_coef must be a number at least 0, or a schedule 'FIRST>LAST' of two such numbers, not '0.01>-1'.",
        ),
        ("gamma", "0.9>0.99", "gamma must be a number from 0 to 1, not '0.9>0.99'."),
        ("keep_best", True, "keep_best needs evaluations in training: give evaluate_every, such as 10_000 steps."),
        (
            "learning_rate",
            "3e-4>0",
            "learning_rate 0.0003>0.0 is a schedule, which desired_kl does not follow: desired_kl must be none.",
        ),
    ],
)
def test_a_value_that_does_not_fit_is_told_with_what_would(name, value, said):
    with pytest.raises(UserError) as caught:
        ppo.Config(**{name: value})
    assert str(caught.value) == said


@pytest.mark.parametrize("name", ["env_kwargs", "reset_options"])
def test_arguments_are_from_the_beginning_what_they_are_when_the_run_comes_back(name):
    """So an environment is trained with what it is evaluated with; and what the caller changes later changes no run."""
    given = {
        "pair": (1, 2),
        "half": np.float32(0.5),
        "grid": np.eye(2, dtype=int),
        "model": PurePath("a/b"),
        "deep": {"t": (1,)},
    }
    config = ppo.Config(**{name: given})
    found = getattr(config, name)
    assert found == {"pair": [1, 2], "half": 0.5, "grid": [[1, 0], [0, 1]], "model": "a/b", "deep": {"t": [1]}}
    assert type(found["pair"]) is type(found["deep"]["t"]) is list
    assert ppo.Config.from_json(json.loads(json.dumps(config.to_json()))) == config
    given["deep"]["t"] = 7
    assert found["deep"] == {"t": [1]}
    for lost in ({"x": object()}, {3: 0.5}, {"deep": [{None: 1}]}, {"x": float("nan")}):
        with pytest.raises(UserError, match=f"{name} must be a dictionary of what JSON can hold, with texts as keys"):
            ppo.Config(**{name: lost})


@pytest.mark.parametrize("text", ["0.01>0", " 1e-2 > 0.0", Schedule("0.01>0")])
def test_a_schedule_is_a_text_that_survives_json(text):
    config = ppo.Config(entropy_coef=text, clip_value="0.2>0.1")
    assert config.schedules == {"entropy_coef": "0.01>0.0", "clip_value": "0.2>0.1"}
    assert [config.entropy_coef.at(progress) for progress in (0, 0.25, 1, 1.5)] == [0.01, 0.0075, 0, 0]
    again = ppo.Config.from_json(json.loads(json.dumps(config.to_json())))
    assert again == config
    assert again.schedules == config.schedules


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_learning_rate_may_have_a_schedule_with_an_end_of_its_own(algorithm):
    config = find(algorithm).Config()
    rates = [name for name in config.names() if name.endswith("learning_rate") and not name.startswith("final")]
    free = {"desired_kl": None} if algorithm == "ppo" else {}
    assert rates
    assert config.replace(**dict.fromkeys(rates, "1e-3>0"), **free).schedules.keys() == set(rates)
    final = next(name for name in config.names() if name.startswith("final"))
    with pytest.raises(UserError, match=rf"0.001>0.0 has its own end: {final} does not go with it"):
        config_for(algorithm, "Pendulum-v1", **dict.fromkeys(rates, "1e-3>0"), **free, **{final: 0.5})


@pytest.mark.parametrize(
    ("algorithm", "env", "fields"),
    [
        ("pqn", "CartPole-v1", {"learning_rate": "0.0005>0.0001", "final_epsilon": 0.01}),
        ("ddpg", "Pendulum-v1", {"noise_std": "0.3>0.1", "final_learning_rate": 0.1}),
        ("td3", "Pendulum-v1", {"noise_std": "0.3>0.1", "final_learning_rate": 0.1}),
    ],
)
def test_a_schedule_goes_with_the_end_of_another_quantity(algorithm, env, fields):
    config = config_for(algorithm, env, **fields)
    assert {name: getattr(config, name) for name in fields} == fields


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("plain", "x", "plain must be a number, not 'x'."),
        ("whole", 0.5, "whole must be a whole number, not 0.5."),
        ("word", 3, "word must be a text or None, not 3."),
        ("which", "c", "which must be one of a, b or a number, not 'c'."),
        ("words", 3, "words must be several names, such as ('name', 'other'), not 3."),
        ("words", "a:b,c:d", "words must be several names, such as ('name', 'other'), not 'a:b,c:d'."),
        ("words", [3], "words must be a text, not 3."),
        ("arguments", "x", "arguments must be a dictionary, such as {'gravity': -5}, not 'x'."),
        (
            "arguments",
            {"x": object},
            "arguments must be a dictionary of what JSON can hold, with texts as keys, not {'x': <class 'object'>}.",
        ),
    ],
)
def test_fields_of_ones_own_are_checked_by_their_types(name, value, said):
    with pytest.raises(UserError) as caught:
        Config(**{name: value})
    assert str(caught.value) == said


def test_fields_of_every_kind_are_the_same_after_json():
    config = Config(word="w", which=0.5, words=["a", "b"], arguments={"x": [1, 2]}, plain=2)
    assert (config.which, config.words, config.plain) == (0.5, ("a", "b"), 2.0)
    assert Config.from_json(config.to_json()) == config


def test_a_config_of_another_version_is_refused():
    with pytest.raises(UserError, match="written by another version of lemniscate: there is no field engine now"):
        ppo.Config.from_json({**ppo.Config().to_json(), "engine": "auto"})


def test_networks_with_a_memory_are_counted_before_they_are_made(tmp_path):
    with pytest.raises(UserError, match=r"This run takes at least .* MB are for hidden .*: choose a smaller hidden"):
        lem.train("ppo", env="CartPole-v1", network="gru", hidden=(200_000,), run=tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()


def test_none_is_none_where_a_field_of_several_may_be_so():
    """`--critic-hidden none` is as hidden, and `--hidden none` no hidden layer."""
    assert read("critic_hidden", tuple[int, ...] | None, ["none"]) is None
    assert read("hidden", tuple[int, ...], ["none"]) == ()
    assert read("critic_hidden", tuple[int, ...] | None, ["[]"]) == ()
