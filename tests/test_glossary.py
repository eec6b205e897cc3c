"""The glossary: its page is what the code looks unknown names up in, and every field and metric name has its row."""

import inspect
import re
from pathlib import Path

import pytest

import lemniscate as lem
from lemniscate import algos
from lemniscate.run import fields as glossary

PAGE = (Path(__file__).parents[1] / "docs" / "glossary.md").read_text()


def configs():
    return [algos.find(name).Config for name in algos.ALGORITHMS]


def test_the_table_of_the_page_is_that_of_the_code():
    assert glossary.TABLE.read_text() in PAGE


def test_the_words_of_one_library_are_beside_ours():
    lines = glossary.words_of("CleanRL").splitlines()
    assert lines[:2] == ["| CleanRL | lemniscate |", "| --- | --- |"]
    assert "| `clip_coef` | `clip` |" in lines
    assert all(re.fullmatch(r"\| [^|]*`\w+`[^|]* \| `\w+`[^|]* \|", line) for line in lines[2:])  # none without a name


def test_every_row_has_a_cell_for_each_library():
    assert len({len(row) for row in glossary.rows()}) == 1


def test_every_field_has_a_row_and_every_row_a_field():
    listed = {glossary.names_in(field)[0] for field, *_ in glossary.rows()[1:]}
    fields = {name for config in configs() for name in config.names()}
    assert fields - listed == set()
    assert listed - fields <= {
        *inspect.signature(lem.train).parameters,
        "callbacks",
        "env_kwargs",
        "wrappers",
        "warm_start",
    }


@pytest.mark.parametrize(
    ("name", "known", "ours"),
    [
        ("lr", ["learning_rate", "gamma"], {"learning_rate": ""}),
        (
            "lr",
            ["actor_learning_rate", "critic_learning_rate"],
            {"actor_learning_rate": "", "critic_learning_rate": ""},
        ),
        ("ent_coef", ["entropy_coef"], {"entropy_coef": ""}),
        ("net_arch", ["hidden"], {"hidden": ""}),
        ("vf_coef", ["value_coef"], {"value_coef": ""}),
        ("value_loss_coef", ["value_coef"], {"value_coef": "of a loss without ½"}),
        ("polyak", ["tau"], {"tau": "1 − tau"}),
        ("n_steps", ["tau"], {}),
        ("fixed", ["tau", "adam_eps"], {}),
    ],
)
def test_a_word_of_another_library_is_found_with_what_it_means_there(name, known, ours):
    assert glossary.ours(name, known) == ours


@pytest.mark.parametrize(
    ("algorithm", "name", "said"),
    [
        ("ppo", "lr", "There is no lr: here it is learning_rate."),
        ("ppo", "total_timesteps", "There is no total_timesteps: here it is total_steps."),
        ("ppo", "n_envs", "There is no n_envs: here it is num_envs."),
        ("ppo", "clip_range", "There is no clip_range: here it is clip."),
        ("ppo", "batch_size", "There is no batch_size: here it is minibatch_size."),
        ("ppo", "num_minibatches", "here it is minibatch_size (theirs: the number of minibatches)."),
        ("td3", "polyak", "There is no polyak: here it is tau (theirs: 1 − tau)."),
        ("ppo", "engine", "There is no engine: here it is compile."),
        ("ppo", "gama", "There is no field 'gama': did you mean gamma"),
    ],
)
def test_python_answers_with_our_word(algorithm, name, said):
    with pytest.raises(lem.UserError, match=re.escape(said)):
        lem.config_for(algorithm, "CartPole-v1", **{name: 1})


@pytest.mark.parametrize(
    "old", ["copies", "knob", "anew", "who steps", "memory learners", "learns from memory", "Descent", "Joint"]
)
def test_the_page_uses_its_own_words(old):
    assert old not in PAGE
