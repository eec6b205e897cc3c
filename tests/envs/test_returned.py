"""What environments return, and what they do to what they are given: read right, or one sentence."""

import os
import subprocess
import sys
from functools import partial
from itertools import count

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

import lemniscate as lem
from lemniscate.data.rollout import collect
from lemniscate.envs import registry
from lemniscate.envs.conversion import physical_action
from lemniscate.errors import UserError
from lemniscate.nn.actor_critic import ActorCritic
from lemniscate.nn.networks import Layers

TWO = spaces.Box(-1, 1, (2,), np.float32)
SEEN = np.array([0.25, -0.5], np.float32)


def after(obs=SEEN, reward=1.0, terminated=False, truncated=True, info=None):
    return obs, reward, terminated, truncated, {} if info is None else info


class Told(gym.Env):
    """Returns what it was told to."""

    action_space = spaces.Discrete(2)

    def __init__(self, step=None, reset=None, space=TWO):
        self.observation_space = space
        self.told = {"step": after() if step is None else step, "reset": (SEEN, {}) if reset is None else reset}

    def reset(self, *, seed=None, options=None):
        return self.tell("reset")

    def step(self, action):
        return self.tell("step")

    def tell(self, method):
        if isinstance(self.told[method], SystemExit):
            raise self.told[method]
        return self.told[method]


def played(backend="gymnasium", **told):
    """The first step of one such environment."""
    env = registry.make(Told, 1, kwargs=told, backend=backend)
    try:
        first = env.restart(0)
        return first, env.step(torch.zeros(1, dtype=torch.int64))
    finally:
        env.close()


DICT = spaces.Dict({"a": TWO, "b": spaces.Dict({"c": spaces.Discrete(3)})})

WRONG = {
    "four values": ({"step": (SEEN, 1.0, True, {})}, r"Told.step\(\) \(test_returned.py, line \d+\) returned 4 values; it must"),
    "a list": ({"step": [SEEN, 1.0, True, False, {}]}, r"step\(\).* it must return 5 values, \(obs, reward, terminated"),
    "no info": ({"reset": SEEN}, r"reset\(\) .*returned an array of shape \(2,\) and type float32; it must return 2 values"),
    "a number seen": ({"step": after(0.0)}, r"returned an observation of shape \(\); its space is Box.*, of shape \(2,\)"),
    "a row seen": ({"step": after(SEEN[None])}, r"of shape \(1, 2\); its space"),
    "seen at reset": ({"reset": (np.zeros(3), {})}, r"reset\(\) .*of shape \(3,\)"),
    "a text seen": ({"step": after("ab")}, r"an observation that is 'ab'; its space"),
    "nothing seen": ({"step": after(None)}, r"an observation that is None; its space"),
    "masked numbers": ({"step": after(np.ma.array(SEEN, mask=[1, 0]))}, r"an observation that is a masked array of shape \(2,\), some of"),
    "reward of three": ({"step": after(reward=np.zeros(3))}, r"an array of shape \(3,\) and type float64 as reward; it must be a number"),
    "no reward": ({"step": after(reward=None)}, r"returned None as reward; it must be a number"),
    "a written reward": ({"step": after(reward="1.0")}, r"returned '1.0' as reward"),
    "three ends": ({"step": after(terminated=np.zeros(3, bool))}, r"as terminated; it must be True or False"),
    "a written end": ({"step": after(terminated="False")}, r"returned 'False' as terminated; it must be True or False"),
    "half an end": ({"step": after(truncated=0.5)}, r"returned 0.5 as truncated"),
    "no end": ({"step": after(truncated=None)}, r"returned None as truncated"),
    "info None": ({"step": (SEEN, 1.0, False, True, None)}, r"returned None as info; it must be a dictionary"),
    "a list as info": ({"reset": (SEEN, [])}, r"reset\(\) .*returned \[\] as info"),
    "beyond bytes": ({"step": after(np.array([0, 300])), "reset": (np.zeros(2, np.uint8), {}), "space": spaces.Box(0, 255, (2,), np.uint8)}, "numbers are not all of type uint8"),
    "fractions of a byte": ({"reset": (SEEN, {}), "space": spaces.Box(0, 255, (2,), np.uint8)}, "of type float32, whose numbers are not all of type uint8"),
    "no such choice": ({"reset": (8, {}), "space": spaces.Discrete(3, start=5)}, r"with 8, which is not in its space, Discrete\(3, start=5\)"),
    "half a choice": ({"reset": (5.5, {}), "space": spaces.Discrete(3, start=5)}, "not all of type int64"),
    "no bit": ({"step": after(np.array([2, 0], np.int8)), "reset": (np.zeros(2, np.int8), {}), "space": spaces.MultiBinary(2)}, r"with 2, which is not in its space, MultiBinary\(2\)"),
    "a key missing": ({"reset": ({"a": SEEN}, {}), "space": DICT}, "an observation without b; its space is a Dict with the keys a, b"),
    "an inner key": ({"reset": ({"a": SEEN, "b": {}}, {}), "space": DICT}, "an observation without c in b"),
    "no dictionary": ({"reset": (SEEN, {}), "space": DICT}, "its space is a Dict with the keys a, b"),
    "a shorter tuple": ({"reset": ((SEEN,), {}), "space": spaces.Tuple([TWO, TWO])}, "its space is a Tuple of 2"),
    "leaving": ({"step": SystemExit(3)}, r"Told.step\(\) \(test_returned.py, line \d+\) called sys.exit\(3\), which would end"),
    "leaving at once": ({"reset": SystemExit()}, r"Told.reset\(\) .* called sys.exit\(\), which would end"),
    "a measure of two": ({"step": after(info={"is_success": np.zeros(2)})}, r"returned an array of shape \(2,\).* as info\['is_success'\]; a measure is a number"),
}  # fmt: skip


@pytest.mark.parametrize(("told", "sentence"), WRONG.values(), ids=WRONG)
def test_what_is_returned_wrongly_is_said_with_the_place(told, sentence):
    with pytest.raises(UserError, match=sentence) as raised:
        played(**told)
    assert "\n" not in str(raised.value)


class Needs(gym.Env):
    """Its actions are as many as it does not know."""

    observation_space = TWO

    @property
    def action_space(self):
        return spaces.Discrete(self.count)


@pytest.mark.parametrize(
    ("env", "sentence"),
    [
        (Needs, "Needs has no action_space, as 'Needs' object has no attribute 'count': set self.action_space"),
        (
            partial(Told, space=spaces.Box),
            "observation_space of Told is the class Box, and must be a space of gymnasium",
        ),
        (partial(Told, space=None), "Told has no observation_space: set self.observation_space in its __init__"),
    ],
)
def test_what_is_no_space_is_said_with_its_reason(env, sentence):
    with pytest.raises(UserError, match=sentence):
        registry.make(env, 1, backend="gymnasium")


def test_options_that_reset_refuses_are_named(tmp_path):
    with pytest.raises(
        UserError, match=r"reset with the options \{'low': 1, 'high': 0\} raised ValueError: Lower bound"
    ):
        lem.train("ppo", "CartPole-v1", backend="gymnasium", reset_options={"low": 1, "high": 0}, run=tmp_path / "r")


def test_a_worker_says_the_same():
    with pytest.raises(UserError, match=r"^Told.step\(\) \(test_returned.py, line \d+\) returned None as reward"):
        played("gymnasium-async", step=after(reward=None))


@pytest.mark.parametrize("number", [1, 1.0, True, np.float16(1), np.array(1.0), np.array([1.0]), torch.tensor(1.0)])
def test_a_number_is_read_in_any_form(number):
    _, step = played(step=after(reward=number, terminated=number, truncated=0, info={"is_success": number}))
    assert (step.reward.tolist(), step.terminated.tolist(), step.truncated.tolist()) == ([1], [True], [False])
    assert step.measures["is_success"].tolist() == [1]


@pytest.mark.parametrize("form", [list, tuple, np.float64, np.float16, torch.tensor, lambda x: x[::-1][::-1]])
def test_an_observation_is_read_in_any_form(form):
    first, step = played(reset=(form(SEEN), {}), step=after(form(SEEN)))
    assert first.tolist() == step.next_obs.tolist() == [SEEN.tolist()]


def test_what_ends_by_its_rules_is_not_cut_too():
    _, step = played(step=after(terminated=True, truncated=True))
    assert (step.terminated.item(), step.truncated.item()) == (True, False)


def test_info_may_hold_anything_and_its_numbers_are_measured():
    numbers = (
        {"a": 1, "b": "x", "c": {"d": 2.5, "_": None}, "only": 3.0},
        {"a": 0.5, "b": [1], "c": {"d": np.array([1.0])}, "e": np.zeros(9)},
    )
    made = count()

    def make():
        return Told(step=after(info=numbers[next(made) % 2]))

    env = registry.make(make, 2)
    env.restart(0)
    for _ in range(3):
        step = env.step(torch.zeros(2, dtype=torch.int64))
    found = {name: values.tolist() for name, values in step.measures.items()}
    np.testing.assert_equal(found, {"info/a": [1, 0.5], "info/c/d": [2.5, 1], "info/only": [3, np.nan]})
    assert env.take_episodes().measures == {"info/a": 0.75, "info/c/d": 1.75, "info/only": 3}
    assert env.take_episodes().measures == {}
    env.close()


class OldReset(Told):
    def reset(self):
        return self.told["reset"]


class ByPosition(Told):
    def reset(self, seed=None, options=None, /):
        return self.told["reset"]


class Bare(gym.Env):
    def reset(self, *, seed=None, options=None):
        return SEEN, {}


def test_a_class_without_seed_or_spaces_is_told_what_it_lacks():
    for kind in (OldReset, ByPosition):
        said = rf"{kind.__name__}.reset\(\) .*takes no seed or no options; it must be reset\(self, \*, seed"
        with pytest.raises(UserError, match=said):
            registry.make(kind, 1)
    with pytest.raises(UserError, match=r"Bare has no observation_space: set self.observation_space in its __init__"):
        registry.make(Bare, 1)


def test_one_environment_cannot_be_two():
    env = Told()
    with pytest.raises(UserError, match="it returned the same environment again; make a new one at each call"):
        registry.make(lambda: env, 2)
    registry.make(lambda: env, 1).close()


class Scribbler(gym.Env):
    """Overwrites the action that it was given, and what it returned."""

    observation_space = TWO

    def __init__(self, action_space):
        self.action_space, self.got, self.seen = action_space, [], SEEN.copy()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.seen, {}

    def step(self, action):
        assert self.action_space.contains(
            np.asarray(action, self.action_space.dtype) if not self.action_space.shape else action
        )
        self.got.append(np.array(action))
        if getattr(action, "ndim", 0):
            action[...] = self.action_space.sample()
        self.seen += 1
        return self.seen, 0.0, False, False, {}


ACTIONS = [
    spaces.Box(-3, 1, (2,), np.float32),
    spaces.Box(0, 4, (2, 1), np.int64),
    spaces.Box(-5, 5, (), np.float64),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([2, 3], dtype=np.int8),
    spaces.MultiDiscrete([[2, 3], [4, 2]]),
    spaces.MultiBinary(4),
    spaces.MultiBinary((2, 2)),
]


@pytest.mark.parametrize("space", ACTIONS, ids=str)
def test_what_an_environment_does_to_its_arguments_reaches_no_rollout(space):
    env = registry.make(lambda: Scribbler(space), 1)
    assert env.restart(0).tolist() == [SEEN.tolist()]
    made = env.backend._envs.envs[0].unwrapped
    policy = ActorCritic(env.spec, Layers((4,))).policy
    rollout = collect(env, policy, 20, torch.Generator().manual_seed(0))
    assert rollout.obs[:, 0].tolist() == [(SEEN + t).tolist() for t in range(20)]
    np.testing.assert_array_equal(physical_action(rollout.action[:, 0].numpy(), env.spec.action), np.stack(made.got))


def test_an_action_is_the_callers_in_every_kind_of_vector():
    class Vector(VectorEnv):
        num_envs, metadata = 2, {"autoreset_mode": AutoresetMode.DISABLED}
        single_observation_space, single_action_space = TWO, spaces.MultiBinary(3)

        def __init__(self, num_envs):
            self.seen = np.zeros((2, 2), np.float32)

        def reset(self, *, seed=None, options=None):
            return self.seen, {}

        def step(self, actions):
            actions[...], self.seen[...] = 1, self.seen + 1
            return self.seen, [1, 2], np.zeros(2, int), [0.0, 0.0], {}

    env = registry.make(Vector, 2)
    first = env.restart(0)
    action = torch.zeros(2, 3, dtype=torch.int64)
    step = env.step(action)
    assert (action.sum().item(), first.sum().item(), step.next_obs.sum().item()) == (0, 0, 4)
    assert (step.reward.tolist(), step.truncated.dtype) == ([1, 2], torch.bool)
    Vector.step = lambda self, actions: (self.seen[:1], np.zeros(2), np.zeros(2, bool), np.zeros(2, bool), {})
    with pytest.raises(UserError, match=r"returned an observation of shape \(1, 2\)"):
        env.step(action)
    Vector.step = lambda self, actions: (self.seen, np.zeros(3), np.zeros(2, bool), np.zeros(2, bool), {})
    with pytest.raises(UserError, match="as reward; it must be a number for each environment"):
        env.step(action)


def test_an_environment_that_cannot_be_closed_costs_nothing(tmp_path, capfd):
    class Sticky(Told):
        def close(self):
            raise OSError("the port is gone")

    small = {"num_envs": 2, "num_steps": 8, "minibatch_size": 8, "total_steps": 32, "progress": False}
    run = lem.train("ppo", env=Sticky, run=tmp_path / "run", **small)
    assert run.policy.step == 32
    assert "Sticky.close() (test_returned.py, line" in capfd.readouterr().err


def test_options_reach_every_reset(tmp_path):
    class Levels(Told):
        seen = set()  # noqa: RUF012

        def reset(self, *, seed=None, options=None):
            Levels.seen.add(options["level"])
            return self.told["reset"]

    small = {"num_envs": 2, "num_steps": 8, "minibatch_size": 8, "total_steps": 32, "progress": False}
    run = lem.train("ppo", env=Levels, reset_options={"level": 3}, run=tmp_path / "run", **small)
    lem.evaluate(run.policy, episodes=2)
    lem.evaluate(run.policy, episodes=1, seed=1, env_kwargs={})
    assert Levels.seen == {3}
    with pytest.raises(UserError, match="wrappers and reset_options are for single environments of the gymnasium"):
        lem.train("ppo", env="CartPole-v1", backend="envpool", reset_options={"a": 1}, **small)


SCRIPT = """
import gymnasium as gym, numpy as np
import lemniscate as lem
from envs.test_returned import Told
run = lem.train("ppo", env=Told, num_envs=2, num_steps=8, minibatch_size=8, total_steps=16, progress=False,
                backend="gymnasium-async", run=RUN)
"""


@pytest.mark.long
def test_a_script_without_a_guard_is_told_of_it(tmp_path):
    file = tmp_path / "script.py"
    file.write_text(SCRIPT.replace("RUN", repr(str(tmp_path / "run"))))
    path = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, file], capture_output=True, text=True, env=path)
    assert "A script needs `if __name__ == '__main__':`" in done.stderr


def test_the_numbers_of_info_are_curves_of_training_and_evaluation(tmp_path):
    class Terms(Told):
        def __init__(self):
            super().__init__(step=after(truncated=False))
            self.t = 0

        def step(self, action):
            self.t = self.t % 4 + 1
            return after(truncated=self.t == 4, info={"energy": -0.5, **({"length": 4} if self.t == 4 else {})})

    small = {"num_envs": 2, "num_steps": 8, "minibatch_size": 8, "total_steps": 32, "evaluate_every": 16}
    run = lem.train("ppo", env=Terms, run=tmp_path / "run", evaluate_episodes=2, progress=False, **small)
    from lemniscate.run.metrics import read_metrics

    lines = read_metrics(run.path)
    assert {(line["info/energy"], line["info/length"]) for line in lines if "info/energy" in line} == {(-0.5, 4.0)}
    assert any(line.get("evaluation/info/energy") == -0.5 for line in lines)
    scores = lem.evaluate(run.policy, episodes=2)
    assert scores.measures == {"info/energy": -0.5, "info/length": 4.0}
    assert scores.to_json()["info/energy"] == -0.5


def test_spaces_stay_what_they_were():
    class Growing(Told):
        def reset(self, *, seed=None, options=None):
            self.action_space = spaces.Discrete(2 + getattr(self, "resets", 0))
            self.resets = 1
            return super().reset(seed=seed, options=options)

    env = registry.make(Growing, 1)
    with pytest.raises(
        UserError, match=r"made action_space Discrete\(3\); it was Discrete\(2\), and must stay what __in"
    ):
        env.restart(0)


@pytest.mark.parametrize("final", [3.0, np.zeros(2), {"x": 1.0}, "text"])
def test_entries_with_the_names_that_vectors_use_are_taken_for_nothing_else(final):
    _, step = played(step=after(info={"final_info": final, "_final_info": 2, "final_obs": 1.0, "_x": 1, "height": 2.0}))
    assert step.measures["info/height"].tolist() == [2]


class Unmakable(Told):
    def __init__(self, error):
        raise error


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (FileNotFoundError(2, "No such file", "map.xml"), r"FileNotFoundError: \[Errno 2\] No such file: 'map.xml'"),
        (RuntimeError("no simulator"), "RuntimeError: no simulator"),
        (SystemExit("no licence"), "SystemExit: no licence"),
    ],
)
@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async"])
def test_what_its_making_raises_is_said_with_the_place(error, said, backend):
    with pytest.raises(UserError, match=rf"cannot be made: {said} \(test_returned.py, line \d+\)$"):
        registry.make(lambda: Unmakable(error), 2, backend=backend)


@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async"])
def test_copies_with_other_spaces_are_refused(backend):
    made = count()

    def make():
        env = Told()
        env.observation_space = spaces.Box(-1.0, 1.0 + next(made), (2,), np.float32)
        return env

    with pytest.raises(UserError, match=r"cannot be made: .* spaces are not equivalent"):
        registry.make(make, 2, backend=backend)
