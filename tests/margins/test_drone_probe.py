"""Drones flown along their conditions, against the same flights in environments of their own."""

import os

os.environ.setdefault("SCIPY_ARRAY_API", "1")

from dataclasses import replace

import pytest
import torch

pytest.importorskip("crazyflow")

from lemniscate.drones import probe as drone_probe
from lemniscate.drones.crazyflow import CrazyflowBackend
from lemniscate.drones.probe import CONDITION_AXES
from lemniscate.drones.vehicle import CONDITIONS
from lemniscate.envs import registry
from lemniscate.envs.probe import Tally
from lemniscate.errors import UserError

ENV, STARTS, STEPS = "DroneFigureEightTrajectory-v0", 4, 25
MASS, DELAY = (next(axis for axis in CONDITION_AXES if axis.name == name) for name in ("mass", "action_delay"))


def probe(trained=None, given=None):
    return CrazyflowBackend.probe(ENV, STARTS, {"max_episode_time": STEPS / 50, **(trained or {})}, given or {})


@pytest.fixture(scope="module")
def two_axes():
    """Mass and delay in one dynamics, in two batches of five points."""
    with pytest.MonkeyPatch.context() as patch:
        delays = tuple(value for value in DELAY.values if value in (0, 0.004, 0.05))
        patch.setattr(drone_probe, "CONDITION_AXES", (MASS, replace(DELAY, values=delays)))
        patch.setattr(drone_probe, "MOST_FLIGHTS", 5 * STARTS)
        patch.setattr("lemniscate.drones.crazyflow.DYNAMICS", ("so_rpy",))
        return probe(trained={"mass": [0.5, 2.0], "wind": 0.3})


def follow(obs):
    return torch.cat([-0.2 * obs[:, 14:15], 0.2 * obs[:, 13:14], 0 * obs[:, :1], 0.5 * obs[:, 15:16]], dim=1)


def seen_by(act):
    """A policy that keeps what it sees."""
    seen = []

    def acts(obs):
        seen.append(obs.clone())
        return act(obs)

    return acts, seen


@pytest.fixture(scope="module")
def flights(two_axes):
    acts, seen = seen_by(follow)
    return *two_axes.fly(lambda: acts, 3), seen


def test_every_point_has_the_same_starts_and_its_own_condition(two_axes, flights):
    nominal, at, seen = flights
    assert [axis.name for axis in two_axes.axes] == ["mass", "action_delay", "dynamics"]
    assert len(seen) == 2 * STEPS
    for batch in range(2):
        starts = seen[STEPS * batch].unflatten(0, (5, STARTS))
        assert torch.equal(starts, starts[:1].expand_as(starts))
        after = seen[STEPS * batch + 5].unflatten(0, (5, STARTS))
        assert len(after.unique(dim=0)) == 5
    assert torch.equal(seen[0], seen[STEPS])
    assert [flight.shape for flight in nominal.actions] == [(STEPS, 4)] * STARTS
    assert at["mass"][MASS.values.index(1)] is nominal
    assert at["dynamics"] == [nominal]


@pytest.mark.parametrize(
    ("name", "value"), [pytest.param("mass", 1.3, marks=pytest.mark.long), ("action_delay", 0.004)]
)
def test_a_point_is_the_flight_of_an_environment_with_that_condition(two_axes, flights, name, value):
    """What training has drawn, mass and wind, is nominal unless it is flown along."""
    at = flights[1]
    axis = next(axis for axis in two_axes.axes if axis.name == name)
    env = registry.make(ENV, STARTS, kwargs={"max_episode_time": STEPS / 50, name: value})
    tally = Tally(STARTS)
    env.restart(3)
    for _ in range(STEPS):
        step = env.step(follow(env.obs).clamp(-1, 1))
        tally.add(step.reward, step.terminated, step.truncated)
    torch.testing.assert_close(at[name][axis.values.index(value)].returns, tally.returns, rtol=1e-4, atol=1e-4)


def test_drones_that_fall_are_dead_and_their_batch_ends_early(two_axes, monkeypatch):
    def fall(obs):
        return torch.tensor([0.0, 0.0, 0.0, -1.0]).expand(len(obs), 4)

    acts, seen = seen_by(fall)
    monkeypatch.setattr(two_axes._drones, "episode_steps", 500)
    nominal, at = two_axes.fly(lambda: acts, 3)
    assert nominal.terminated.all()
    assert all(one.terminated.all() for one in at["mass"])
    assert len(seen) < 150


def test_a_drone_whose_state_is_not_finite_has_crashed(two_axes):
    """The third action of the first drone of each point is NaN."""
    calls = []

    def act(obs):
        calls.append(1)
        action = torch.zeros(len(obs), 4)
        if len(calls) == 3:
            action[::STARTS] = torch.nan
        return action

    nominal, _ = two_axes.fly(lambda: act, 3)
    assert nominal.terminated[0]
    assert nominal.returns.isfinite().all()


def test_arguments_that_are_given_are_nominal(monkeypatch):
    monkeypatch.setattr(drone_probe, "CONDITION_AXES", (MASS, DELAY))
    made = probe(
        trained={"dynamics": ["so_rpy_rotor", "so_rpy"], "history": 1}, given={"mass": 1.1, "action_delay": [0, 0.01]}
    )
    mass, dynamics = made.axes
    assert (mass.nominal, dynamics.nominal) == (1.1, "so_rpy_rotor")
    assert mass.values == (0.7, 0.85, 0.95, 1, 1.05, 1.1, 1.15, 1.3)
    assert made.spec.observation_parts[-1].name == "history"
    ends = dict(zip(made._drones.air.ranges, made._ends.tolist(), strict=True))
    assert ends["mass"] == pytest.approx([1.1, 1.1])
    assert ends["action_delay"] == pytest.approx([0, 0.01])
    assert made._drones.air.ranges["mass"] == (0.7, 1.3)


def test_every_axis_is_of_a_condition_and_within_its_limits():
    for axis in CONDITION_AXES:
        condition = CONDITIONS[axis.name]
        assert axis.nominal == condition.nominal
        assert condition.low <= min(axis.values) <= max(axis.values) <= condition.high
        assert axis.values == tuple(sorted(set(axis.values)))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"mas": 1}, "did you mean mass"),
        ({"mass": 9}, "mass must be from"),
        ({"dynamics": "warp"}, "no dynamics 'warp'"),
    ],
)
def test_wrong_arguments_have_their_sentences(given, said):
    with pytest.raises(UserError, match=said):
        probe(given=given)
