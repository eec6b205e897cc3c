"""MinAtar's games and Gymnasium-Robotics: ids, observations, and what is said where a package is missing."""

import numpy as np
import pytest
import torch
from test_contract import play

from lemniscate.envs import registry
from lemniscate.errors import UserError, is_installed

GAMES = ["Asterix", "Breakout", "Freeway", "Seaquest", "SpaceInvaders"]
here = pytest.mark.skipif(not is_installed("minatar"), reason="the extra minatar is not installed")


def test_the_ids_are_served_and_the_extra_is_named():
    assert registry.backend_for("MinAtar/Breakout-v1") == "minatar"
    if not is_installed("minatar"):
        with pytest.raises(UserError, match=r"minatar is not installed; it comes with the extra minatar"):
            registry.make("MinAtar/Breakout-v1", 1)
    with pytest.raises(UserError, match=r"There is no environment 'MinAtar/Tetris-v1'"):
        registry.make("MinAtar/Tetris-v1", 1)


@here
@pytest.mark.parametrize("game", GAMES)
def test_a_game_is_of_bytes_and_repeats_itself(game):
    env = registry.make(f"MinAtar/{game}-v1", 3)
    torch.manual_seed(0)
    first = play(env, 60)
    torch.manual_seed(0)
    again = play(env, 60)
    assert env.spec.image
    assert set(first.obs.unique().tolist()) == {0, 255}
    assert torch.equal(first.obs, again.obs)
    assert not torch.equal(first.obs[:, 0], first.obs[:, 1])
    assert first.obs.any(-1).all()


@here
def test_the_reward_and_the_end_are_the_games(monkeypatch):
    env = registry.make("MinAtar/Breakout-v1", 1, kwargs={"sticky_action_prob": 0.0})
    env.restart(0)
    rewards, ends = [], 0
    for _ in range(300):
        step = env.step(torch.zeros(1, dtype=torch.int64))
        rewards.append(step.reward.item())
        ends += int(step.terminated)
    assert set(rewards) <= {0.0, 1.0}
    assert ends >= 3


@here
def test_a_field_can_be_drawn():
    backend = registry.backend_class("minatar")
    env = backend.make_rendered("MinAtar/Breakout-v1", "rgb_array", {}, ())
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (200, 200, 3)
    assert len(np.unique(picture)) > 2


@pytest.mark.skipif(not is_installed("gymnasium_robotics"), reason="the extra robotics is not installed")
@pytest.mark.parametrize("env", ["FetchReach-v4", "HandReach-v3", "AntMaze_UMaze-v5", "AdroitHandDoor-v1"])
def test_robots_are_served_by_their_ids_and_repeat_themselves(env, capfd):
    assert registry.backend_for(env) == "robotics"
    made = registry.make(env, 2)
    torch.manual_seed(0)
    first = play(made, 20)
    torch.manual_seed(0)
    assert torch.equal(first.obs, play(made, 20).obs)
    assert not torch.equal(first.obs[:, 0], first.obs[:, 1])
    made.close()
    assert "v1 reproducibility" not in capfd.readouterr().err


@pytest.mark.skipif(not is_installed("gymnasium_robotics"), reason="the extra robotics is not installed")
@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async"])
def test_robots_are_made_by_the_name_of_their_package_too_and_in_workers(backend):
    made = registry.make("gymnasium_robotics:FetchReach-v4", 2, backend=backend)
    assert play(made, 5).reward.unique().tolist() == [-1.0]
    made.close()


def test_where_the_robots_are_missing_the_extra_is_named(monkeypatch):
    monkeypatch.setattr("lemniscate.envs.packages.is_installed", lambda package: False)
    with pytest.raises(UserError, match="gymnasium_robotics is not installed; it comes with the extra robotics"):
        registry.make("FetchReach-v4", 1)
