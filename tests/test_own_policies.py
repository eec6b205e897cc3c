"""Policies that were not trained here, flown: functions, modules, objects, and files of weights."""

import re
from functools import partial
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn

import environments
import lemniscate as lem
from lemniscate.cli import main
from lemniscate.envs import registry
from lemniscate.envs.conversion import flatten_observation, unflatten_observation
from lemniscate.envs.spaces import observation_parts
from lemniscate.errors import UserError
from lemniscate.run.config import RunConfig
from test_flight import Aviary, Glider

DRONE = "DroneFigureEightTrajectory-v0"
WEIGHTS = torch.tensor([0.1, 0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    path = tmp_path_factory.mktemp("own") / "run"
    return lem.train("ppo", "CartPole-v1", run=path, progress=False, total_steps=256, compile="off").policy


@pytest.fixture
def unwritten(monkeypatch):
    """Videos are drawn, and not written: that takes time."""
    monkeypatch.setattr("lemniscate.report.playback.save_frames", lambda frames, file, fps: [None for _ in frames])


class Net(nn.Module):
    """Two numbers for each observation of CartPole, of which the second is larger where WEIGHTS say so."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(4, 2, bias=False)
        self.layer.weight.data = torch.stack([0 * WEIGHTS, WEIGHTS])

    def forward(self, obs):
        return self.layer(obs)


class Drawn(Net):
    def forward(self, obs):
        return torch.distributions.Categorical(logits=self.layer(obs))


class Course(Net):
    """As the drone course's agent: no forward; several things beside the action, in a batch alone."""

    forward = nn.Module.forward

    def action_and_value(self, x, action=None, deterministic=False):
        found = torch.distributions.Categorical(logits=self.layer(x))
        action = found.mode if deterministic else found.sample()
        return action, found.log_prob(action), found.entropy(), x.sum(1)


class Dropping(Net):
    """Wrong unless it is in evaluation mode."""

    def forward(self, obs):
        return nn.functional.dropout(self.layer(obs), 0.9, training=self.training)


class Model:
    """As a model of Stable-Baselines3."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        return (np.asarray(observation) @ WEIGHTS.numpy() > 0).astype(np.int64), state


def one(obs):
    return int(obs @ WEIGHTS.numpy() > 0)


SAME = {
    "one observation": one,
    "a method": Model().predict,
    "an object": Model(),
    "a batch": lambda obs: [int(row[0] * 0.1 + row[2] > 0) for row in obs],
    "tensors": lambda obs: (torch.mv(obs, WEIGHTS) > 0).long().unsqueeze(-1),
    "one tensor": lambda obs: torch.dot(obs, WEIGHTS) > 0,
    "float64": lambda obs: int(torch.as_tensor(obs) @ WEIGHTS.double() > 0),
    "numbers for each action": Net(),
    "a module in float64": Net().double(),
    "a module in training mode": Dropping(),
    "a distribution": Drawn(),
    "an agent of the course": Course(),
    "the name": "test_own_policies:one",
    "the name of a class with arguments": "test_own_policies:Model()",
}


def test_policies_of_every_form_are_the_same_policy():
    """All of them play from the same starts, as one of ours does: those of the backend that the id has by default."""
    how = {"env": "CartPole-v1", "episodes": 3, "seed": 7}
    expected = lem.evaluate(one, **how)
    assert len(set(expected.returns)) > 1
    for name, given in SAME.items():
        assert lem.evaluate(given, **how) == expected, name
    assert SAME["a module in training mode"].training


def test_ours_as_a_function_has_the_returns_of_ours(policy):
    """Also from the 17th episode on, which only parallel environments that go on can begin alike."""
    how = {"env": "CartPole-v1", "episodes": 20, "seed": 7}
    expected = lem.evaluate(policy, **how)
    assert lem.evaluate(policy.act, **how) == expected
    assert lem.evaluate(lambda obs: policy.act(obs), **how) == expected


@pytest.mark.parametrize("kind", ["box", "discrete", "multi-discrete", "multi-binary", "tuple", "image"])
def test_observations_of_every_space_come_as_the_environment_returns_them(kind):
    """A video's single environment and parallel ones: what is seen is copied, in the units of the actions."""

    def copied(obs):
        if kind == "box":
            return np.array([[1], [0.5]]) + np.array([[2], [0.5]]) * obs
        if kind == "multi-discrete":
            return obs + np.array([1, 0])
        if kind == "image":
            assert obs.dtype == np.uint8
            return int(obs[0, 6, 1] > 0)
        return {"discrete": lambda: obs - 6, "multi-binary": lambda: obs, "tuple": lambda: obs[0]}[kind]()

    def make():
        return environments.Copy(kind)

    scores = lem.evaluate(copied, env=make, episodes=2)
    assert scores.returns == pytest.approx([8, 8], abs=1e-4)


@pytest.mark.parametrize("space", [*(seen for seen, _ in environments.KINDS.values()),
                                   gym.spaces.Box(0, 255, (3, 20, 24), np.uint8)], ids=str)  # fmt: skip
def test_flat_observations_have_their_structure_again(space):
    space.seed(0)
    batch = gym.vector.utils.concatenate(
        space, [space.sample() for _ in range(3)], gym.vector.utils.create_empty_array(space, 3)
    )
    parts = observation_parts(space, "x")
    again = unflatten_observation(parts, flatten_observation(parts, batch))
    flat = flatten_observation(parts, again)
    np.testing.assert_array_equal(flat, flatten_observation(parts, batch))
    assert type(again) is type(batch)


class Summing:
    """A controller that remembers: it sums up what it sees."""

    def __init__(self):
        self.sum = 0.0

    def act(self, obs):
        self.sum = 0.9 * self.sum + float(obs[2])
        return int(obs[2] + 0.5 * obs[3] + 0.1 * self.sum > 0)


def test_what_remembers_plays_in_one_environment_at_a_time(capsys):
    seen = []

    def remembering(obs):
        seen.append(np.asarray(obs))
        return len(seen) % 2

    how = {"env": "CartPole-v1", "episodes": 4, "seed": 7}
    lem.evaluate(remembering, **how)
    steps = np.array(seen[6:])[:, [0, 1]]  # positions follow from speeds within an episode
    assert np.mean(np.abs(np.diff(steps[:, 0]) - 0.02 * steps[:-1, 1]) < 1e-5) > 0.8
    assert capsys.readouterr().err.count("one environment at a time") == 1
    lem.evaluate(Summing(), **how)
    assert "one environment at a time" in capsys.readouterr().err
    lem.evaluate(lambda obs: np.random.randint(2), **how)  # noqa: NPY002
    assert capsys.readouterr().err == ""


def test_draws_come_from_the_seed_and_the_callers_generators_stay_as_they_were():
    how = {"env": "CartPole-v1", "episodes": 3, "deterministic": False}
    net, before = Drawn(), torch.get_rng_state()
    drawn = [lem.evaluate(net, **how, seed=seed).returns for seed in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]
    assert torch.equal(torch.get_rng_state(), before)


def test_actions_can_be_normalized():
    how = {"env": "Pendulum-v1", "episodes": 1}
    expected = lem.evaluate(lambda obs: 2.0 * obs[1], **how)
    assert lem.evaluate(lambda obs: obs[1:2], **how, normalized_actions=True) == expected
    assert lem.evaluate(lambda obs: obs[1:2], **how).returns != expected.returns


class Recurrent:
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros(len(observation), np.int64), (np.zeros(3),)


def two(obs, info):
    return 0


WRONG = {
    "a class": (Net, "Net is a class: give an object of it"),
    "a class by name": ("test_own_policies:Net", "Net is a class"),
    "a number": (3, "A policy is a run, a function, a torch module, or an object with act, predict, .*; not 3"),
    "two arguments": (two, r"takes one observation; two\(obs, info\) does not"),
    "our module": (None, "whose actions are in .* give the policy itself"),
    "another size": (
        nn.Linear(17, 2),
        r"raised RuntimeError.*3x4 and 17x2.*CartPole-v1 observes 4 numbers, obs \(4,\)",
    ),
    "other actions": (nn.Linear(4, 3), r"takes actions of Discrete\(2\), not an array of shape \(3, 3\)"),
    "NaN": (lambda obs: np.nan, r"Discrete\(2\), not nan"),
    "NaN later": (lambda obs: np.full(len(obs), 0 if abs(obs[0][2]) < 0.06 else np.nan), "with a number that is nan"),
    "no number": (lambda obs: "left", "not 'left'"),
    "nothing": (lambda obs: None, "not None"),
    "an error": (lambda obs: 1 // 0, r"raised ZeroDivisionError \(test_own_policies.py, line \d+\): integer div"),
    "a state": (Recurrent(), "predict returns a state too"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_act_is_refused_in_a_sentence(name, policy):
    given, said = WRONG[name]
    with pytest.raises(lem.UserError, match=said):
        lem.evaluate(policy.module if given is None else given, env="CartPole-v1", episodes=1)


def test_nothing_is_drawn_from_numbers_that_may_be_values():
    with pytest.raises(lem.UserError, match="a number for each action, from which none is drawn"):
        lem.evaluate(Net(), env="CartPole-v1", episodes=1, deterministic=False)


# Files of weights.


def layout(sizes, name="actor_mean"):
    """A state_dict of linear layers in a Sequential with activations between them."""
    torch.manual_seed(0)
    layers = [nn.Linear(*pair) for pair in pairwise(sizes)]
    named = ((f"{name}.{2 * i}", layer) for i, layer in enumerate(layers))
    return {f"{key}.{part}": value for key, layer in named for part, value in layer.state_dict().items()}


class Agent(nn.Module):
    """The drone course's, with other widths."""

    def __init__(self, envs):
        super().__init__()
        inputs, outputs = (np.prod(space.shape) for space in (envs.single_observation_space, envs.single_action_space))
        self.actor_mean = nn.Sequential(
            nn.Linear(inputs, 9), nn.Tanh(), nn.Linear(9, 5), nn.Tanh(), nn.Linear(5, outputs)
        )
        self.actor_logstd = nn.Parameter(torch.zeros(1, outputs))

    def action_and_value(self, x, action=None, deterministic=False):
        mean = self.actor_mean(x)
        assert deterministic
        return mean, mean.sum(1), mean.sum(1), mean[:, 0]


class Actor(nn.Module):
    """The DDPG notebook's: the shapes of its buffers are of all environments."""

    def __init__(self, env):
        super().__init__()
        self.fc1, self.fc2, self.fc_mu = nn.Linear(3, 8), nn.Linear(8, 8), nn.Linear(8, 1)
        self.register_buffer("action_scale", torch.tensor((env.action_space.high - env.action_space.low) / 2))
        self.register_buffer("action_bias", torch.tensor((env.action_space.high + env.action_space.low) / 2))

    def forward(self, x):
        x = self.fc_mu(self.fc2(self.fc1(x).relu()).relu())
        return x.tanh() * self.action_scale + self.action_bias


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A file of each kind for the pendulum."""
    monkeypatch.chdir(tmp_path)
    envs = gym.make_vec("Pendulum-v1", 1)
    weights = {**layout((3, 9, 5, 1)), **layout((3, 64, 1), "critic"), "actor_logstd": torch.zeros(1, 1)}
    weights["actor_mean.4.weight"] *= 3
    moments = {"obs_mean": torch.tensor([0.2, -0.1, 1.0]).double(), "obs_var": np.array([0.5, 0.4, 9.0])}
    torch.save({"model_state_dict": weights, "optim_state_dict": {}, **moments, "obs_count": 9.0}, "course.pt")
    own = {name: weight for name, weight in weights.items() if "critic" not in name}
    torch.save({"model_state_dict": own, **moments}, "agent.pt")
    torch.save(own, "plain.pth")
    torch.manual_seed(1)
    actor = Actor(envs)
    torch.save(actor.state_dict(), "actor.pt")
    mean, std = moments["obs_mean"].numpy(), np.sqrt(moments["obs_var"] + 1e-8)

    def course(obs, normalized=True):
        x = torch.as_tensor((obs - mean) / std if normalized else obs).float()
        for i in (0, 2):
            x = (weights[f"actor_mean.{i}.weight"] @ x + weights[f"actor_mean.{i}.bias"]).tanh()
        return (weights["actor_mean.4.weight"] @ x + weights["actor_mean.4.bias"]).numpy()

    return {"course.pt": course, "agent.pt": course, "plain.pth": lambda obs: course(obs, False), "actor.pt": actor}


def test_a_file_flies_as_the_agent_that_it_is_of_behind_its_normalizer(files, capsys):
    how = {"env": "Pendulum-v1", "episodes": 2, "normalized_actions": False}
    expected = {name: lem.evaluate(agent, **how).returns for name, agent in files.items()}
    assert expected["course.pt"] != expected["plain.pth"]
    for name in files:
        assert lem.evaluate(name, **how).returns == pytest.approx(expected[name], rel=1e-5), name
    assert (
        "course.pt: with obs_mean and obs_var, 3-9-5-1; actions are in the environment's units"
        in capsys.readouterr().err
    )
    assert lem.evaluate("agent.pt", **how, agent=Agent).returns == pytest.approx(expected["agent.pt"], rel=1e-5)
    assert lem.evaluate("actor.pt", **how, agent="test_own_policies:Actor").returns == pytest.approx(
        expected["actor.pt"], rel=1e-5
    )


def test_the_units_of_a_file_are_what_is_worth_more_which_is_said(files, capsys):
    how = {"env": "Pendulum-v1", "episodes": 2}
    both = [lem.evaluate("course.pt", **how, normalized_actions=given).mean_return for given in (False, True)]
    capsys.readouterr()
    assert lem.evaluate("course.pt", **how).mean_return == max(both)
    said = capsys.readouterr().err
    assert f"worth {max(both):.1f} and not {min(both):.1f}" in said
    assert "--[no-]normalized-actions" in said


def test_a_file_that_does_not_fit_is_refused_in_a_sentence(files, tmp_path):
    def refused(contents, said, **how):
        torch.save(contents, tmp_path / "x.pt")
        with pytest.raises(lem.UserError, match=said):
            lem.evaluate(tmp_path / "x.pt", **{"env": "Pendulum-v1", **how})

    refused(layout((5, 4, 1)), "x.pt is for 5 observed numbers; Pendulum-v1 observes 3 numbers")
    refused(
        {"model_state_dict": layout((3, 4, 1)), "obs_mean": torch.zeros(4), "obs_var": torch.ones(4)}, "for 4 observed"
    )
    refused({"model_state_dict": layout((3, 4, 1)), "obs_mean": torch.zeros(3)}, "one of obs_mean and obs_var")
    refused(layout((3, 4, 2)), "x.pt is for 2 numbers of an action; Pendulum-v1 takes 1")
    refused(nn.Linear(3, 1).state_dict(), "another layout .*agent=Agent in Python, --agent module:Agent")
    refused(
        nn.Linear(3, 1).state_dict(),
        r"does not fit Linear: weight is \[1, 3\] there and \[1, 2\] here",
        agent=nn.Linear(2, 1),
    )
    refused(nn.Linear(3, 1).state_dict(), "cannot be made .* agent=lambda envs: ", agent=nn.Linear)
    refused(nn.Linear(3, 1), "cannot be read without running what it holds; save weights alone: torch.save")
    refused({"epoch": 3}, "has no weights")
    (tmp_path / "x.pt").write_text("weights")
    with pytest.raises(lem.UserError, match="is damaged, or no file of torch"):
        lem.evaluate(tmp_path / "x.pt", env="Pendulum-v1")
    with pytest.raises(lem.UserError, match=r"absent\.pt does not exist"):
        lem.evaluate("absent.pt", env="Pendulum-v1")
    with pytest.raises(lem.UserError, match="named with it, such as env="):
        lem.evaluate("course.pt")


def test_a_file_is_no_folder_of_ours_and_the_other_way_round(files, policy, tmp_path):
    with pytest.raises(lem.UserError, match=r"lem\.evaluate\('course\.pt', env=…\)"):
        lem.load("course.pt")
    for ending in ("pt", "pth", "zip", "safetensors"):
        with pytest.raises(lem.UserError, match=r"the name of a file, .*lem\.save\(policy, '.*new'\)"):
            lem.save(policy, tmp_path / f"new.{ending}")
    assert not list(tmp_path.glob("new*"))


def test_the_command_line_flies_a_file_and_what_a_module_has(files, unwritten, capsys):
    assert (
        main(["evaluate", "course.pt", "--env", "Pendulum-v1", "--episodes", "1", "--no-normalized-actions", "--json"])
        == 0
    )
    assert '"env_id": "Pendulum-v1"' in capsys.readouterr().out
    assert main(["watch", "test_own_policies:one", "--env", "CartPole-v1", "--video", "video.gif"]) == 0
    assert "Recorded in video.gif" in capsys.readouterr().err
    assert (
        main(["evaluate", "agent.pt", "--env", "Pendulum-v1", "--episodes", "1", "--agent", "test_own_policies:Agent"])
        == 0
    )


def test_a_report_of_an_evaluation_has_film_and_scores(tmp_path):
    lem.evaluate(one, env="CartPole-v1", episodes=8, report=tmp_path / "page")
    page = (tmp_path / "page" / "plots" / "report.html").read_text()
    assert re.search(r"<title>one\(\w*\) in CartPole-v1", page)
    assert " object at 0x" not in page
    assert "data:image/gif" in page
    assert "8, seed 0" in page


def test_flights_are_drawn_as_those_of_ours(tmp_path, unwritten, monkeypatch):
    """What has a scene is flown by parallel environments, with path and error in pictures."""
    monkeypatch.setattr("lemniscate.report.flight._frames", lambda tracks, model: ([], "Drawn."))
    how = {"env": Glider, "backend": "test_flight:Aviary"}
    scores = lem.evaluate(lambda obs: 0, **how, episodes=3, report=tmp_path)
    assert scores.episodes == 3
    assert {file.name for file in (tmp_path / "plots").iterdir()} == {"flight.png", "error.png", "report.html"}
    assert "data:image/png" in (tmp_path / "plots" / "report.html").read_text()
    assert Aviary.open == 0


def test_a_function_flies_the_drone_from_a_dictionary_or_from_numbers(unwritten, monkeypatch):
    pytest.importorskip("crazyflow")
    monkeypatch.setattr("lemniscate.presets.choose", lambda *_: ("small", RunConfig(num_envs=4)))
    how = {"env": DRONE, "episodes": 2, "env_kwargs": {"max_episode_time": 1.0}}
    flown = [
        lem.evaluate(policy, **how)
        for policy in (
            lambda obs: [0, 0, 0, 0.32 - 0.1 * obs["vel"][2]],
            lambda obs: [0, 0, 0, 0.32 - 0.1 * obs[9]],
            lambda obs: torch.stack([*[torch.zeros(len(obs))] * 3, 0.32 - 0.1 * obs[:, 9]], dim=1),
        )
    ]
    assert flown[0].measures["rmse_mm"] > 0
    assert flown[0].returns == flown[1].returns == flown[2].returns


ANGLES = []


def by_last_angle(obs, before=[0.0]):  # noqa: B006
    """Pushes against the speed of the pole, which it makes of two angles; remembered in a default."""
    speed, before[0] = obs[2] - before[0], obs[2]
    return int(speed + obs[2] > 0)


def by_global(obs):
    global ANGLES
    ANGLES = [*ANGLES[-1:], obs[2]]
    return int(2 * ANGLES[-1] - ANGLES[0] > 0)


class Slotted:
    __slots__ = ("before", "hook")

    def __init__(self):
        self.before, self.hook = 0.0, lambda: None

    def act(self, obs):
        speed, self.before = obs[2] - self.before, obs[2]
        return int(speed + obs[2] > 0)


class Holding(Slotted):
    """The same, with a network beside."""

    def __init__(self):
        super().__init__()
        self.net = nn.Linear(4, 2)


@pytest.mark.parametrize("policy", [by_last_angle, by_global, Slotted(), Holding(), partial(by_last_angle)])
def test_what_remembers_in_any_way_plays_one_episode_at_a_time(policy, capsys):
    lem.evaluate(policy, "CartPole-v1", episodes=3)
    assert "remembers what it was called with" in capsys.readouterr().err


class Across(nn.Module):
    """A softmax over the wrong axis of a batch, which is the right one of a single observation."""

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(4, 2)
        self.layer.weight.data = torch.tensor([[0.0, 0, -1, -1], [0, 0, 1, 1]])
        self.layer.bias.data.zero_()

    def forward(self, obs):
        return self.layer(obs).softmax(0)


class Judge:
    """The same as an object that has a network."""

    def __init__(self):
        self.net = Across()

    def act(self, obs):
        return int(self.net(torch.as_tensor(obs)).argmax())


@pytest.mark.parametrize("policy", [Across(), Judge()])
def test_a_batch_is_given_only_where_each_row_has_the_answer_that_it_has_alone(policy):
    act = policy.act if isinstance(policy, Judge) else lambda obs: int(policy(torch.as_tensor(obs)).argmax())
    assert (
        lem.evaluate(policy, "CartPole-v1", episodes=5).returns == lem.evaluate(act, "CartPole-v1", episodes=5).returns
    )


@pytest.mark.parametrize("own", [{"agent": "test_own_policies:Actor"}, {"normalized_actions": True}])
def test_what_is_said_of_a_policy_of_ones_own_is_not_for_one_that_was_trained_here(own):
    env = registry.make("CartPole-v1", 1)
    config = lem.config_for("pqn", "CartPole-v1", hidden=(8,))
    policy = lem.TrainedPolicy(config.networks(env.spec), env.spec, config, 0)
    env.close()
    with pytest.raises(lem.UserError, match="are for policies of your own; this one was trained here"):
        lem.evaluate(policy, episodes=1, **own)


class Masked(gym.Env):
    """Three actions, of which one alone is permitted: the number that is observed."""

    observation_space, action_space = gym.spaces.Box(0, 2, (1,)), gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._see()

    def step(self, action):
        self.t, right = self.t + 1, float(action == self.only)
        obs, info = self._see()
        return obs, right, self.t == 5, False, info

    def _see(self):
        self.only = int(self.np_random.integers(3))
        return np.zeros(1, np.float32), {"action_mask": np.arange(3) == self.only}


@pytest.mark.parametrize("name", ["action_mask", "action_masks"])
def test_a_policy_that_asks_for_the_action_mask_gets_it(name):
    scope = {"np": np}
    exec(f"def act(obs, {name}=None): return int(np.argmax({name}))", scope)
    assert lem.evaluate(scope["act"], Masked, episodes=3).returns == [5.0] * 3


def test_scores_that_are_no_numbers_are_no_choice():
    with pytest.raises(UserError, match="with a number that is nan"):
        lem.evaluate(lambda obs: np.full(2, np.nan, np.float32), "CartPole-v1", episodes=1)


def test_files_that_hold_something_else_get_a_sentence(tmp_path):
    good = {"actor_mean.0.weight": torch.zeros(2, 4), "actor_mean.0.bias": torch.zeros(2)}
    normalizer = {"obs_mean": torch.zeros(4), "obs_var": torch.ones(4)}
    wide = {"actor_mean.2.weight": torch.zeros(2, 9), "actor_mean.2.bias": torch.zeros(2)}
    for number, (record, sentence) in enumerate(
        (
            ({"state_dict": 3}, "has no weights"),
            ({1: torch.zeros(2)}, "has no weights"),
            ({**good, **wide}, r"layers that do not fit each other: \(2, 4\), \(2, 9\)"),
            ({"state_dict": good, **normalizer, "obs_mean": "four"}, "must be finite numbers"),
            ({"state_dict": good, **normalizer, "obs_var": -torch.ones(4)}, "no variance negative"),
        )
    ):
        file = tmp_path / f"{number}.pt"
        torch.save(record, file)
        with pytest.raises(UserError, match=sentence):
            lem.evaluate(file, "CartPole-v1", episodes=1)
    (tmp_path / "text.pt").write_text("no weights")
    with pytest.raises(UserError, match="is damaged, or no file of torch"):
        lem.evaluate(tmp_path / "text.pt", "CartPole-v1", episodes=1)
    torch.save({name: tensor.half() for name, tensor in good.items()}, tmp_path / "half.pt")
    assert len(lem.evaluate(tmp_path / "half.pt", "CartPole-v1", episodes=2).returns) == 2


def test_any_seed_will_do_for_a_function():
    first, again = (lem.evaluate(lambda obs: 0, "CartPole-v1", episodes=2, seed=2**32 + 1).returns for _ in range(2))
    assert first == again
