import itertools
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch

import lemniscate as lem
import toy
from lemniscate.envs import registry
from lemniscate.envs.backend import Summary
from lemniscate.errors import UserError
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.networks import Layers
from lemniscate.run.evaluate import EVALUATION, EpisodeTable, evaluate
from lemniscate.run.run import TRAINING
from lemniscate.run.seeding import derive
from lemniscate.system import named
from lemniscate.types import Step


class Uneven(toy.Countdown):
    """Copy i's episodes last i + 1 steps."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.length = 1 + torch.arange(self.num_envs).numpy()


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP", "DISABLED"])
@pytest.mark.parametrize("episodes", [3, 4, 10])
def test_every_copy_plays_its_own_share(mode, episodes):
    """Taking the first that end would fill the list with the short ones."""
    env = registry.make(Uneven, 4, kwargs={"mode": mode})
    policy = ActorCritic(env.spec, Layers((4,))).policy
    scores = evaluate(policy, env, episodes, seed=0)
    shares = [episodes // 4 + (copy < episodes % 4) for copy in range(4)]
    expected = [copy + 1 for copy in range(4) for _ in range(shares[copy])]
    assert scores.lengths == expected
    assert scores.returns == [float(length) for length in expected]
    assert scores.terminated == episodes
    assert scores.mean_return == pytest.approx(sum(expected) / episodes)


def test_the_same_seed_gives_the_same_scores_and_another_does_not():
    env = registry.make("CartPole-v1", 4, backend="gymnasium")
    torch.manual_seed(0)
    policy = ActorCritic(env.spec, Layers((4,))).policy
    first, again, other = (evaluate(policy, env, 6, seed, deterministic=False) for seed in (1, 1, 2))
    assert first == replace(again, date=first.date)
    assert first.returns != other.returns
    assert first.measures == {}


def endless(num_envs, mode="DISABLED"):
    return registry.make("Countdown-v0", num_envs, kwargs={"mode": mode, "length": None})


def test_an_episode_without_end_is_a_sentence_and_not_a_hang(monkeypatch):
    monkeypatch.setattr("lemniscate.envs.vec_env.PATIENCE", 30)
    env = endless(2)
    with pytest.raises(UserError, match=r"Countdown-v0 has not ended after 30 steps.*time limit"):
        evaluate(ActorCritic(env.spec, Layers((4,))).policy, env, 2, seed=0)
    assert env.steps == 60


def test_patience_is_for_one_episode_not_for_all(monkeypatch):
    monkeypatch.setattr("lemniscate.envs.vec_env.PATIENCE", 30)
    env = registry.make("Countdown-v0", 2, kwargs={"mode": "DISABLED", "length": 20})
    assert evaluate(ActorCritic(env.spec, Layers((4,))).policy, env, 10, seed=0).lengths == [20] * 10


def test_a_run_goes_on_when_its_evaluation_cannot(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("lemniscate.envs.vec_env.PATIENCE", 30)
    fields = {
        "env_kwargs": {"length": None},
        "num_envs": 2,
        "num_steps": 32,
        "minibatch_size": 64,
        "total_steps": 128,
        "evaluate_every": 64,
        "progress": False,
    }
    run = lem.train("ppo", "Countdown-v0", run=tmp_path / "run", backend="gymnasium", **fields)
    assert run.policy.step == 128
    assert "No evaluation at step 64" in capsys.readouterr().err


class Climbs(gym.Env):
    """Measures a height, the number of the step; success is reached in the last of `length` steps."""

    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Discrete(2)
    metadata = {"render_modes": [], "measures": ["height"]}  # noqa: RUF012

    def __init__(self, length=4):
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        info = {"height": float(self.t), "is_success": self.t == self.length, "drift": np.inf if self.t > 1 else 3.0}
        return np.zeros(1, np.float32), 1.0, self.t == self.length, False, info


def test_what_is_measured_is_averaged_over_the_rows_that_count():
    """Environment i has episodes of i + 1 steps; those that have had their share of the ten go on, and do not count."""
    numbers = itertools.count()
    env = registry.make(lambda: Climbs(length=1 + next(numbers) % 4), 4)
    scores = evaluate(ActorCritic(env.spec, Layers((4,))).policy, env, 10, seed=0)
    rows = 3 * 1 + 3 * 2 + 2 * 3 + 2 * 4
    heights = 3 * 1 + 3 * (1 + 2) + 2 * (1 + 2 + 3) + 2 * (1 + 2 + 3 + 4)
    expected = {"height": heights / rows, "is_success": 10 / rows, "is_success_at_end": 1.0, "info/drift": 3.0}
    assert scores.measures == pytest.approx(expected)
    assert scores.to_json() | scores.measures == scores.to_json()


def test_summaries_leave_out_the_first_steps():
    env = registry.make(Climbs, 2)
    env.summaries = (Summary("rms", "height", "rms", scale=10), Summary("late", "height", "rms", skip=2))
    measures = evaluate(ActorCritic(env.spec, Layers((4,))).policy, env, 4, seed=0).measures
    assert measures["rms"] == pytest.approx(10 * np.sqrt(np.mean(np.square([1, 2, 3, 4]))))
    assert measures["late"] == pytest.approx(np.sqrt(np.mean(np.square([3, 4]))))


def test_a_policy_is_evaluated_in_another_world(tmp_path):
    fields = {"num_envs": 2, "num_steps": 8, "total_steps": 64, "minibatch_size": 16, "progress": False}
    made = lem.train("ppo", Climbs, run=tmp_path / "run", env_kwargs={"length": 3}, **fields)
    policy = lem.load(made.path)
    assert policy.config.env == "test_evaluate:Climbs"
    assert lem.evaluate(policy, episodes=2).lengths == [3, 3]
    assert lem.evaluate(policy, episodes=2, env_kwargs={"length": 5}).lengths == [5, 5]
    assert lem.evaluate(policy, env=lambda: Climbs(length=6), episodes=2).lengths == [6, 6]


def test_an_environment_that_no_file_can_keep_is_asked_for_again(tmp_path):
    fields = {"num_envs": 2, "num_steps": 8, "total_steps": 64, "minibatch_size": 16, "progress": False}
    wrappers = [lambda env: gym.wrappers.TransformReward(env, lambda reward: 2 * reward)]
    made = lem.train("ppo", lambda: Climbs(length=3), run=tmp_path / "run", wrappers=wrappers, **fields)
    policy = lem.load(made.path)
    assert lem.evaluate(policy, episodes=2).returns == [6, 6]
    named._PASSED.clear()  # as another process would have it
    with pytest.raises(UserError, match="pass the object again"):
        lem.evaluate(policy, episodes=2)


def test_starts_of_an_evaluation_are_never_those_of_training():
    """Training restarts from `derive(seed, TRAINING, step)`, whatever the step."""
    env = registry.make("Countdown-v0", 2)
    seeds, restart = [], env.restart
    env.restart = lambda seed, **options: seeds.append(seed) or restart(seed, **options)
    evaluate(ActorCritic(env.spec, Layers((4,))).policy, env, 2, seed=7)
    assert seeds == [derive(7, EVALUATION, 0)]
    assert EVALUATION != TRAINING


def test_returns_are_ordered_by_environment_then_by_time():
    def step(reward, terminated):
        obs, no = torch.zeros(2, 1), torch.zeros(2, dtype=torch.bool)
        return Step(obs, obs, torch.tensor(reward), torch.tensor(terminated), no, ~no)

    table = EpisodeTable(2, torch.device("cpu"))
    for rewards, ends in (([5.0, 1.0], [True, True]), ([3.0, 9.0], [True, False]), ([4.0, 2.0], [True, True])):
        table.add(step(rewards, ends), torch.ones(2, dtype=torch.bool))
    assert table.returns_and_lengths().tolist() == [[5, 3, 4, 1, 11], [1, 1, 1, 1, 2]]
