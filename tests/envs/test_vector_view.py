"""Our vectors as Gymnasium's: beside Gymnasium's own, through its wrappers, over every kind of space and backend."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as wrappers

import environments
import lemniscate as lem
import toy
from lemniscate.envs.vector_view import NormalizeObservation


def theirs(env_id, num_envs):
    return SyncVectorEnv([lambda: gym.make(env_id)] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)


def same_info(mine, their):
    assert set(their) - {"final_info", "_final_info"} == set(mine) - {"final_info", "_final_info"}
    for row in np.flatnonzero(their.get("_final_obs", ())):
        assert np.array_equal(mine["final_obs"][row], their["final_obs"][row])
    if "_final_obs" in their:
        assert np.array_equal(mine["_final_obs"], their["_final_obs"])
        assert all(mine["final_obs"][row] is None for row in np.flatnonzero(~mine["_final_obs"]))


@pytest.mark.parametrize(("env_id", "steps"), [("CartPole-v1", 400), ("Pendulum-v1", 420)])
def test_it_steps_as_gymnasiums_own(env_id, steps):
    """Pendulum ends by its time limit alone, CartPole by falling; its actions come in units of the environment."""
    mine, their = lem.make_vec(env_id, 3, backend="gymnasium"), theirs(env_id, 3)
    assert mine.metadata["autoreset_mode"] is their.metadata["autoreset_mode"]
    assert mine.single_action_space == their.single_action_space
    assert mine.single_observation_space.shape == their.single_observation_space.shape
    assert np.array_equal(mine.reset(seed=7)[0], their.reset(seed=7)[0])
    their.action_space.seed(7)
    ends = 0
    for _ in range(steps):
        action = their.action_space.sample()
        (*step, info), (*their_step, their_info) = mine.step(action), their.step(action)
        for what, their_what in zip(step, their_step, strict=True):
            np.testing.assert_allclose(what, their_what, rtol=1e-4, atol=1e-4)
            assert what.dtype == their_what.dtype or what.dtype == np.float32
        same_info(info, their_info)
        ends += step[2].sum() + step[3].sum()
    assert ends >= 6
    mine.close(), their.close()


@pytest.mark.parametrize("kind", [kind for kind in environments.KINDS if kind != "image"])
def test_every_kind_of_action_arrives_as_it_was_given(kind):
    env = lem.make_vec(f"Copy-{kind}-v0", 4, backend="gymnasium")
    obs, info = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    assert env.single_action_space == environments.KINDS[kind][1]
    if kind == "masked":
        assert info["action_mask"].sum(1).tolist() == [2, 2, 2, 2]
    env.action_space.seed(0)
    for _ in range(20):
        obs, *_ = env.step(env.action_space.sample())
        assert env.observation_space.contains(obs)
    if kind == "discrete":  # 5 to 7 seen, one-hot; −1 to 1 to be done
        assert env.step(obs.argmax(1) - 1)[1].tolist() == [1, 1, 1, 1]
    env.close()


def test_images_keep_their_bytes_and_their_shape():
    env = lem.make_vec("Copy-image-v0", 2, backend="gymnasium")
    obs, _ = env.reset(seed=0)
    assert (obs.shape, obs.dtype) == ((2, 9, 12, 3), np.uint8)


@pytest.mark.parametrize(("env_id", "actions"), [("CartPole-v1", ()), ("Hopper-v5", (3,))])
def test_gymnasiums_wrappers_go_around_any_backend(env_id, actions):
    env = wrappers.RecordEpisodeStatistics(NormalizeObservation(lem.make_vec(env_id, 4)))
    obs, _ = env.reset(seed=0)
    env.reset(seed=0)
    assert obs.shape == (4, *env.single_observation_space.shape)
    assert env.single_action_space.shape == actions
    env.action_space.seed(0)
    returns = 0
    for _ in range(60):
        obs, _, _, _, info = env.step(env.action_space.sample())
        returns += info.get("_episode", np.zeros(4)).sum()
        assert np.isfinite(obs).all()
    assert returns == env.episode_count > 0
    assert env.env.obs_rms.count == pytest.approx(62 * 4, abs=1)
    env.close()


def test_a_seed_begins_the_same_episodes_and_none_begins_others():
    env = lem.make_vec("CartPole-v1", 2)
    assert np.array_equal(env.reset(seed=3)[0], env.reset(seed=3)[0])
    assert not np.array_equal(env.reset()[0], env.reset()[0])


def test_the_final_observation_is_normalized_and_not_counted():
    env = NormalizeObservation(lem.make_vec(toy.Countdown, 2, env_kwargs={"mode": "DISABLED", "length": 2}))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.update_running_mean = False
    mean, std = env.obs_rms.mean, np.sqrt(env.obs_rms.var + env.epsilon)
    *_, info = env.step(env.action_space.sample())
    assert env.obs_rms.mean is mean
    raw = info["final_obs"][1] * std + mean
    assert raw[-1] == pytest.approx(2, abs=1e-5)


def test_what_resets_one_step_later_says_so_and_pays_nothing_for_it():
    env = lem.make_vec(toy.Countdown, 2, env_kwargs={"mode": "NEXT_STEP", "length": 2})
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    env.reset(seed=0)
    steps = [env.step(env.action_space.sample()) for _ in range(3)]
    assert [bool((step[2] | step[3]).all()) for step in steps] == [False, True, False]
    assert not steps[2][1].any()
    assert "final_obs" not in steps[1][4]


def test_measures_are_in_the_info_of_the_episode_that_they_belong_to():
    env = lem.make_vec("DroneFigureEightTrajectory-v0", 4)
    env.reset(seed=0)
    for _ in range(60):
        _, _, terminated, _, info = env.step(env.action_space.sample())
        if terminated.any():
            break
    assert np.array_equal(info["_tracking_error"], ~terminated)
    assert np.array_equal(info["final_info"]["_tracking_error"], terminated)
    assert np.isfinite(info["final_info"]["tracking_error"]).all()


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda env: env.step(np.zeros(3, dtype=np.int64)), r"the shape \(2,\) here, not \(3,\)"),
        (lambda env: env.reset(seed=[1, 2]), "seed must be one whole number"),
        (lambda env: env.reset(options={"reset_mask": np.ones(2, bool)}), "without options such as reset_mask"),
    ],
)
def test_what_cannot_be_asked_is_a_sentence(ask, said):
    env = lem.make_vec("CartPole-v1", 2)
    env.reset(seed=0)
    with pytest.raises(lem.UserError, match=said):
        ask(env)


def test_what_is_closed_says_so():
    env = lem.make_vec("CartPole-v1", 2)
    env.reset(seed=0)
    env.close()
    for ask in (env.reset, lambda: env.step([0, 1])):
        with pytest.raises(lem.UserError, match="These environments of CartPole-v1 are closed: make others"):
            ask()


@pytest.mark.parametrize("seed", [-1, None, "x", 1.5, True])
def test_environments_of_a_run_begin_from_whole_numbers(seed):
    env, other = lem.make_envs(lem.config_for("sac", "Pendulum-v1", total_steps=1000, learning_starts=100))
    assert env.restart(np.int64(3)).equal(env.restart(3))
    env.step(torch.zeros(1, 1, requires_grad=True))
    with pytest.raises(lem.UserError, match=f"seed must be a whole number at least 0, not {seed!r}"):
        env.restart(seed)
    env.close()
    other.close()


@pytest.mark.parametrize(
    ("actions", "said"),
    [
        ([0.9, 0.9], "Actions are whole numbers here, and not 0.9"),
        ([np.nan, 0], "Actions are whole numbers here, and not nan"),
        (["a", "b"], "Actions are whole numbers here, and not 'a'"),
        ([None, None], "Actions are whole numbers here, and not nan"),
        ([0], "Actions have the shape"),
    ],
)
def test_what_is_no_choice_is_no_action(actions, said):
    envs = lem.make_vec("CartPole-v1", 2, backend="gymnasium")
    envs.reset(seed=0)
    envs.step(torch.tensor([0.0, 1.0], requires_grad=True))
    envs.step(np.array([0, 1], dtype=object))
    with pytest.raises(lem.UserError, match=said):
        envs.step(actions)


@pytest.mark.parametrize("seed", [-1, 2**32, 2**40, True, [1, 2]])
def test_a_seed_is_one_of_those_of_runs(seed):
    envs = lem.make_vec("CartPole-v1", 2, backend="gymnasium")
    with pytest.raises(lem.UserError, match="seed must be one whole number from 0 to 4,294,967,295"):
        envs.reset(seed=seed)
