"""Hindsight replay: every copy is a step that was taken, with a goal that was reached later, judged by its environment."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch

import lemniscate as lem
from environments import Walk
from lemniscate.algos import ddpg, sac, td3
from lemniscate.data.hindsight import HindsightReplay, goal_columns
from lemniscate.envs import registry
from lemniscate.errors import UserError, is_installed
from lemniscate.run.metrics import read_metrics
from lemniscate.spec import Box, ObservationPart, Spec
from lemniscate.testing import check_resume
from lemniscate.types import Step
from pretend_device import pretend

CPU = torch.device("cpu")
ACHIEVED, DESIRED, TIME = 0, 1, 2  # the columns of `Walk`, whose keys Gymnasium sorts
SMALL = {
    "replay": "hindsight",
    "num_envs": 2,
    "total_steps": 512,
    "log_every": 64,
    "learning_starts": 64,
    "batch_size": 16,
    "hidden": (16,),
    "critic_hidden": (16,),
    "evaluate_episodes": 2,
}


class Noted(HindsightReplay):
    """It, with the rows of each call of `extend`: of an episode, then of its copies."""

    def extend(self, rows):
        self.stored = [*getattr(self, "stored", []), rows]
        super().extend(rows)


def played(env, steps, num_envs=3, goals=4, capacity=20_000, backend=None, **kwargs):
    """A buffer after so many random steps, and every step that was taken: rows of (environment, obs, …, ended)."""
    made = registry.make(env, num_envs, kwargs=kwargs, backend=backend)
    replay = Noted(made.spec, capacity, CPU, num_envs=num_envs, goals=goals, seed=3)
    made.restart(5)
    replay.on_restart(made.backend.judge_goals)
    generator, taken = torch.Generator().manual_seed(0), []
    for _ in range(steps):
        obs, action = made.obs, torch.rand(num_envs, 1, generator=generator) * 2 - 1
        step = made.step(action)
        replay.add(obs, action, step)
        taken.append((obs, action, step))
    made.close()
    return replay, taken


def episodes_of(taken, num_envs):
    """The whole episodes in the order of their ends: lists of (obs, action, reward, next_obs, terminated)."""
    under_way, whole = [[] for _ in range(num_envs)], []
    for obs, action, step in taken:
        for i in range(num_envs):
            row = obs[i], action[i], step.reward[i], step.next_obs[i], step.terminated[i]
            under_way[i].append(row)
            if step.terminated[i] or step.truncated[i]:
                whole.append(under_way[i])
                under_way[i] = []
    return whole


@pytest.mark.parametrize("backend", [None, "gymnasium-async"])
@pytest.mark.parametrize(("ends", "edge"), [(True, 100.0), (False, 100.0), (True, 2.0), (False, 2.0)])
def test_each_episode_is_stored_as_it_was_and_with_goals_that_were_reached_later(ends, edge, backend):
    """By brute force: rewards and ends of the copies from the rules that `Walk` is described by."""
    replay, taken = played("environments:Walk", 60, ends=ends, edge=edge, limit=12, backend=backend)
    episodes = episodes_of(taken, 3)
    assert len(episodes) > 12
    assert len(replay) == sum(len(rows.reward) for rows in replay.stored)
    for episode, whole, rows in zip(episodes, replay.stored[::2], replay.stored[1::2], strict=True):
        for name, column in zip(vars(whole), zip(*episode, strict=True), strict=True):
            assert torch.equal(getattr(whole, name), torch.stack(column))
        reached, copy = [float(row[3][ACHIEVED]) for row in episode], 0
        for t, (obs, action, _, next_obs, _) in enumerate(episode):
            first = copy
            while copy < len(rows.reward) and rows.obs[copy, TIME] == obs[TIME]:
                goal = float(rows.obs[copy, DESIRED])
                assert goal in reached[t:]
                assert abs(goal) >= 0.5  # not achieved at the beginning, which is at 0
                assert float(rows.next_obs[copy, DESIRED]) == goal
                for was, now in ((obs, rows.obs[copy]), (next_obs, rows.next_obs[copy])):
                    assert torch.equal(was[[ACHIEVED, TIME]], now[[ACHIEVED, TIME]])
                assert torch.equal(action, rows.action[copy])
                x = float(next_obs[ACHIEVED])
                there = abs(x - goal) < 0.5
                assert float(rows.reward[copy]) == (0.0 if there else -1.0)
                assert bool(rows.terminated[copy]) == ((ends and there) or abs(x) > edge)
                copy += 1
            assert copy - first <= 4
            if all(abs(x) >= 0.5 for x in reached[t:]):
                assert copy - first == 4
        assert copy == len(rows.reward)


def test_the_goals_are_drawn_uniformly_from_the_rest_of_the_episode():
    replay, taken = played("environments:Walk", 2_000, num_envs=1, goals=8, capacity=200_000, ends=False, limit=4)
    counts = np.zeros((4, 4))
    for episode, rows in zip(episodes_of(taken, 1), replay.stored[1::2], strict=True):
        reached = [float(row[3][ACHIEVED]) for row in episode]
        if len(episode) == 4 and min(map(abs, reached)) >= 0.5:  # none of them was achieved at the beginning
            for t, goal in zip(rows.obs[:, TIME].int().tolist(), rows.obs[:, DESIRED].tolist(), strict=True):
                counts[t, reached.index(goal)] += 1
    shares = counts / counts.sum(1, keepdims=True)
    assert not np.tril(counts, -1).any()
    for t in range(4):
        expected = 1 / (4 - t)
        assert np.abs(shares[t, t:] - expected).max() < 5 * np.sqrt(expected / counts[t].sum())


def test_without_a_time_limit_a_piece_is_stored_after_a_thousand_steps():
    replay, _ = played("environments:Walk", 1_001, num_envs=1, goals=1, ends=False, limit=10_000)
    whole, copies = replay.stored
    assert len(whole.reward) == 1_000 >= len(copies.reward) > 500


def test_of_goals_that_were_achieved_at_the_beginning_nothing_is_told():
    """In a walk that stays where it is, no step is stored twice; with rewards of distances none is left out."""
    parts = tuple(ObservationPart((name,), (1,)) for name in ("achieved_goal", "desired_goal"))
    for reward, copies in (
        (lambda a, d: -((a - d).abs() > 0.5).float()[:, 0], 2),
        (lambda a, d: -(a - d).abs()[:, 0], 9),
    ):
        replay = Noted(Spec("x", parts, Box((-1.0,), (1.0,)), 9), 100, CPU, num_envs=1, goals=1, seed=0)
        replay.on_restart(lambda a, d, reward=reward: (reward(a, d), torch.zeros(len(a)) > 0))
        for t in range(9):  # 0.1, 0.2, … and at last 1.0
            x = torch.tensor([[0.1 * t, 5.0], [0.1 * (t + 1) if t < 8 else 1.0, 5.0]])[:, None]
            ends = torch.tensor([False]), torch.tensor([t == 8]), torch.tensor([True])
            replay.add(x[0], torch.zeros(1, 1), Step(x[1], x[1], reward(x[1][:, :1], x[1][:, 1:]), *ends))
        goals = replay.stored[1].obs[:, 1]
        assert (goals > 0.5).all() if copies == 2 else len(goals) == 9


def test_a_restart_drops_the_episodes_under_way():
    replay, taken = played("environments:Walk", 11, ends=False)
    assert len(replay) == 0
    replay.on_restart(lambda achieved, desired: pytest.fail("nothing has ended"))
    obs, action, step = taken[0]
    replay.add(obs, action, step)
    assert [len(episode) for episode in replay._episodes] == [1, 1, 1]


def test_reset_rows_belong_to_no_episode():
    parts = tuple(ObservationPart((name,), (1,)) for name in ("achieved_goal", "desired_goal"))
    replay = HindsightReplay(Spec("x", parts, Box((-1.0,), (1.0,)), 3), 100, CPU, num_envs=1, goals=1, seed=0)
    replay.on_restart(lambda achieved, desired: (-(achieved - desired).abs()[:, 0], torch.zeros(len(achieved)) > 0))
    for t in range(8):  # NEXT_STEP: after two steps and an end, an action is ignored
        at, reward = torch.full((1, 2), float(t)), torch.zeros(1)
        flags = torch.tensor([False]), torch.tensor([t % 3 == 1]), torch.tensor([t % 3 != 2])
        replay.add(at, torch.zeros(1, 1), Step(at + 1, at + 1, reward, *flags))
    assert replay.transitions.obs[: len(replay), 0].tolist() == [0, 1, 0, 1, 3, 4, 3, 4, 6, 7, 6, 7]


def test_copies_are_made_on_the_device_of_the_rows():
    def stored(device):
        parts = tuple(ObservationPart((name,), (1,)) for name in ("achieved_goal", "desired_goal"))
        replay = Noted(Spec("x", parts, Box((-1.0,), (1.0,)), 4), 100, device, num_envs=1, goals=2, seed=0)
        replay.on_restart(lambda a, d: (-((a - d).abs() > 0.5).float()[:, 0], torch.zeros(len(a), device=device) > 0))
        for t in range(4):
            at = torch.tensor([[float(t), 9.0]], device=device)
            flags = (torch.tensor([flag], device=device) for flag in (False, t == 3, True))
            replay.add(
                at, torch.zeros(1, 1, device=device), Step(at + 1, at + 1, -torch.ones(1, device=device), *flags)
            )
        assert {x.device for rows in replay.stored for x in vars(rows).values()} == {device}
        return [(name, x.tolist()) for name, x in vars(replay.stored[1]).items()]

    with pretend():
        there = stored(torch.device("cuda:1"))
    assert there == stored(CPU)


def test_a_vector_environment_judges_no_goals():
    backend = registry.make("toy:Countdown", 2).backend
    with pytest.raises(UserError, match="makes 2 environments at once; goals are judged by one"):
        backend.judge_goals(torch.zeros(1, 1), torch.zeros(1, 1))


def test_a_backend_without_single_environments_judges_no_goals():
    backend = registry.make("CartPole-v1", 2, backend="envpool").backend
    with pytest.raises(UserError, match=r"CartPole-v1 judges no goals in the backend EnvpoolBackend"):
        backend.judge_goals(torch.zeros(1, 1), torch.zeros(1, 1))


@pytest.mark.parametrize("algo", ["ddpg", "td3", "sac"])
def test_a_resumed_run_ends_in_the_bits_of_one_that_was_not_stopped(algo, tmp_path):
    check_resume(algo, tmp_path, env="environments:Walk", **SMALL, checkpoint_every=128)


@pytest.mark.parametrize("algo", ["ddpg", "td3", "sac"])
def test_learning_waits_for_the_first_whole_episode(algo, tmp_path):
    fields = SMALL | {"learning_starts": 4, "num_envs": 1, "total_steps": 64, "log_every": 8}
    run = lem.train(algo, "environments:Walk", run=tmp_path / "r", progress=False, **fields)
    learned = ["td_error/sampled" in line or "losses/critic" in line for line in read_metrics(run.path)]
    assert learned[0] is False
    assert learned[-1] is True


def test_checkpoints_that_cut_every_episode_are_refused(tmp_path):
    limit = ("gymnasium.wrappers:TimeLimit(max_episode_steps=50)",)
    with pytest.raises(UserError, match=r"checkpoint_every 64 is less than an episode .*: it must be 100 at least"):
        lem.train("sac", "environments:Walk", run=tmp_path / "r", wrappers=limit, checkpoint_every=64, **SMALL)
    alone = SMALL | {"num_envs": 1, "evaluate_every": 40}  # in the same environment, which exists once
    with pytest.raises(UserError, match=r"evaluate_every 40 is less .* which an evaluation cuts.*: it must be 50 at"):
        lem.train("sac", "environments:Walk", run=tmp_path / "r", wrappers=limit, **alone)
    assert not (tmp_path / "r").exists()


def test_episodes_of_unknown_length_that_every_checkpoint_cuts_are_told(tmp_path, capsys):
    """Walk ends after 200 steps by itself, which nobody knows beforehand."""
    fields = SMALL | {
        "num_envs": 1,
        "total_steps": 192,
        "checkpoint_every": 64,
        "env_kwargs": {"limit": 200, "ends": False},
    }
    lem.train("sac", "environments:Walk", run=tmp_path / "r", progress=False, **fields)
    said = "No episode of environments:Walk has ended in 64 steps, up to a checkpoint, which cuts them"
    assert capsys.readouterr().err.count(said) == 2
    lem.train("sac", "environments:Walk", run=tmp_path / "s", progress=False, **fields | {"checkpoint_every": 192})
    assert said not in capsys.readouterr().err


@pytest.mark.parametrize("algo", [ddpg, td3, sac], ids=["ddpg", "td3", "sac"])
def test_each_algorithm_that_learns_from_replay_has_it(algo):
    spec = registry.make("environments:Walk", 2).spec
    config = algo.Config(env="environments:Walk", **SMALL)
    replay = algo.init(config, spec, CPU).replay
    assert isinstance(replay, HindsightReplay)
    assert replay.capacity == config.capacity == 5 * 512
    assert (
        config.memory_bytes(spec)["buffer_size"]
        == 5 * algo.Config(env="x", **SMALL | {"replay": "uniform"}).memory_bytes(spec)["buffer_size"]
    )


@pytest.mark.long
def test_a_goal_that_chance_never_meets_is_learned_with_hindsight_and_not_without(tmp_path):
    fields = {
        "env_kwargs": {"limit": 16, "axes": 2},
        "total_steps": 2_500,
        "learning_starts": 200,
        "log_every": 100,
        "gamma": 0.9,
        "tau": 0.02,
        "batch_size": 64,
        "hidden": (32, 32),
        "critic_hidden": (32, 32),
        "actor_learning_rate": 1e-3,
        "critic_learning_rate": 1e-3,
        "initial_temperature": 0.1,
        "num_envs": 2,
        "evaluate_episodes": 32,
        "progress": False,
    }
    success = {}
    for replay in ("hindsight", "uniform"):
        run = lem.train("sac", Walk, run=tmp_path / replay, replay=replay, **fields)
        success[replay] = lem.evaluate(run, episodes=64).measures["is_success_at_end"]
    assert success["hindsight"] > 0.9, success
    assert success["uniform"] < 0.3, success


def other(compute_reward):
    """`Walk` with another function, or none, which a step does not ask."""
    step = lambda self, action: (self._see(), -1.0, False, True, {})  # noqa: E731
    return type("Other", (Walk,), {"compute_reward": compute_reward, "step": step})


class Silent(gym.Env):
    """Goals without rewards."""

    observation_space = gym.spaces.Dict(dict.fromkeys(("achieved_goal", "desired_goal"), gym.spaces.Box(-1, 1, (2,))))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, True, False, {}


@pytest.mark.parametrize(
    ("env", "sentence"),
    [
        ("Pendulum-v1", "replay is hindsight, which needs goals, and Pendulum-v1 has none"),
        (
            Silent,
            r"Silent has no compute_reward\(achieved_goal, desired_goal, info\), by which",
        ),
        (other(lambda self, achieved, desired: -1.0), "takes 3 positional arguments but 4 were given"),
        (other(lambda self, achieved, desired, info: info["distance"]), "KeyError: 'distance'"),
        (other(lambda self, achieved, desired, info: abs(achieved - desired) * np.ones(2)), "compute_reward"),
    ],
)
def test_what_has_no_goals_or_judges_them_otherwise_than_in_a_step_is_said(env, sentence, tmp_path):
    with pytest.raises(UserError, match=sentence):
        lem.train("sac", env, run=tmp_path / "r", progress=False, **SMALL)


def test_a_wrapper_that_changes_rewards_is_found_out(tmp_path):
    double = partial(gym.wrappers.TransformReward, func=lambda reward: 2 * reward)
    with pytest.raises(UserError, match=r"the reward of .* is -2, and its compute_reward says -1: hindsight needs"):
        lem.train("sac", Walk, run=tmp_path / "r", wrappers=[double], progress=False, **SMALL)


class LateBonus(gym.Wrapper):
    """Doubles the rewards from the 40th step on."""

    def __init__(self, env):
        super().__init__(env)
        self.steps = 0

    def step(self, action):
        obs, reward, *rest = self.env.step(action)
        self.steps += 1
        return obs, reward if self.steps < 40 else 2 * reward, *rest


def test_a_reward_at_the_edge_of_a_threshold_may_differ_by_rounding():
    """The environment has float64, and the buffer float32: of places at 0.5 m of a goal these know more or less."""
    rng = np.random.default_rng(0)
    goal = rng.uniform(-8, 8, 100_000)
    place = goal + 0.5 + rng.uniform(-1e-7, 1e-7, goal.shape)

    def reward(place, goal):
        return np.where(np.abs(place.astype(np.float64) - goal.astype(np.float64)) < 0.5, 0.0, -1.0)

    near = np.flatnonzero(reward(place, goal) != reward(np.float32(place), np.float32(goal)))[:20]
    assert len(near) == 20
    parts = tuple(ObservationPart((name,), (1,)) for name in ("achieved_goal", "desired_goal"))

    def judge(achieved, desired):
        return torch.from_numpy(reward(achieved.numpy()[:, 0], desired.numpy()[:, 0])).float(), torch.zeros(
            len(achieved)
        ) > 0

    def store(shift):
        replay = HindsightReplay(Spec("x", parts, Box((-1.0,), (1.0,)), 1), 100, CPU, num_envs=1, goals=1, seed=0)
        replay.on_restart(judge)
        for i in near:
            obs = torch.tensor([[place[i] + shift, goal[i]]], dtype=torch.float32)
            paid = torch.from_numpy(reward(place[i : i + 1], goal[i : i + 1])).float()
            flags = torch.tensor([False]), torch.tensor([True]), torch.tensor([True])
            replay.add(obs, torch.zeros(1, 1), Step(obs, obs, paid, *flags))

    said = []
    for shift in (0.0, 0.01):
        try:
            store(shift)
        except UserError as error:
            said.append((shift, "hindsight needs rewards that follow" in str(error)))
    assert said == [(0.01, True)]


def test_a_wrapper_that_changes_rewards_later_is_found_out_too(tmp_path):
    with pytest.raises(UserError, match=r"the reward of .* is -2, and its compute_reward says -1: hindsight needs"):
        lem.train("sac", Walk, run=tmp_path / "r", wrappers=[LateBonus], progress=False, **SMALL)


def test_flattened_observations_have_no_goals(tmp_path):
    with pytest.raises(UserError, match="which needs goals"):
        lem.train("sac", Walk, run=tmp_path / "r", wrappers=[gym.wrappers.FlattenObservation], progress=False, **SMALL)


def test_a_buffer_that_holds_no_episode_with_its_copies_holds_pieces(tmp_path):
    replay, taken = played("environments:Walk", 12, num_envs=1, goals=4, capacity=19, ends=False)
    obs = torch.cat([obs for obs, _, _ in taken])
    assert len(replay) == 19
    for row in replay.transitions.obs:
        assert (row[[ACHIEVED, TIME]] == obs[:, [ACHIEVED, TIME]]).all(1).any()
    with pytest.raises(UserError, match="is below the 32 rows of hindsight_goals 32"):
        lem.train("sac", Walk, run=tmp_path / "r", buffer_size=31, hindsight_goals=32, progress=False, **SMALL)


@pytest.mark.skipif(not is_installed("gymnasium_robotics"), reason="the extra robotics is not installed")
@pytest.mark.parametrize("env", ["FetchReach-v4", "FetchPush-v4", "HandReach-v3", "PointMaze_UMaze-v3"])
def test_gymnasium_robotics_judges_goals_as_in_a_step(env):
    made = registry.make(env, 2)
    obs = made.restart(0)
    achieved, desired = goal_columns(made.spec)
    for _ in range(12):
        step = made.step(torch.rand(2, made.spec.action.size) * 2 - 1)
        reward, ends = made.backend.judge_goals(step.next_obs[:, achieved], step.next_obs[:, desired])
        torch.testing.assert_close(reward, step.reward, rtol=1e-4, atol=1e-5)
        assert torch.equal(ends, step.terminated)
    reward, _ = made.backend.judge_goals(obs[:, achieved], obs[:, achieved])
    assert (reward == (0.0 if "Maze" not in env else 1.0)).all()
    made.close()


@pytest.mark.parametrize(
    ("reward", "terminated", "sentence"),
    [
        (
            lambda self, a, d, info: -float(a[:, 0] != d),
            None,
            "of one goal each, raised (IndexError|TypeError|ValueError)",
        ),
        (lambda self, a, d, info: None, None, "of one goal each, returned None; it must be a number"),
        (lambda self, a, d, info: "0", None, "returned '0'; it must be a number"),
        (None, lambda self, a, d, info: 0.5, "compute_terminated.*returned 0.5; it must be True or False"),
        (None, lambda self, a, d, info: True, "goes on, and its compute_terminated says that it ends"),
    ],
)
def test_judges_that_judge_otherwise_than_one_goal_get_a_sentence(reward, terminated, sentence, tmp_path):
    own = {"compute_reward": reward or (lambda self, achieved, desired, info: -1.0)}
    own |= {"compute_terminated": terminated} if terminated else {}
    own["step"] = lambda self, action: (self._see(), -1.0, False, True, {})
    own["__init__"] = lambda self: Walk.__init__(self, ends=False)
    with pytest.raises(UserError, match=sentence):
        lem.train("sac", type("Own", (Walk,), own), run=tmp_path / "r", progress=False, **SMALL)


def test_a_judge_may_write_into_the_goals_that_it_gets_and_answer_with_an_array_of_one():
    class Own(Walk):
        def __init__(self):
            super().__init__(ends=False)

        def compute_reward(self, achieved, desired, info):
            achieved -= desired
            return np.array([-float(np.abs(achieved).max())])

        def compute_terminated(self, achieved, desired, info):
            return bool(np.abs(achieved - desired).max() == 0)

    env = registry.make(registry.name_of(Own), 1)
    goals = torch.tensor([[1.0], [2.0]])
    reward, ends = env.backend.judge_goals(goals, torch.tensor([[1.0], [5.0]]))
    assert reward.tolist() == [0, -3]
    assert ends.tolist() == [True, False]


def test_goals_of_two_types_are_judged_each_in_its_own():
    class Own(Walk):
        def __init__(self):
            super().__init__(ends=False)
            kinds = {"observation": np.float32, "achieved_goal": np.float32, "desired_goal": np.int32}
            boxes = {name: gym.spaces.Box(-9, 9, (1,), kind) for name, kind in kinds.items()}
            self.observation_space = gym.spaces.Dict(boxes)

        def compute_reward(self, achieved, desired, info):
            assert (achieved.dtype, desired.dtype) == (np.float32, np.int32)
            return -float(abs(achieved[0] - desired[0]))

    env = registry.make(registry.name_of(Own), 1)
    assert env.backend.judge_goals(torch.tensor([[1.25]]), torch.tensor([[2.0]]))[0].item() == -0.75
