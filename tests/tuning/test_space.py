"""What a search may choose: texts to ranges, ranges to values, and the sentences for what is none."""

from collections import Counter

import optuna
import pytest

from conftest import tiny
from lemniscate.errors import UserError
from lemniscate.sweeps.search import Choice, Interval, draw, read_space, read_texts


def space_of(search, **fields):
    return read_space(read_texts(search), tiny(**fields))


def drawn(space, count=300):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    return [draw(space, study.ask()) for _ in range(count)]


@pytest.fixture(autouse=True)
def _silent():
    optuna.logging.set_verbosity(optuna.logging.WARNING)


def test_a_text_is_read_as_ranges_and_choices():
    space = space_of(
        "learning_rate=log:1e-4:1e-2, gamma=.9:.999, epochs=2:8, hidden=16|32 32, recompute-advantages=on|off"
    )
    assert space["learning_rate"] == Interval(1e-4, 1e-2, log=True, whole=False)
    assert space["gamma"] == Interval(0.9, 0.999, log=False, whole=False)
    assert space["epochs"] == Interval(2, 8, log=False, whole=True)
    assert space["hidden"] == Choice({"16": (16,), "32 32": (32, 32)})
    assert space["recompute_advantages"] == Choice({"on": True, "off": False})


def test_a_dictionary_of_texts_is_the_same_search():
    assert read_texts({"gamma": ".9:.999", "hidden": "16|32"}) == read_texts("gamma=.9:.999,hidden=16|32")


def test_what_is_drawn_lies_in_its_range_and_fits_the_config():
    space = space_of("learning_rate=log:1e-5:1e-1, gamma=.9:.999, epochs=2:4, hidden=16|32 32, desired_kl=none|0.01")
    values = drawn(space)
    assert all(1e-5 <= fields["learning_rate"] <= 1e-1 for fields in values)
    assert all(0.9 <= fields["gamma"] <= 0.999 for fields in values)
    assert Counter(fields["epochs"] for fields in values).keys() == {2, 3, 4}
    assert Counter(fields["hidden"] for fields in values).keys() == {(16,), (32, 32)}
    assert Counter(fields["desired_kl"] for fields in values).keys() == {None, 0.01}
    for fields in values[:20]:
        tiny(**fields)


def test_orders_of_magnitude_are_equally_likely_where_the_range_says_log():
    below = {True: 0, False: 0}
    for log in below:
        values = drawn(space_of(f"learning_rate={'log:' * log}1e-5:1e-1"))
        below[log] = sum(fields["learning_rate"] < 1e-3 for fields in values) / len(values)
    assert below[True] == pytest.approx(0.5, abs=0.1)
    assert below[False] < 0.05


def test_what_is_drawn_has_six_digits_and_is_what_a_preset_says():
    for fields in drawn(space_of("learning_rate=log:1e-4:1e-2, gamma=.9:.99995"), 50):
        assert all(value == float(f"{value:.6g}") for value in fields.values())


def test_the_settings_of_a_config_are_a_point_of_the_space_where_they_lie_in_it():
    space = space_of("gamma=.9:.999, epochs=2:8, hidden=16|32 32")
    assert [space[name].key_of(value) for name, value in (("gamma", 0.99), ("epochs", 2), ("hidden", (32, 32)))] == [
        0.99,
        2,
        "32 32",
    ]
    assert [space[name].key_of(value) for name, value in (("gamma", 0.5), ("epochs", 9), ("hidden", (64,)))] == [
        None,
        None,
        None,
    ]


@pytest.mark.parametrize(
    ("search", "sentence"),
    [
        ("", "Search what"),
        ("gamma", "written as field=low:high"),
        ("gamma=.9:.99, gamma=.8:.9", "has gamma more than once"),
        ("gamma=", "written as field=low:high"),
        (5, "must be a text such as"),
        ("gama=.9:.99", "did you mean gamma"),
        ("seed=1:5", "the same in all trials"),
        ("total_steps=1:5", "the same in all trials"),
        ("gamma=.99:.9", "below its second"),
        ("gamma=.9:.9", "below its second"),
        ("learning_rate=log:0:1", "learning_rate"),
        ("value_coef=log:0:1", "above 0 and below"),
        ("gamma=.9", "is no range"),
        ("learning_rate=log:1e-4", "learning_rate=log:1e-4 is no range: write learning_rate=low:high"),
        ("clip=.1|0.10", "is no range"),
        (
            {"gamma": (0.9, 0.99)},
            r"search\['gamma'\] must be a text such as 'log:1e-4:1e-2', '.9:.999' or 'a|b', not \(0.9",
        ),
        ({"activation": ["tanh", "relu"]}, "must be a text such as"),
        ({"gamma": 0.9}, "is no range"),
        ("gamma=.9:2", "gamma must be"),
        ("gamma=.9:1:2", "gamma"),
        ("activation=tanh:relu", "is no number"),
        ("activation=tanh|rellu", "relu"),
        ("hidden=16:32", "is no number"),
        ("epochs=1:2.5", "epochs must be"),
        ("recompute_advantages=on|maybe", "recompute_advantages must be"),
    ],
)
def test_what_is_no_range_has_its_sentence(search, sentence):
    with pytest.raises(UserError, match=sentence):
        space_of(search)
