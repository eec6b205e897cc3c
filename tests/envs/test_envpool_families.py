"""Every family of EnvPool's keeps the contract, or is refused with the reason."""

import numpy as np
import pytest
import torch

from lemniscate.envs import registry
from lemniscate.envs.registry import make_rendered
from lemniscate.envs.spaces import random_action
from lemniscate.errors import UserError

envpool = pytest.importorskip("envpool")

from lemniscate.envs.envpool import PREFIX, REFUSED, family, refusal

N, LIMIT = 3, 5
ONE_OF_EACH = {
    "atari": "Pong-v5",
    "box2d": "BipedalWalker-v3",
    "classic_control": "Acrobot-v1",
    "gfootball": "gfootball/academy_empty_goal-v1",
    "highway": "Parking-v0",
    "jumanji": "Maze-v0",
    "minigrid": "MiniGrid-Empty-Random-6x6-v0",
    "mujoco.dmc": "CartpoleSwingup-v1",
    "mujoco.gym": "Hopper-v4",
    "mujoco.metaworld": "MetaWorld/Reach-v3",
    "mujoco.myosuite": "myoElbowPose1D6MRandom-v0",
    "mujoco.playground": "Go1JoystickFlatTerrain-v1",
    "mujoco.robotics": "FetchReach-v4",
    "pgx": "Play2048-v1",
    "toy_text": "Taxi-v3",
}
SLOW = ("gfootball", "mujoco.metaworld", "mujoco.myosuite", "mujoco.playground")
LAID_OUT = {
    "atari": ((84, 84, 4), True),
    "gfootball": ((72, 96, 4), True),
    "mujoco.robotics": ((10,), False),
}
"""the shape of the first part of the observation, and whether it is an image"""


def test_each_family_is_known():
    assert {family(task) for task in envpool.list_all_envs()} == {*ONE_OF_EACH, *REFUSED}


@pytest.mark.parametrize(
    "part", [pytest.param(part, marks=pytest.mark.long if part in SLOW else ()) for part in ONE_OF_EACH]
)
def test_a_time_limit_cuts_and_shows_the_true_final_observation(part):
    """With the same seed and actions, an environment with a limit of 5 steps goes the way of one with its own limit.

    Up to the cut, and in the observation of the cut itself, both are the same.
    """
    env_id = PREFIX + ONE_OF_EACH[part]
    usual, short = registry.make(env_id, N), registry.make(env_id, N, kwargs={"max_episode_steps": LIMIT})
    assert short.spec.max_episode_steps == LIMIT
    assert usual.spec.max_episode_steps is None or usual.spec.max_episode_steps > LIMIT
    if part in LAID_OUT:
        assert (usual.spec.observation_parts[0].shape, usual.spec.image) == LAID_OUT[part]
    first = None
    for _ in range(2):
        begun = usual.restart(3).clone()
        assert begun.dtype == (torch.uint8 if usual.spec.image else torch.float32)
        assert begun.shape == (N, usual.spec.observation_size + usual.spec.action.mask_size)
        assert torch.equal(begun, short.restart(3))
        assert first is None or torch.equal(begun, first)  # the same seed, the same beginning
        first = begun
        rng, going = torch.Generator().manual_seed(0), torch.ones(N, dtype=torch.bool)
        for t in range(LIMIT):
            action = random_action(usual.spec, usual.obs, rng)
            step, cut = usual.step(action), short.step(action)
            for name in ("next_obs", "reward", "terminated"):
                if name != "terminated" or t < LIMIT - 1:  # EnvPool says truncated where both come together
                    assert torch.equal(getattr(step, name)[going], getattr(cut, name)[going]), (t, name)
            assert step.reward.dtype == torch.float32
            assert not (cut.terminated & cut.truncated).any()
            going &= ~step.terminated
            assert (cut.truncated[going] == (t == LIMIT - 1)).all()
    same = (cut.obs == cut.next_obs).all(1)
    assert same[~cut.truncated & ~cut.terminated].all()
    assert not same[going].any() or part == "toy_text"  # there, an episode may begin where another was cut
    usual.close()
    short.close()


@pytest.mark.parametrize(
    ("task", "said"),
    [
        ("CoinrunEasy-v0", "hides the final observation"),
        ("Basic-v1", "numbers without bounds"),
        ("Chess-v1", "several players"),
        ("IntersectionMultiAgent-v0", "several players"),
        ("Pong-v6", "did you mean Pong-v5"),
    ],
)
def test_what_is_not_served_says_why(task, said):
    with pytest.raises(UserError, match=said):
        registry.make(PREFIX + task, 2)


@pytest.mark.long
def test_no_other_environment_has_several_players():
    for task in envpool.list_all_envs():
        if not refusal(task):
            assert envpool.make_spec(task).config.max_num_players == 1, task


@pytest.mark.parametrize(
    ("env_id", "kwargs", "said"),
    [
        (
            "EnvPool/Pong-v5",
            {"reward_clp": True},
            "no option of EnvPool’s Pong-v5 'reward_clp': did you mean reward_clip",
        ),
        (
            "EnvPool/Pong-v5",
            {"episodic_life": "x"},
            "episodic_life of EnvPool's Pong-v5 must be of type bool, such as False",
        ),
        ("EnvPool/Pong-v5", {"seed": 3}, "seed is no argument of an environment"),
        ("CartPole-v1", {"sutton_barto_reward": True}, "are those of the gymnasium backend"),
    ],
)
def test_a_wrong_option_is_said(env_id, kwargs, said):
    with pytest.raises(UserError, match=said):
        registry.make(env_id, 2, kwargs=kwargs)


def test_ids_are_listed_and_none_is_mistaken_for_gymnasiums():
    ids = registry.known_ids()
    assert "EnvPool/Pong-v5" in ids
    assert "EnvPool/Chess-v1" not in ids
    assert "Pong-v5" not in ids
    assert registry.backend_for("EnvPool/Pong-v5") == registry.backend_for("Hopper-v5") == "envpool"


@pytest.mark.long
def test_lives_of_an_atari_game_are_episodes_if_asked():
    """Breakout has five lives; without a ball in play, nothing is lost but by random actions."""

    def lengths(**kwargs):
        env, rng = registry.make("EnvPool/Breakout-v5", 4, kwargs=kwargs), torch.Generator().manual_seed(0)
        env.restart(0)
        for _ in range(600):
            env.step(random_action(env.spec, env.obs, rng))
        found = env.take_episodes().lengths
        env.close()
        return found

    games, lives = lengths(), lengths(episodic_life=True, reward_clip=True)
    assert len(lives) > 3 * len(games) > 0
    assert np.mean(lives) < np.mean(games) / 2


def test_an_environment_is_rendered_by_envpool():
    env = make_rendered("EnvPool/Pong-v5", "rgb_array", {}, (), None)
    obs, _ = env.reset(seed=1)
    assert obs.shape == (4, 84, 84)
    assert env.step(np.int64(2))[0].shape == (4, 84, 84)
    assert env.render().shape == (210, 160, 3)
