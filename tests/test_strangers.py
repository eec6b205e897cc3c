"""What strangers bring: their environments, policies, loggers, callbacks and names, as they write them."""

import functools
import json
import os
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from torch import nn

import lemniscate as lem
from conftest import tiny_fields, tiny_off_policy
from environments import Noise
from lemniscate.api.options import RunOptions
from lemniscate.cli import ending, main
from lemniscate.envs import registry
from lemniscate.envs.factory import is_own, maker_of
from lemniscate.envs.gymnasium import GymnasiumBackend
from lemniscate.envs.spaces import observation_parts, read_mask
from lemniscate.errors import UserError, WorkerError
from lemniscate.run.checkpoint import list_steps
from lemniscate.run.environments import mirror_of
from lemniscate.run.metrics import read_metrics
from lemniscate.system import named

FAST = tiny_fields(total_steps=64) | {"progress": False}


class Plain(Noise):
    """An environment of this module."""


class Quits(Plain):
    def close(self):
        sys.exit()


class Options(Plain):
    seen: list = []  # noqa: RUF012

    def reset(self, *, seed=None, options=None):
        Options.seen.append(options)
        return super().reset(seed=seed)


class Broken(Plain):
    def step(self, action):
        if self.t == 3:
            raise BrokenPipeError(32, "Broken pipe")
        return super().step(action)


class Drawn(Plain):
    """A picture that fails in its third drawing."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(self, render_mode=None):
        self.render_mode, self.drawn = render_mode, 0

    def render(self):
        self.drawn += 1
        if self.drawn == 3:
            raise IndexError("beyond the map")
        return np.zeros((4, 4, 3), np.uint8)


class Observing(Plain):
    """A method of a name that simulators of rsl_rl have."""

    def get_observations(self):
        return self._see()


class Arm(Plain):
    path = Path("arm.xml")


class Pinocchio(Plain):
    """The names that Gymnasium's robots have, of another simulator."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)
    model, data = object(), object()

    def set_state(self, state):
        pass


def test_an_environment_whose_close_ends_the_program_is_trained(tmp_path, capsys):
    assert lem.train("ppo", Quits, run=tmp_path / "run", **FAST).policy.step == 64
    assert "Quits.close()" in capsys.readouterr().err


@pytest.mark.parametrize("backend", ["gymnasium", pytest.param("gymnasium-async", marks=pytest.mark.long)])
def test_every_reset_has_the_options_of_the_first(backend):
    """Gymnasium's vectors take the mask out of theirs, and leave {}."""
    Options.seen.clear()
    env = registry.make(Options, 2, backend=backend)
    env.restart(0)
    for _ in range(12):
        env.step(torch.zeros(2, dtype=torch.int64))
    env.close()
    assert all(options is None for options in Options.seen)
    assert len(Options.seen) >= 6 or backend == "gymnasium-async"


def test_a_pipe_that_breaks_in_an_environment_is_said():
    """One of ours that breaks is the end of who reads the output, and says nothing."""
    env = registry.make(Broken, 2)
    env.restart(0)
    act, said = (
        torch.zeros(2, dtype=torch.int64),
        r"Broken.step\(\) .* raised BrokenPipeError: .*Broken pipe.*strangers.py",
    )
    for _ in range(3):
        env.step(act)
    with pytest.raises(WorkerError, match=said):
        env.step(act)
    assert ending(WorkerError("X.step() raised BrokenPipeError."), "train")[0] == 1


def test_a_picture_that_fails_in_the_middle_costs_the_video_alone(tmp_path, capsys):
    run = lem.train("ppo", Drawn, run=tmp_path / "run", **FAST | {"video_every": 32})
    assert run.policy.step == 64
    assert "No recording at step 32: IndexError: beyond the map (test_strangers.py, line" in capsys.readouterr().err


def test_a_gymnasium_environment_with_a_method_of_rsl_rls_is_one_of_gymnasium():
    assert registry.backend_for(named.name_of(Observing)) == "gymnasium"


def test_an_environment_class_with_a_path_is_checked_as_one():
    assert lem.check(Arm)[0].sentence.startswith("Served by gymnasium")


def test_a_robot_of_another_simulator_has_no_symmetry():
    config = lem.config_for("reppo", Pinocchio, symmetry="auto", num_envs=4, num_steps=8, minibatch_size=16)
    assert mirror_of(config) is None
    with pytest.raises(UserError, match=r"has no symmetry that could be used: .*Error, "):
        mirror_of(config.replace(symmetry="on"))


class Rows(VectorEnv):
    """N environments that are rows of arrays, one of which is named envs."""

    metadata = {"autoreset_mode": gym.vector.AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, num_envs=2):
        self.num_envs, self.envs = num_envs, np.zeros((num_envs, 2), np.float32)
        self.single_observation_space, self.single_action_space = Plain.observation_space, Plain.action_space
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed=None, options=None):
        return self.envs.copy(), {}

    def step(self, actions):
        no = np.zeros(self.num_envs, bool)
        return self.envs.copy(), np.zeros(self.num_envs), no, no, {}

    def close_extras(self, **kwargs):
        raise OSError("the line is dead")


def test_a_vector_environment_may_hold_an_array_named_envs_and_fail_to_close(capsys):
    env = registry.make(Rows, 2)
    env.restart(0)
    env.close()
    assert "raised OSError: the line is dead" in capsys.readouterr().err


def test_a_partial_of_ones_own_is_ones_own():
    assert is_own(maker_of(named.name_of(functools.partial(Plain))))
    assert GymnasiumBackend.exists_once(named.name_of(functools.partial(Plain)), 1)


class Task:
    def __init__(self, level):
        self.level = level

    def make(self):
        return Plain()

    @classmethod
    def easy(cls):
        return cls(0)


class Hard(Task):
    pass


def twice(function):
    return functools.wraps(function)(lambda *given: function(*given))


def plainly():
    return Plain()


def test_what_no_file_holds_under_its_name_is_not_mistaken_for_what_does():
    """Methods of two objects, an inherited method of a class, what a decorator has made of a function."""
    easy, hard = Task(1).make, Task(2).make
    assert named.name_of(easy) != named.name_of(hard)
    assert "<" in named.name_of(easy)
    assert named.find(str(named.name_of(easy))) == easy
    assert named.name_of(Hard.easy) == f"{__name__}:Hard.easy"
    assert named.name_of(plainly) == f"{__name__}:plainly"
    assert "<" in named.name_of(twice(plainly))
    assert named.name_of(windy) == f"{__name__}:windy"
    assert "<" in named.name_of(blown(5.0)(plainly)), "of the code of another one that stands there"


def blown(by):
    def decorate(function):
        @functools.wraps(function)
        def make():
            return function() if by else None

        make.__qualname__ = "windy"
        return make

    return decorate


windy = blown(1.0)(plainly)


class Net(nn.Module):
    """Logits of two actions; an activation is named as a method of policies is."""

    def __init__(self):
        super().__init__()
        self.act, self.drop = nn.ReLU(), nn.Dropout(0.5)
        self.inside, self.out = nn.Linear(4, 8), nn.Linear(8, 2)

    def forward(self, obs):
        return self.out(self.drop(self.act(self.inside(obs))))

    def decide(self, obs):
        return self.forward(obs).argmax(-1)


class Still(nn.Module):
    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, obs):
        return self.net.out(self.net.inside(obs).relu())


class Holder:
    def __init__(self, net):
        self.net = net

    def predict(self, obs):
        with torch.no_grad():
            return self.net(torch.as_tensor(obs)).argmax(-1).numpy()


@pytest.mark.parametrize("as_given", [lambda net: net, lambda net: net.decide, Holder])
def test_a_policy_with_a_network_is_evaluated_as_that_without_dropout(as_given):
    torch.manual_seed(0)
    net = Net()
    wanted = lem.evaluate(Still(net), "CartPole-v1", episodes=3)
    assert lem.evaluate(as_given(net), "CartPole-v1", episodes=3).returns == wanted.returns
    assert net.training


def test_a_policy_may_have_a_path_of_its_own(tmp_path):
    class WithPath:
        path = "weights.pt"

        def predict(self, obs):
            return 0

    lem.evaluate(WithPath(), "CartPole-v1", episodes=1, report=tmp_path / "report")
    assert (tmp_path / "report" / "plots" / "report.html").exists()


class Wide(Plain):
    """Two parts with numbers for names."""

    observation_space = spaces.Dict({1: spaces.Box(-1, 1, (2,)), 2: spaces.Box(5, 6, (3,))})

    def _see(self):
        return {
            key: self.np_random.uniform(part.low, part.high).astype(np.float32)
            for key, part in self.observation_space.items()
        }


def test_a_part_that_is_named_by_a_number_is_that_part():
    shapes = set()

    def policy(obs):
        shapes.add(np.shape(obs[1])[-1])
        return 0

    lem.evaluate(policy, Wide, episodes=1)
    assert shapes == {2}


def test_keys_that_json_does_not_hold_are_refused_or_taken_as_numbers():
    one = spaces.Box(-1, 1, (1,))
    assert [part.path for part in observation_parts(spaces.Dict({np.int64(3): one}), "X")] == [(3,)]
    with pytest.raises(UserError, match=r"X observes a Dict with the key \(1, 2\); keys must be texts"):
        observation_parts(spaces.Dict({(1, 2): one}), "X")


def test_masks_of_a_batch_may_be_a_list_or_a_tensor():
    spec = registry.make("environments:Copy", 1, kwargs={"kind": "masked"}).spec
    rows, flat = [[1, 0, 0, 1], [0, 1, 0, 1]], np.zeros((2, 3), np.float32)
    for masks in (rows, torch.tensor(rows), [np.array(row) for row in rows], np.array(rows)):
        assert read_mask(masks, spec, flat).tolist() == np.array(rows, bool).tolist()


class History:
    """A callback that is empty at first."""

    def __init__(self):
        self.rows = []

    def __len__(self):
        return len(self.rows)

    def __call__(self, step, metrics, policy):
        self.rows.append(step)


class Curve(list):
    """A callback that is a list."""

    def __call__(self, step, metrics, policy):
        self.append(step)


@pytest.mark.parametrize("callback", [History(), Curve()])
def test_a_callback_may_be_empty_or_a_list(callback, tmp_path):
    lem.train("ppo", Plain, run=tmp_path / "run", callbacks=callback, **FAST)
    assert len(callback) == 2
    assert RunOptions(callbacks=callback).callbacks == [callback]


class Failing:
    """A logger that fails at its second line, or as it is closed."""

    at = "write"

    def __init__(self, path, config, step):
        self.lines = 0

    def write(self, step, metrics, episodes=None):
        self.lines += 1
        if self.at == "write" and self.lines == 2:
            raise RuntimeError("the database is gone")

    def close(self, pictures):
        if self.at == "close":
            raise RuntimeError("the database is gone")


class FailsToClose(Failing):
    at = "close"


def test_a_logger_that_fails_leaves_the_run_saved(tmp_path):
    with pytest.raises(RuntimeError, match="the database is gone"):
        lem.train(
            "ppo", Plain, run=tmp_path / "run", track=Failing, **FAST | {"total_steps": 256, "checkpoint_every": 256}
        )
    assert list_steps(tmp_path / "run" / "checkpoints") == [64]
    assert lem.resume(tmp_path / "run", progress=False).policy.step == 256


def test_a_logger_that_fails_as_it_is_closed_leaves_the_directory_free(tmp_path):
    with pytest.raises(RuntimeError, match="the database is gone"):
        lem.train("ppo", Plain, run=tmp_path / "run", track=FailsToClose, **FAST)
    assert lem.resume(tmp_path / "run", progress=False).policy.step == 64


ALGORITHMS = {
    "takes_ppos": (
        "from lemniscate.algos.ppo import Config, State, init, train",
        r"The Config of takes_ppos is that of ppo: write",
    ),
    "leaves": ("import sys\nsys.exit()", "leaves ends the program when it is imported"),
}


@pytest.mark.parametrize("module", ALGORITHMS)
def test_modules_of_algorithms_that_are_none_have_a_sentence(module, tmp_path, monkeypatch):
    text, said = ALGORITHMS[module]
    (tmp_path / f"{module}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match=said):
        lem.config_for(module, "CartPole-v1")


def test_a_module_of_an_environment_that_ends_the_program_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "ends.py").write_text("import sys\nsys.exit('run me as a script')")
    monkeypatch.chdir(tmp_path)
    assert main(["doctor", "ends:Env"]) == 2
    assert "ends ends the program when it is imported: put that below if __name__" in capsys.readouterr().err


def test_a_metric_named_step_is_refused(tmp_path, monkeypatch):
    from lemniscate.algos import ppo

    update = ppo.update
    monkeypatch.setattr(ppo, "update", lambda *given: {**update(*given), "step": 1.0})
    with pytest.raises(UserError, match="a metric named step, which each line has already"):
        lem.train("ppo", Plain, run=tmp_path / "run", **FAST)


def test_what_ends_a_field_that_nothing_follows_is_refused():
    with pytest.raises(
        UserError, match="desired_kl adapts the learning rate: final_learning_rate needs desired_kl none"
    ):
        lem.config_for("ppo", "CartPole-v1", "default", final_learning_rate=0.5)
    assert (
        lem.config_for("ppo", "CartPole-v1", "default", final_learning_rate=0.5, desired_kl=None).final_learning_rate
        == 0.5
    )


def test_episodes_of_a_run_off_policy_that_is_cut_short_in_its_last_update_are_made_up_for(tmp_path):
    """The last update passes `total_steps`; a checkpoint in its middle is not the end of the run."""
    stop = type("Stop", (), {"seen": 0})

    class Interrupts(Plain):
        action_space = spaces.Box(-1, 1, (1,), np.float32)

        def step(self, action):
            stop.seen += 1
            if stop.seen == 230:
                import signal

                signal.raise_signal(signal.SIGINT)
            return super().step(action[0])

    fields = tiny_off_policy(total_steps=200, log_every=60, num_envs=2, learning_starts=20) | {"progress": False}
    with pytest.raises(KeyboardInterrupt):
        lem.train("td3", Interrupts, run=tmp_path / "run", **fields)
    assert list_steps(tmp_path / "run" / "checkpoints")[-1] > 200
    done = lem.resume(tmp_path / "run", env=Interrupts, progress=False)
    assert done.policy.step == 240
    assert read_metrics(tmp_path / "run")[-1]["step"] == 240
    assert json.loads((tmp_path / "run" / "config.json").read_text())["config"]["total_steps"] == 200


def test_what_is_of_a_policy_is_refused_without_one(capsys):
    assert main(["watch", "--random", "--env", "CartPole-v1", "--checkpoint", "best"]) == 2
    assert "are of a policy, and there is none" in capsys.readouterr().err


def test_the_value_of_an_option_is_no_algorithm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--total-steps", "64", "--num-envs", "4", "--num-steps", "8", "--minibatch-size", "16", "--quiet"]
    assert main(["train", "--env", "CartPole-v1", "--run", "ppo", *words]) == 0
    assert (tmp_path / "ppo" / "config.json").exists()


def test_a_page_has_no_video_of_another_evaluation(tmp_path):
    """Drawn fails in its third picture, so that there is none of this one."""
    videos = tmp_path / "report" / "videos"
    videos.mkdir(parents=True)
    (videos / "episode.gif").write_bytes(b"older")
    os.utime(videos / "episode.gif", (0, 0))
    lem.evaluate(lambda obs: 0, Drawn, episodes=1, report=tmp_path / "report")
    assert "A video of" not in (tmp_path / "report" / "plots" / "report.html").read_text()
