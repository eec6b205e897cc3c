"""Action masks, wherever an environment gives them, are obeyed by all that acts; or a sentence says why not."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

import lemniscate as lem
from lemniscate.algos import ppo
from lemniscate.data.rollout import collect
from lemniscate.envs import registry
from lemniscate.envs.spaces import random_action
from lemniscate.errors import UserError
from lemniscate.report.playback import show_episodes

SEEN = np.zeros(2, np.float32)
BOX = spaces.Box(-1, 1, (2,), np.float32)
KINDS = {"discrete": spaces.Discrete(4, start=3), "multi": spaces.MultiDiscrete([3, 4], start=[1, 0])}
PLACES = ["info", "plural", "legal", "method", "key", "key of info's name"]


class Board(gym.Env):
    """One choice of each component is forbidden, another at each step; an episode is 5 steps, its end permits nothing."""

    taken = 0
    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(self, kind="discrete", place="info", render_mode=None):
        self.action_space, self.place, self.render_mode = KINDS[kind], place, render_mode
        self.counts = np.ravel(getattr(self.action_space, "nvec", getattr(self.action_space, "n", 0)))
        self.observation_space = BOX
        if place.startswith("key"):
            part = spaces.Tuple([spaces.MultiBinary(int(n)) for n in self.counts])
            name = "action_mask" if place == "key" else "action_masks"
            self.observation_space = spaces.Dict({name: part, "board": BOX})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.look()

    def step(self, action):
        choices = np.ravel(action - np.array(self.action_space.start))
        Board.taken += sum(not mask[choice] for mask, choice in zip(self.masks(), choices, strict=True))
        self.t += 1
        obs, info = self.look()
        return obs, 0.0, self.t == 5, False, info

    def masks(self):
        return tuple(np.array([(i != self.t % n) and self.t < 5 for i in range(n)], np.int8) for n in self.counts)

    def look(self):
        masks = self.masks()
        told = masks[0].tolist() if len(masks) == 1 else masks
        names = {"info": "action_mask", "plural": "action_masks", "legal": "legal_action_mask"}
        info = {names[self.place]: told} if self.place in names else {}
        obs = {"board": SEEN, "action_mask": masks, "action_masks": masks} if self.place.startswith("key") else SEEN
        return {key: obs[key] for key in self.observation_space} if isinstance(obs, dict) else obs, info

    def render(self):
        return np.zeros((4, 4, 3), np.uint8)

    def __getattr__(self, name):
        if name == "action_masks" and self.place == "method":
            return lambda: np.concatenate(self.masks())
        raise AttributeError(name)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_mask_is_obeyed_wherever_it_stands(kind, place, tmp_path):
    Board.taken = 0
    config = lem.config_for(
        "ppo", Board, env_kwargs={"kind": kind, "place": place}, num_envs=2, num_steps=20, minibatch_size=8
    )
    env, eval_env = lem.make_envs(config)
    assert env.spec.action.mask_size == sum(np.ravel(getattr(KINDS[kind], "nvec", 4)))
    state = ppo.init(config, env.spec, torch.device("cpu"))
    env.restart(0)
    ppo.update(config, state, collect(env, state.policy, 20, state.rng.action))
    eval_env.restart(0)
    for _ in range(10):
        eval_env.step(random_action(eval_env.spec, eval_env.obs, torch.Generator().manual_seed(1)))
    policy = lem.TrainedPolicy(state.networks, env.spec, config, 0)
    lem.evaluate(policy, episodes=3)
    lem.evaluate(policy, episodes=2, deterministic=False, video=tmp_path / "video.gif")
    arguments = {"env": config.env, "kwargs": config.env_kwargs, "wrappers": (), "backend": "gymnasium"}
    show_episodes(None, arguments, 2, 0, tmp_path / "random.gif", tell=lambda text: None)
    assert Board.taken == 0
    made = Board(kind, place)
    obs, info = made.reset()
    told = next(iter(info.values()), None) if place != "method" else made.action_masks()
    for _ in range(4):
        made.step(policy.act(obs, deterministic=False, action_mask=None if place.startswith("key") else told))
        made.t = 0
    assert Board.taken == 0


class Property(Board):
    @property
    def action_masks(self):
        return self.masks()[0]  # before `reset` it raises AttributeError


class Array(Board):
    def __init__(self):
        super().__init__(place="array")
        self.legal_action_mask = np.zeros(4, np.int8)

    def look(self):
        self.legal_action_mask = self.masks()[0]
        return super().look()


@pytest.mark.parametrize("kind", [Property, Array])
def test_a_mask_may_be_a_property_or_an_array(kind):
    Board.taken = 0
    env, rng = registry.make(kind, 2), torch.Generator().manual_seed(0)
    env.restart(0)
    assert env.spec.action.mask_size == 4
    for _ in range(20):
        env.step(random_action(env.spec, env.obs, rng))
    assert Board.taken == 0


def test_a_mask_that_is_asked_for_someone_is_named():
    class Players(Board):
        def action_mask(self, player): ...

    with pytest.raises(
        UserError, match=r"Players\.action_mask, asked for the action mask without arguments, raised Type"
    ):
        registry.make(Players, 2, kwargs={"place": "method of one's own"})


@pytest.mark.parametrize("kind", KINDS)
def test_workers_and_vectors_give_masks_too(kind):
    Board.taken = 0
    env = registry.make(Board, 2, kwargs={"kind": kind}, backend="gymnasium-async")
    env.restart(0)
    assert (
        env.obs[:, 2:].sum(1).tolist()
        == [env.spec.action.mask_size - len(np.ravel(getattr(KINDS[kind], "nvec", 4)))] * 2
    )
    env.close()

    class Vector(VectorEnv):
        metadata = {"autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012
        single_observation_space, single_action_space = BOX, KINDS[kind]

        def __init__(self, num_envs):
            self.num_envs, self.boards = num_envs, [Board(kind) for _ in range(num_envs)]

        def reset(self, *, seed=None, options=None):
            seen = [board.reset() for board in self.boards]
            return np.stack([obs for obs, _ in seen]), self.told()

        def step(self, actions):
            for board, action in zip(self.boards, actions, strict=True):
                board.step(action)
                board.t %= 5
            none = np.zeros(self.num_envs, bool)
            return np.zeros((self.num_envs, 2), np.float32), np.zeros(self.num_envs), none, none, self.told()

        def told(self):
            columns = zip(*(board.masks() for board in self.boards), strict=True)
            stacked = tuple(map(np.stack, columns))
            return {"action_mask": stacked[0] if len(stacked) == 1 else stacked}

    env, rng = registry.make(Vector, 3), torch.Generator().manual_seed(0)
    env.restart(0)
    for _ in range(20):
        env.step(random_action(env.spec, env.obs, rng))
    assert Board.taken == 0


class Late(Board):
    def reset(self, *, seed=None, options=None):
        return super().reset()[0], {}


class Forgetful(Board):
    """Each second step has no mask."""

    def look(self):
        obs, info = super().look()
        return obs, info if self.t % 2 == 0 else {}


class Long(Board):
    def look(self):
        return SEEN, {"action_mask": [1, 1, 1]}


class Single(Board):
    def look(self):
        return SEEN, {"action_mask": 1}


class Stuck(Board):
    def masks(self):
        return (np.zeros(4),)


class Pushed(Board):
    def __init__(self):
        super().__init__()
        self.action_space = BOX

    def look(self):
        return SEEN, {"action_mask": [1, 1]}


@pytest.mark.parametrize(
    ("env", "sentence"),
    [
        (Late, r"gives an action mask in step\(\) that reset\(\) did not give: give one with reset\(\) too, of ones"),
        (
            Long,
            r"Board.reset\(\) \(test_masks.py, line \d+\) comes with an action mask of 3 numbers, \[1, 1, 1\]; it must have 4",
        ),
        (Forgetful, "gives an action mask in some steps and none in others: give one with each step"),
        (Single, r"comes with an action mask of 1 numbers, \[1\]; it must have 4, of 1 and 0"),
        (Stuck, r"rules out every action of environment 0: its action_mask is all zero"),
        (
            Pushed,
            r"reset\(\) .*comes with an action mask that cannot be followed: masks are for Discrete and MultiDiscrete actions",
        ),
    ],
)
def test_a_mask_that_cannot_be_followed_is_a_sentence(env, sentence):
    def play():
        made = registry.make(env, 2)
        made.restart(0)
        for _ in range(3):
            made.step(random_action(made.spec, made.obs, torch.Generator()))

    with pytest.raises(UserError, match=sentence):
        play()


def test_a_mask_by_hand_is_looked_at():
    env = registry.make(Board, 1, kwargs={"kind": "multi"})
    config = lem.config_for("ppo", Board, env_kwargs={"kind": "multi"})
    policy = lem.TrainedPolicy(config.networks(env.spec), env.spec, config, 0)
    masks = ([1, 0, 0], [0, 0, 1, 0])
    assert policy.act(SEEN, action_mask=masks).tolist() == [1, 2]
    both = np.array([[1, 0, 0, 0, 0, 1, 0], [0, 1, 0, 1, 0, 0, 0]])
    assert policy.act(np.stack([SEEN, SEEN]), action_mask=both).tolist() == [[1, 2], [2, 0]]
    assert [part[part > 0].tolist() for part in policy.distribution(SEEN, masks).probabilities] == [[1], [1]]
    with pytest.raises(UserError, match="has action masks of 7 numbers; this is one of 2 numbers"):
        policy.act(SEEN, action_mask=[1, 1])
    with pytest.raises(UserError, match="permits nothing"):
        policy.act(SEEN, action_mask=([0, 0, 0], [1, 1, 1, 1]))


@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async"])
@pytest.mark.parametrize("told", [True, False])
def test_a_mask_holds_for_the_episode_and_none_permits_everything(told, backend):
    class Once(Board):
        def step(self, action):
            return *super().step(action)[:4], {"action_mask": None} if told else {}

    env = registry.make(Once, 2, backend=backend)
    env.restart(0)
    assert env.obs[:, 2:].tolist() == [[0, 1, 1, 1]] * 2
    for _ in range(4):
        env.step(random_action(env.spec, env.obs, torch.Generator()))
        assert env.obs[:, 2:].tolist() == [[1 if told else 0, 1, 1, 1]] * 2
    env.step(random_action(env.spec, env.obs, torch.Generator()))
    assert env.obs[:, 2:].tolist() == [[0, 1, 1, 1]] * 2
    env.close()
