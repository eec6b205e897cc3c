"""Flights in a scene: which are recorded, where they are drawn, and that their environments are closed."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import lemniscate as lem
from lemniscate.api import plots
from lemniscate.envs.backend import Scene
from lemniscate.envs.gymnasium import GymnasiumBackend
from lemniscate.report import curves, flight, playback
from lemniscate.run.environments import evaluation_env
from lemniscate.run.evaluate import EpisodeTable

MODEL = """<mujoco><worldbody><body mocap="true"><geom size="0.1"/></body></worldbody></mujoco>"""


class Glider(gym.Env):
    """Drifts from a random start along x, ten metres away; an episode is 5 steps."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (10,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.start = 0, self.np_random.uniform()
        return self.look(), {}

    def step(self, action):
        self.t += 1
        return self.look(), self.start, False, self.t == 5, {}

    def look(self):
        return np.array([10 + 0.1 * self.t, 0, self.start, 0, 0, 0, 1, 0, 0, 0.1], dtype=np.float32)


class Aviary(GymnasiumBackend):
    """Says for each environment whether it has a scene; always as many of them as in training."""

    compiled = True
    open = 0

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.scene = Scene(mujoco.MjModel.from_xml_string(MODEL), 0.1, slice(0, 3), slice(3, 7), slice(7, 10))
        Aviary.open += 1

    def close(self):
        super().close()
        Aviary.open -= 1


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    fields = {"num_envs": 2, "num_steps": 8, "total_steps": 32, "minibatch_size": 16, "evaluate_episodes": 2}
    path = tmp_path_factory.mktemp("flights") / "run"
    return lem.train("ppo", Glider, backend="test_flight:Aviary", run=path, progress=False, **fields)


@pytest.fixture
def drawn(monkeypatch):
    """The flights that are drawn into videos; nothing is rendered."""
    flights = []
    monkeypatch.setattr(flight, "_frames", lambda tracks, model: (flights.append(tracks) or [], "Drawn."))
    monkeypatch.setattr(playback, "save_frames", lambda frames, file, fps: None)
    return flights


def test_more_flights_than_environments_are_evaluated_as_without_a_film(run, drawn, capsys):
    recorded, plain = lem.evaluate(run, episodes=5, video="video.gif"), lem.evaluate(run, episodes=5)
    assert recorded.returns == plain.returns
    assert recorded.episodes == 5
    (tracks,) = drawn
    assert [track.position.shape for track in tracks] == [(5, 3)] * 2  # one of each environment, to its end
    assert not any(np.isnan(track.position).any() for track in tracks)
    assert "2 of the 5 flights are shown" in capsys.readouterr().err


def test_no_more_flights_are_shown_to_a_person_than_there_are(run, drawn):
    with pytest.raises(lem.UserError, match="At most 2 flights of this run can be shown, not 5"):
        lem.watch(run, episodes=5, video="video.gif")
    assert lem.watch(run, episodes=2, video="video.gif").episodes == 2


def test_a_scene_that_is_known_when_environments_are_made_is_drawn_and_they_are_closed(run):
    files = lem.plot(run)
    assert {"flight.png", "error.png"} <= {file.name for file in files}
    assert Aviary.open == 0


def test_the_film_of_a_report_is_named_before_its_page(run, drawn, monkeypatch):
    monkeypatch.setattr(curves, "plot_runs", lambda *_, **__: [])
    assert [file.name for file in plots.draw_run(run, record_video=True)[-2:]] == ["flight.gif", "report.html"]


def test_a_flight_is_drawn_wherever_it_is():
    """Far from the origin too."""
    there = np.array([[10 + 0.1 * t, 0.0, 5.0] for t in range(5)])
    attitude = np.tile([0.0, 0.0, 0.0, 1.0], (5, 1))
    beside = there + np.array([0, 0, 0.2])
    last = flight.animate(flight.Flight(there, beside, attitude, 0.1, np.zeros((0, 15))), every=1)[-1]
    blue = np.array([0x1F, 0x5F, 0xA8])
    assert (np.abs(last.astype(int) - blue).max(axis=-1) < 40).any()


@pytest.mark.long
def test_the_distance_in_pictures_is_the_true_one_however_late_the_observation():
    pytest.importorskip("crazyflow")
    kwargs = {"observation_delay": 0.1}
    config = lem.config_for("ppo", "DroneFigureEightTrajectory-v0", num_envs=4, minibatch_size=128, env_kwargs=kwargs)
    env = evaluation_env(config, 4)
    table = EpisodeTable(env.num_envs, env.device)
    flights = flight.record(env.baseline, env, 4, 0, table=table)
    scores = table.evaluation(env.spec.env_id, env.summaries)
    after = np.concatenate([one.error_mm[50:] for one in flights])
    assert scores.measures["rmse_after_1s_mm"] == pytest.approx(np.sqrt(np.mean(after**2)), rel=1e-3)
    observed = np.concatenate([1000 * np.linalg.norm(one.position - one.reference, axis=-1)[50:] for one in flights])
    assert np.abs(observed - after).max() > 5, "late by a tenth of a second"


def test_a_measured_distance_takes_the_place_of_the_observed_one():
    there = np.zeros((3, 3))
    one = flight.Flight(there, there + 1, np.tile([0.0, 0, 0, 1], (3, 1)), 0.1, np.zeros((0, 15)), np.full(3, 0.002))
    assert one.error_mm.tolist() == [2.0, 2.0, 2.0]
