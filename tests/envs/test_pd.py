"""The PD controller: its commands by hand, and its flight."""

import math
import os
from dataclasses import replace

os.environ.setdefault("SCIPY_ARRAY_API", "1")

import numpy as np
import pytest
import torch

import lemniscate as lem
from lemniscate.drones.vehicle import GAINS, GRAVITY, PD
from lemniscate.envs import registry
from lemniscate.run.evaluate import evaluate
from lemniscate.spec import Box

BOX = Box((-math.pi / 2,) * 3 + (0.05,), (math.pi / 2,) * 3 + (0.48,))
MASS, H = 0.03, 0.1


def command(points, velocity=(0.0, 0.0, 0.0), gains=(10.0, 5.0, 20.0, 8.0)):
    """Roll, pitch, yaw and thrust at a reference [K, 3] as seen from the drone."""
    pd = PD([gains], [MASS], BOX, slice(13, 13 + 3 * len(points)), slice(7, 10), H)
    obs = torch.zeros(1, 13 + 3 * len(points), dtype=torch.float64)
    obs[0, 7:10] = torch.tensor(velocity)
    obs[0, 13:] = torch.tensor(points).flatten()
    action = pd(obs).mode()[0]
    low, high = torch.tensor(BOX.low), torch.tensor(BOX.high)
    return (low + (action + 1) / 2 * (high - low)).tolist()


def test_at_rest_on_a_point_it_hovers():
    roll, pitch, yaw, thrust = command([[0.0, 0.0, 0.0]] * 3)
    assert (abs(roll), abs(pitch), abs(yaw)) == pytest.approx((0, 0, 0), abs=1e-6)
    assert thrust == pytest.approx(MASS * GRAVITY, rel=1e-5)


@pytest.mark.parametrize(("axis", "sign"), [(0, 1), (1, -1)])
def test_it_leans_towards_the_point(axis, sign):
    """A pitch forwards moves it along x, a roll to the right along −y."""
    away = [0.0, 0.0, 0.0]
    away[axis] = 0.2
    tilt = command([away] * 3)[1 - axis]
    assert tilt == pytest.approx(sign * math.atan2(10 * 0.2, GRAVITY), rel=1e-5)


def test_it_brakes_against_its_velocity_and_climbs_by_its_own_gains():
    assert command([[0.0] * 3] * 3, velocity=(0.4, 0.0, 0.0))[1] == pytest.approx(
        -math.atan2(5 * 0.4, GRAVITY), rel=1e-5
    )
    assert command([[0.0, 0.0, 0.1]] * 3)[3] == pytest.approx(MASS * (GRAVITY + 20 * 0.1), rel=1e-5)
    assert command([[0.0] * 3] * 3, velocity=(0.0, 0.0, 0.1))[3] == pytest.approx(MASS * (GRAVITY - 8 * 0.1), rel=1e-5)


def test_it_knows_velocity_and_acceleration_of_a_parabola():
    """x = 0.3 t + ½ 0.5 t², with the velocity of then: nothing is left but the acceleration."""
    points = [[0.3 * t + 0.25 * t**2, 0.0, 0.0] for t in (0.0, H, 2 * H)]
    assert command(points, velocity=(0.3, 0.0, 0.0))[1] == pytest.approx(math.atan2(0.5, GRAVITY), rel=1e-5)


@pytest.mark.long
def test_it_flies_the_figure_eight_and_its_gains_matter():
    pytest.importorskip("crazyflow")
    env = registry.make("DroneFigureEightTrajectory-v0", 8)
    assert isinstance(env.baseline, PD)
    flown = evaluate(env.baseline, env, 8, seed=0)
    assert flown.terminated == 0
    assert flown.mean_return > 485
    soft = evaluate(replace(env.baseline, gains=[(3.0, 3.0, 3.0, 3.0)]), env, 8, seed=0)
    assert soft.mean_return < flown.mean_return - 10
    assert set(GAINS) == {"so_rpy", "so_rpy_rotor", "so_rpy_rotor_drag", "first_principles"}


def test_of_a_baseline_there_is_neither_film_nor_page(tmp_path):
    pytest.importorskip("crazyflow")
    arguments = {"env": "DroneFigureEightTrajectory-v0", "episodes": 1, "baseline": True}
    for more in ({"video": tmp_path / "video.gif"}, {"report": tmp_path / "page"}):
        with pytest.raises(lem.errors.UserError, match="leave out video, report and stochastic"):
            lem.evaluate(lambda obs: np.array([0, 0, 0, 0.3], np.float32), **arguments, **more)


def test_an_environment_without_a_baseline_says_so():
    with pytest.raises(lem.errors.UserError, match=r"CartPole-v1 has no baseline to compare with\."):
        lem.evaluate(lambda obs: 0, env="CartPole-v1", baseline=True)


def test_each_of_several_dynamics_has_its_own_gains():
    points = [[0.1, 0.0, 0.0]] * 3
    soft, hard = command(points, gains=(10.0, 5.0, 20.0, 8.0)), command(points, gains=(30.0, 5.0, 20.0, 8.0))
    pd = PD([(10.0, 5.0, 20.0, 8.0), (30.0, 5.0, 20.0, 8.0)], [MASS] * 2, BOX, slice(13, 22), slice(7, 10), H)
    obs = torch.zeros(4, 22, dtype=torch.float64)
    obs[:, 13:] = torch.tensor(points).flatten()
    low, high = torch.tensor(BOX.low), torch.tensor(BOX.high)
    both = low + (pd(obs).mode() + 1) / 2 * (high - low)
    assert both.tolist() == [pytest.approx(each, abs=1e-6) for each in (soft, hard, soft, hard)]
