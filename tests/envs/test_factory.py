"""Environments by id, class and function, with arguments and wrappers; and what they measure."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import NormalizeReward, vector
from gymnasium.wrappers.utils import RunningMeanStd

import environments
import lemniscate as lem
import toy
from environments import PlusOne, Reach, times_ten
from lemniscate.algos import ppo
from lemniscate.envs import registry
from lemniscate.errors import UserError
from lemniscate.system.world import World


def reward_of(env, **kwargs):
    made = registry.make(env, 2, **kwargs)
    try:
        made.restart(0)
        return made.step(torch.zeros(2, dtype=torch.int64)).reward[0].item()
    finally:
        made.close()


def test_an_environment_is_named_in_four_ways():
    assert reward_of("environments:Reach", kwargs={"reward": 2.0}) == 2
    assert reward_of(Reach, kwargs={"reward": 3.0}) == 3
    assert reward_of(lambda reward=4.0: Reach(reward=reward)) == 4
    assert reward_of(lambda reward: Reach(reward=reward), kwargs={"reward": 5.0}) == 5
    assert reward_of(lambda num_envs: toy.Countdown(num_envs, "DISABLED")) == 1


@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async"])
def test_wrappers_are_applied_in_order(backend):
    wrappers = ("environments:PlusOne", times_ten, "environments:PlusOne(by=0.5)")
    assert reward_of(Reach, wrappers=wrappers, backend=backend) == 20.5
    assert reward_of(Reach, wrappers=(times_ten, PlusOne), backend=backend) == 11


def test_gymnasiums_own_arguments_and_wrappers():
    assert registry.make("Pendulum-v1", 2).spec.max_episode_steps == 200
    assert registry.make("Pendulum-v1", 2, kwargs={"max_episode_steps": 7}).spec.max_episode_steps == 7
    limited = registry.make(Reach, 2, wrappers=["gymnasium.wrappers:TimeLimit(max_episode_steps=3)"])
    assert limited.spec.max_episode_steps == 3
    limited.restart(0)
    for t in range(3):
        step = limited.step(torch.zeros(2, dtype=torch.int64))
        assert step.truncated.all() == (t == 2)
    stacked = registry.make("CartPole-v1", 2, wrappers=["gymnasium.wrappers:FrameStackObservation(stack_size=3)"])
    assert stacked.spec.observation_parts[0].shape == (3, 4)


@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async", "envpool"])
@pytest.mark.parametrize(("argument", "instead"), registry.ARGUMENTS_OF_MAKE.items())
def test_arguments_of_make_are_left_out(backend, argument, instead):
    with pytest.raises(UserError) as raised:
        registry.make("CartPole-v1", 2, kwargs={argument: None}, backend=backend)
    assert str(raised.value).startswith(f"{argument} is no argument of an environment: leave it out")
    assert instead in str(raised.value)


def test_ones_own_environment_may_have_a_seed_among_its_arguments():
    def seeded(seed, reward=1.0):
        return Reach(reward=seed)

    assert reward_of(seeded, kwargs={"seed": 5}) == 5
    with pytest.raises(UserError, match=r"render_mode is no argument .* with video \(--video FILE\)"):
        reward_of(Reach, kwargs={"render_mode": "human"})


@pytest.mark.parametrize("wrappers", [(), (PlusOne,)])
@pytest.mark.parametrize("shards", [1, 2])
def test_a_method_is_called_of_every_environment_and_again_of_those_that_are_built_again(shards, wrappers):
    """A run restarts its environments at each checkpoint: what a curriculum has decided holds there too."""
    made = registry.make(environments.Graded, 4, wrappers=wrappers, world=World(shards))
    for level, seed in ((0.0, 0), (3.0, 1), (3.0, 2)):
        made.restart(seed)
        if seed == 1:
            made.backend.call({"set_level": level})
        for _ in range(10):  # beyond the end of an episode
            assert made.step(torch.zeros(4, dtype=torch.int64)).reward.tolist() == [level + len(wrappers)] * 4
    made.close()


class Running(gym.Wrapper):
    """A wrapper of one's own with a running mean and variance."""

    def __init__(self, env):
        super().__init__(env)
        self._scale = RunningMeanStd(shape=())


class Named(gym.Wrapper):
    """Its statistics are of another make, but have the usual name."""

    def __init__(self, env):
        super().__init__(env)
        self.obs_rms = {"all": 0.0}


class Within(Reach):
    """It learns inside, of another environment that it holds."""

    def __init__(self):
        super().__init__()
        self.env = NormalizeReward(Reach())


def hidden():
    return gym.wrappers.ClipReward(NormalizeReward(Reach()), -1, 1)


def fixed():
    env = NormalizeReward(Reach())
    env.update_running_mean = False
    return env


gym.register("Learns-v0", Reach, additional_wrappers=(NormalizeReward.wrapper_spec(gamma=0.9, epsilon=1e-8),))


@pytest.mark.parametrize(
    ("env", "fields", "name"),
    [
        (Reach, {"wrappers": ["gymnasium.wrappers:NormalizeObservation"]}, "NormalizeObservation"),
        (Reach, {"wrappers": [lambda env: PlusOne(NormalizeReward(env))]}, "NormalizeReward"),
        (Reach, {"wrappers": [Running]}, "Running"),
        (Reach, {"wrappers": [Named]}, "Named"),
        (Within, {}, "NormalizeReward"),
        (hidden, {}, "NormalizeReward"),
        (hidden, {"backend": "gymnasium-async"}, "NormalizeReward"),
        ("Learns-v0", {}, "NormalizeReward"),
        (lambda num_envs: gym.vector.SyncVectorEnv([hidden] * num_envs), {}, "NormalizeReward"),
        (lambda num_envs: gym.vector.AsyncVectorEnv([hidden] * num_envs), {}, "AsyncVectorEnv"),
        (lambda num_envs: vector.NormalizeReward(gym.vector.SyncVectorEnv([Reach] * num_envs)), {}, "NormalizeReward"),
    ],
)
def test_what_learns_statistics_is_refused_wherever_it_stands(env, fields, name):
    with pytest.raises(UserError, match=f"{name} learns statistics, .* normalize_observations, .*scale_rewards"):
        registry.make(env, 2, **fields)


def test_fixed_statistics_and_tables_are_the_environments_own():
    class Table(gym.Wrapper):
        def __init__(self, env):
            super().__init__(env)
            self.prices = np.ones((3, 3))  # has methods mean and var
            self.count = {"mean": 0, "var": 1}

    assert reward_of(fixed) == 1
    assert reward_of(Reach, wrappers=[Table]) == 1


def test_a_filter_with_a_mean_and_a_variance_learns_nothing_of_the_training():
    class Kalman:
        mean, var = 0.0, 1.0

        def update(self, seen): ...

    class Filtering(Reach):
        def __init__(self):
            super().__init__()
            self.filter = Kalman()

    assert reward_of(Filtering) == 1


def test_wrappers_choose_the_backend_that_can_wrap():
    assert registry.backend_for("CartPole-v1") == "envpool"
    assert registry.backend_for("CartPole-v1", ("gymnasium.wrappers:ClipReward",)) == "gymnasium"


@pytest.mark.parametrize(
    ("env", "fields", "said"),
    [
        ("Pendulum-v1", {"kwargs": {"gravity": 1}}, "Pendulum-v1 cannot be made with gravity=1"),
        ("Pendulum-v1", {"kwargs": ["g"]}, "The arguments of an environment are a dictionary"),
        (Reach, {"wrappers": ["environments:PlusOne(of=2)"]}, "unexpected keyword argument 'of'"),
        (Reach, {"wrappers": ["gymnasium.wrappers:Nothing"]}, "gymnasium.wrappers has no Nothing"),
        (Reach, {"wrappers": ["math:sqrt"]}, "cannot be made with math:sqrt: must be real number"),
        ("EnvPool/Pong-v5", {"wrappers": ["m:f"]}, "The envpool backend cannot wrap EnvPool/Pong-v5"),
        ("DroneLanding-v0", {"wrappers": ["m:f"]}, "The crazyflow backend cannot wrap DroneLanding-v0"),
        ("DroneLanding-v0", {"kwargs": {"dynamic": 1}}, "did you mean dynamics"),
        ("DroneLanding-v0", {"kwargs": {"dynamics": "heavy"}}, "There is no dynamics 'heavy'"),
        ("Countdown-v0", {"wrappers": [times_ten]}, "The gymnasium backend cannot wrap Countdown-v0"),
        (Reach(), {}, "env is an environment that is made already; give its class"),
        (Reach(), {}, "training makes as many as it needs."),
        (
            gym.vector.SyncVectorEnv([Reach]),
            {},
            "made already; give a function that makes as many as it is told: def make(",
        ),
        (
            lambda num_envs: Reach(),
            {},
            "a Reach, not a gymnasium.vector.VectorEnv; what has an argument num_envs makes",
        ),
        (3, {}, "env is 3; give its class"),
        (lambda: 3, {}, "cannot be made: it makes an int, not a gymnasium.Env"),
        (dict, {}, "neither an environment class, nor a function, nor an id"),
    ],
)
def test_what_cannot_be_made_is_said(env, fields, said):
    with pytest.raises(UserError) as raised:
        registry.make(env, 2, **fields)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_measures_are_what_the_metadata_names_and_success():
    env = registry.make(Reach, 2)
    env.restart(0)
    steps = [env.step(torch.zeros(2, dtype=torch.int64)).measures for _ in range(5)]
    assert set(steps[0]) == {"is_success", "height", "info/unnamed"}
    assert [step["is_success"][0].item() for step in steps] == [0, 0, 0, 1, 0]
    assert steps[0]["height"].tolist() == [1, 1]
    assert "height" not in steps[1]


def test_a_measure_of_some_environments_is_nan_in_the_others():
    def make():
        env = Reach()
        env.metadata = {"render_modes": [], "measures": ["height"]}
        return env

    class Half(gym.Wrapper):
        def reset(self, *, seed=None, options=None):
            self.first = seed == 0
            return super().reset(seed=seed, options=options)

        def step(self, action):
            *rest, info = super().step(action)
            return (*rest, info if self.first else {})

    env = registry.make(make, 2, wrappers=[Half])
    env.restart(0)
    measures = env.step(torch.zeros(2, dtype=torch.int64)).measures
    assert measures["height"][0] == 1
    assert measures["height"][1].isnan()


class Same(toy.Countdown):
    """Resets in the step of an end, and keeps the true info of that step apart."""

    def __init__(self, num_envs):
        super().__init__(num_envs, "SAME_STEP", length=3)
        self.metadata["measures"] = ["height"]

    def step(self, actions):
        *rest, info = super().step(actions)
        info["height"], info["_height"] = self.t.astype(float), np.ones(self.num_envs, bool)
        if "final_obs" in info:
            info["final_info"] = {"height": info["final_obs"][:, 2], "_height": info["_final_obs"]}
        return (*rest, info)


def test_the_measure_of_a_last_step_is_that_before_the_reset():
    env = registry.make(Same, 2)
    env.restart(0)
    heights = [env.step(torch.zeros(2, dtype=torch.int64)).measures["height"].tolist() for _ in range(4)]
    assert heights == [[1, 1], [2, 2], [3, 3], [1, 1]]


@pytest.mark.parametrize("wrappers", [PlusOne, "environments:PlusOne", (PlusOne for _ in range(1)), [PlusOne]])
def test_one_wrapper_alone_and_those_of_a_generator_are_a_list_of_them(wrappers):
    assert lem.config_for("ppo", "CartPole-v1", wrappers=wrappers).wrappers == ("environments:PlusOne",)


def test_a_vector_that_makes_one_number_is_evaluated_in_as_many(tmp_path):
    class Fixed(toy.Countdown):
        def __init__(self, num_envs):
            assert num_envs == 3, num_envs
            super().__init__(num_envs, "DISABLED")

    fields = {"num_envs": 3, "num_steps": 8, "minibatch_size": 8, "total_steps": 48, "progress": False}
    run = lem.train("ppo", Fixed, run=tmp_path / "r", evaluate_every=24, **fields)
    assert lem.evaluate(run, episodes=20).returns == [5.0] * 20


def test_actions_of_another_shape_are_refused():
    env = registry.make("CartPole-v1", 4)
    env.restart(0)
    with pytest.raises(
        UserError, match=r"4 × CartPole-v1: actions are a Tensor \[4\] of torch.int64, not Tensor \[3\]"
    ):
        env.step(torch.zeros(3, dtype=torch.int64))


@pytest.mark.parametrize(
    ("shape", "laid_out"),
    [((9, 12, 3), (9, 12, 3)), ((3, 9, 12), (9, 12, 3)), ((4, 84, 84), (84, 84, 4)), ((4, 9, 12, 3), (9, 12, 12)), ((4, 3, 9, 12), (9, 12, 12))],
)  # fmt: skip
def test_images_are_brought_to_one_layout(shape, laid_out):
    """Channels first or last, stacked or not: pixel (y, x) of picture s and channel c stands at s · C + c."""
    env = registry.make(lambda: environments.Pictures(shape), 2)
    obs = env.restart(0)
    assert env.spec.image
    assert env.spec.observation_parts[0].shape == laid_out
    raw = np.stack([environments.Pictures(shape).reset(seed=seed)[0] for seed in (0, 1)])
    channel_axis = int(np.argmin(shape[-3:])) - 3
    expected = np.moveaxis(raw, channel_axis, -1)
    if len(shape) == 4:
        expected = np.moveaxis(expected, 1, -2)
    assert torch.equal(obs.view(2, *laid_out), torch.from_numpy(expected.reshape(2, *laid_out)))


def test_mujoco_says_nothing_of_gymnasiums_own_models(tmp_path, monkeypatch, capfd):
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    registry.make("HalfCheetah-v5", 2, backend="gymnasium").close()
    assert not capfd.readouterr().err
    assert not list(tmp_path.iterdir())


class Taking(gym.Env):
    """Takes what it is given out of it, as one does with options."""

    observation_space = gym.spaces.Box(-9, 9, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, given):
        self.mass = given["inner"].pop("mass", 1.0)

    def reset(self, *, seed=None, options=None):
        self.start = (options or {}).get("at", [{}])[0].pop("x", 0.0)
        return self.seen(), {}

    def step(self, action):
        return self.seen(), 0.0, True, False, {}

    def seen(self):
        return np.array([10 * self.mass + self.start], np.float32)


class Pulling(gym.ObservationWrapper):
    """Takes its factor out of what it is given."""

    def __init__(self, env, given):
        super().__init__(env)
        self.factor = given.pop("factor", 1.0)

    def observation(self, observation):
        return self.factor * observation


@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async"])
def test_each_environment_has_arguments_options_and_wrappers_of_its_own(backend):
    given = {"given": {"inner": {"mass": 0.25}}}
    own = {"env_kwargs": given, "reset_options": {"at": [{"x": 0.5}]}}
    config = ppo.Config(env="test_factory:Taking", wrappers=("test_factory:Pulling(given={'factor': 2.0})",), **own)
    env = registry.make(config.env, 3, kwargs=config.env_kwargs, wrappers=config.all_wrappers, backend=backend)
    for _ in range(2):
        env.restart(0)
        assert env.obs.tolist() == [[6.0]] * 3
        env.step(torch.zeros(3, dtype=torch.int64))
        assert env.obs.tolist() == [[6.0]] * 3
    env.close()
    assert config.env_kwargs == given == {"given": {"inner": {"mass": 0.25}}}


class Shared(gym.Env):
    """Writes each observation into one array, that of the class."""

    seen = np.zeros(2, np.float32)
    observation_space = gym.spaces.Box(-9, 9, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._look(), {}

    def step(self, action):
        return self._look(), 0.0, False, True, {}

    def _look(self):
        self.seen[:] = self.np_random.random(2)
        return self.seen


class SharedDict(Shared):
    """The same in a dictionary."""

    observation_space = gym.spaces.Dict({"a": Shared.observation_space})

    def _look(self):
        return {"a": super()._look()}


@pytest.mark.parametrize("env", [Shared, SharedDict])
def test_environments_that_write_into_one_array_are_seen_apart(env):
    made = registry.make(env, 3)
    made.restart(0)
    assert len(made.obs.unique(dim=0)) == 3
    step = made.step(torch.zeros(3, dtype=torch.int64))
    assert len(torch.cat([step.obs, step.next_obs]).unique(dim=0)) == 6


class Plain(gym.vector.VectorEnv):
    """A vector environment of two numbers."""

    metadata = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP}  # noqa: RUF012
    single_observation_space, single_action_space = Shared.observation_space, Shared.action_space

    def __init__(self, num_envs):
        self.num_envs = num_envs

    def reset(self, *, seed=None, options=None):
        return np.zeros((self.num_envs, 2), np.float32), {}

    def step(self, actions):
        none, all_ = np.zeros(self.num_envs, bool), np.ones(self.num_envs, bool)
        return self.reset()[0], np.zeros(self.num_envs), none, all_, {"final_obs": [None] * self.num_envs}


def final(obs):
    """It, with other final observations."""

    def step(self, actions):
        return *Plain.step(self, actions)[:4], {} if obs is None else {"final_obs": obs}

    return type("Final", (Plain,), {"step": step})


class Lone(Plain):
    def __init__(self):
        super().__init__(2)


class Twice(Plain):
    def __init__(self, num_envs):
        super().__init__(2 * num_envs)


class Unspaced(Plain):
    single_action_space = None


class Seeded(Plain):
    def reset(self, *, seed=None):
        return super().reset()


@pytest.mark.parametrize(
    ("env", "said"),
    [
        (Lone, "unexpected keyword argument 'num_envs'; a vector environment is made with num_envs"),
        (Twice, "Twice has 4 environments where num_envs is 2; it must make as many"),
        (Unspaced, "Unspaced has no single_action_space: set self.single_action_space in its __init__"),
        (
            Seeded,
            r"Seeded.reset\(\) .*takes no seed or no options; it must be reset\(self, \*, seed=None, options=None\)",
        ),
        (Plain, r"hides the final observation \(no info\['final_obs'\]\[0\]\)"),
        (final(None), r"hides the final observation \(no info\['final_obs'\]\)"),
        (final(1.0), r"hides the final observation \(no info\['final_obs'\]\[0\]\)"),
        (final([np.zeros(2)]), r"hides the final observation \(no info\['final_obs'\]\[1\]\)"),
        (final(np.zeros((2, 3))), r"gives in info\['final_obs'\] an observation of shape \(3,\); its space is Box"),
        (final({"a": np.zeros((2, 2))}), r"gives in info\['final_obs'\] an observation that is .*; its space is Box"),
    ],
)
def test_a_vector_environment_that_cannot_be_used_is_said(env, said):
    def play():
        made = registry.make(env, 2)
        made.restart(0)
        made.step(torch.zeros(2, dtype=torch.int64))

    with pytest.raises(UserError, match=said):
        play()
