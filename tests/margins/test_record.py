"""Margins, sentences and the picture, from flights whose answer is known."""

import math

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from lemniscate.envs.probe import Axis, Flown, Tally
from lemniscate.margins import presentation
from lemniscate.margins.presentation import FAILS, FALLS_SHORT, rows, sentences
from lemniscate.margins.record import margins_of, smoothness, worst_accepted

DELAY = Axis("delay", (0.0, 0.01, 0.02, 0.03), 0.0, "s", "action delay", "{} of action delay", ("ms", 1000))
MASS = Axis("mass", (0.7, 0.85, 1.0, 1.15, 1.3), 1.0, "", "mass", "{} mass")
ALL = ("so_rpy", "so_rpy_rotor", "first_principles")
DYNAMICS = Axis("dynamics", ALL, "so_rpy", "name", "dynamics", "the dynamics {}")
E = 64


def flown(*alive):
    """Flights of which so many are alive at each value; the mean return is the number that is alive."""
    lost = [torch.arange(E) >= count for count in alive]
    return [Flown(torch.where(each, 0.0, float(E)), each) for each in lost]


def said(axis, *alive, words=FAILS):
    return list(sentences([margins_of(axis, flown(*alive), None)], words))


def test_a_margin_is_the_last_value_up_to_which_95_percent_are_alive():
    found = margins_of(DELAY, flown(64, 61, 60, 64), None)
    assert found.alive == (64, 61, 60, 64)
    assert set(found.sides) == {"above"}
    assert (found.sides["above"].last, found.sides["above"].first) == (0.01, 0.02)
    record = found.to_json()
    assert record["margin"] == {"above": 0.01}
    assert record["alive"] == [1.0, 61 / 64, 60 / 64, 1.0]
    assert record["mean_return"] == [64.0, 61.0, 60.0, 64.0]
    assert (record["unit"], record["values"], record["nominal"]) == ("s", [0.0, 0.01, 0.02, 0.03], 0.0)


def test_a_margin_has_two_sides_where_there_are_values_on_both():
    found = margins_of(MASS, flown(0, 64, 64, 64, 64), None)
    assert found.to_json()["margin"] == {"below": 0.15, "above": 0.3}
    assert found.within() == [0.85, 1.0, 1.15, 1.3]
    assert margins_of(MASS, flown(0, 3, 60, 64, 64), None).to_json()["margin"] == {"below": None, "above": None}


def test_words_have_no_order_and_so_no_sides():
    found = margins_of(DYNAMICS, flown(64, 63, 0), None)
    assert found.to_json()["margin"] == ["so_rpy", "so_rpy_rotor"]
    assert found.within() == ["so_rpy", "so_rpy_rotor"]


@pytest.mark.parametrize(
    ("axis", "alive", "sentence"),
    [
        (DELAY, (64, 62, 3, 0), "Flies with 10 ms of action delay, and loses 2 of 64 there; at 20 ms 61 of 64 crash."),
        (DELAY, (64, 64, 64, 64), "Flies with 30 ms of action delay, the most that was tried."),
        (DELAY, (64, 60, 64, 64), "4 of 64 crash with 10 ms of action delay, the least that was tried."),
        (MASS, (64,) * 5, "Flies with 30 % less to 30 % more mass, the most that was tried."),
        (MASS, (0, 64, 64, 64, 63), "Flies with 15 % less mass; at 30 % less 64 of 64 crash; flies with 30 % more mass, the most that was tried, and loses 1 of 64 there."),
        (DYNAMICS, (64, 64, 1), "Flies with the dynamics so_rpy and so_rpy_rotor; 63 of 64 crash with first_principles."),
        (DELAY, (60, 64, 64, 64), "4 of 64 crash in the environment as it is, so there are no margins."),
    ],
)  # fmt: skip
def test_each_axis_has_its_sentence(axis, alive, sentence):
    assert said(axis, *alive) == [sentence]


def test_no_word_promises_safety():
    for words in (FAILS, FALLS_SHORT):
        for alive in ((64, 62, 3, 0), (64,) * 4, (0,) * 4):
            assert "safe" not in " ".join(said(DELAY, *alive, words=words)).lower()


def test_the_table_has_a_row_for_each_axis():
    found = [margins_of(DELAY, flown(64, 62, 3, 0), None), margins_of(MASS, flown(*[64] * 5), None)]
    assert rows(found) == [
        ["", "tried", "within margins", "least mean return", "alive beyond"],
        ["action delay", "0 … 30 ms", "0 … 10 ms", "62", "3 of 64 at 20 ms"],
        ["mass", "−30 … +30 %", "−30 … +30 %", "64", "–"],
    ]


def test_alive_is_a_return_that_nominal_episodes_have():
    """Of returns 1 to 100, 95 % reach 5; a tenth of their mean, 5.05, is forgiven."""
    nominal = Flown(torch.arange(1.0, 101.0, dtype=torch.float64), torch.zeros(100, dtype=torch.bool))
    assert worst_accepted(nominal) == pytest.approx(5 - 5.05)
    assert worst_accepted(Flown(-nominal.returns, nominal.terminated)) == pytest.approx(-96 - 5.05)
    least = worst_accepted(nominal)
    assert margins_of(DELAY, [nominal, *[Flown(nominal.returns - 5, nominal.terminated)] * 3], least).alive[1] == 96


def test_what_follows_an_end_does_not_count():
    tally = Tally(3)
    tally.add(torch.ones(3), torch.tensor([True, False, False]), torch.tensor([False, True, False]))
    tally.add(torch.ones(3), torch.tensor([False, True, True]), torch.zeros(3, dtype=torch.bool))
    assert tally.returns.tolist() == [1, 1, 2]
    assert tally.terminated.tolist() == [True, False, True]
    assert not tally.going.any()


def test_smoothness_of_waves_is_known():
    t = torch.arange(500) / 50
    slow, fast = 0.6 * torch.sin(2 * math.pi * 2 * t), 0.3 * torch.sin(2 * math.pi * 15 * t)
    found = smoothness([(slow + fast + 0.05)[:, None]], 1 / 50)  # the mean is no motion
    assert found["fast_share"] == pytest.approx(0.3**2 / (0.3**2 + 0.6**2), abs=1e-3)
    steps = np.sqrt(0.5 * sum((size * 2 * math.sin(math.pi * f / 50)) ** 2 for size, f in ((0.6, 2), (0.3, 15)))) * 50
    assert found["action_rate"] == pytest.approx(steps, rel=1e-2)
    assert found["saturated_share"] == 0
    assert smoothness([torch.tensor([1.0, -1.0, 0.0, 1.0])[:, None]], 0.02)["saturated_share"] == 0.75


def test_the_picture_has_a_panel_for_each_axis(tmp_path, monkeypatch):
    figures = []
    save = presentation.save
    monkeypatch.setattr(presentation, "save", lambda figure, file: figures.append(figure) or save(figure, file))
    found = [margins_of(DELAY, flown(64, 62, 3, 0), None), margins_of(MASS, flown(*[64] * 5), None)]
    found.append(margins_of(DYNAMICS, flown(64, 64, 1), None))
    assert presentation.draw(found, "A policy.", tmp_path / "p.png").stat().st_size > 10_000
    delay, mass, dynamics = figures[0].axes[::2]  # beside each, the axes of its returns
    assert bands(delay) == {"within the margin": pytest.approx((0, 10)), "beyond it": pytest.approx((10, 30))}
    assert bands(mass) == {"within the margin": pytest.approx((-30, 30))}
    assert bands(dynamics) == {}
    assert [label.get_text() for label in dynamics.get_xticklabels()] == [
        "so rpy",
        "so rpy\nrotor",
        "first\nprinciples",
    ]


def bands(axes):
    """The ends of each band by its label."""
    return {band.get_label(): (band.get_x(), band.get_x() + band.get_width()) for band in axes.patches}


def test_the_side_that_is_red_is_the_one_that_fails():
    """The first value below the nominal one fails, and all above it fly."""
    one = margins_of(MASS, flown(64, 3, 64, 64, 64), None)
    axes = Figure().subplots()
    presentation._draw(axes, axes.twinx(), one)
    (beyond,) = (patch for patch in axes.patches if patch.get_label() == "beyond it")
    assert beyond.get_x() + beyond.get_width() <= presentation._place(MASS, 1.0) + 1e-9


def test_episodes_of_other_lengths_count_by_their_steps():
    still, one = torch.zeros(30, 1), torch.tensor([[1.0]])
    found = smoothness([still, one], 0.02)
    assert (found["action_rate"], found["fast_share"]) == (0, 0)
    assert found["saturated_share"] == pytest.approx(1 / 31)
    assert smoothness([one], 0.02)["action_rate"] == 0
