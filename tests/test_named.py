"""Objects of a user's own by name."""

import copy
import functools
import json
import pickle
import sys

import gymnasium as gym
import numpy as np
import pytest

import lemniscate as lem
from conftest import tiny, tiny_fields
from lemniscate.errors import UserError
from lemniscate.system import named


class Mine:
    class Inner:
        pass

    def __init__(self, x=0):
        self.x = x


def test_what_can_be_imported_has_its_usual_name():
    assert named.name_of(Mine) == "test_named:Mine"
    assert named.name_of(Mine.Inner) == "test_named:Mine.Inner"
    assert named.name_of("anything") == "anything"
    assert named.find("test_named:Mine.Inner") is Mine.Inner
    assert named.find("math:sqrt")(4) == 2


def test_what_cannot_is_found_in_this_process_only():
    made = [lambda x=x: x for x in range(2)]
    names = [named.name_of(function) for function in made]
    assert len(set(names)) == 2
    assert [named.find(name)() for name in names] == [0, 1]
    assert named.name_of(made[0]) == names[0]
    part = named.name_of(functools.partial(Mine, x=3))
    assert named.find(part)().x == 3
    for name in map(str, (*names, part)):  # as a file has them
        assert named.find(name) is not None
        named._PASSED.pop(name)  # as another process would have it
        with pytest.raises(UserError, match="made inside a program: pass the object again"):
            named.find(name)


def test_a_class_of_the_main_program_is_asked_for_again(monkeypatch):
    with pytest.raises(
        UserError, match="__main__ has no Gone; it was defined in another program: pass the object again"
    ):
        named.find("__main__:Gone")
    monkeypatch.setattr(sys.modules["__main__"], "Here", Mine, raising=False)
    assert named.find("__main__:Here") is Mine


def again():
    """A class as the cell of a notebook makes it, each time that it is run."""
    return type("Again", (Mine,), {"__module__": "__main__", "__qualname__": "Again"})


def test_of_two_classes_of_one_name_each_keeps_its_own():
    classes = [again(), again()]
    names = [named.name_of(cls) for cls in classes]
    assert names == ["__main__:Again"] * 2
    assert [named.find(name) for name in names] == classes
    assert [named.find_callable(name) for name in names] == classes
    assert named.find(str(names[0])) is classes[1]  # in a file stands the name alone, which the later class has now


@pytest.mark.parametrize(
    "kept", [copy.copy, copy.deepcopy, lambda config: config.replace(seed=2), lambda config: config.replace(gamma=0.5)]
)
def test_a_config_keeps_meaning_the_classes_that_it_was_given(kept):
    env, wrapper = again(), again()
    config = kept(tiny(named.name_of(env), wrappers=[named.name_of(wrapper)]))
    named.name_of(again())
    assert named.find(config.env) is env
    assert named.find(config.wrappers[0]) is wrapper
    assert json.loads(json.dumps(config.to_json()))["env"] == "__main__:Again"


def test_a_passed_name_is_text_to_another_process():
    sent = pickle.loads(pickle.dumps(named.name_of(again())))
    assert (sent, type(sent)) == ("__main__:Again", str)


def boat(size):
    """A class of environments whose observations have so many numbers."""

    class Boat(gym.Env):
        observation_space = gym.spaces.Box(-1, 1, (size,), np.float32)
        action_space = gym.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.t = 0
            return np.zeros(size, np.float32), {}

        def step(self, action):
            self.t += 1
            return np.zeros(size, np.float32), 0.0, self.t >= 4, False, {}

    return Boat


@pytest.mark.parametrize("module", ["local", "__main__"])
def test_runs_of_classes_of_one_name_are_trained_and_loaded_as_what_they_are(tmp_path, module):
    first, second = boat(2), boat(3)
    if module == "__main__":  # as in a notebook, whose names can be imported
        for cls in (first, second):
            cls.__module__, cls.__qualname__ = "__main__", "Boat"
    fields = tiny_fields(total_steps=32, backend="gymnasium")
    given = lem.config_for("ppo", env=first, **{**fields, "num_envs": 2})
    for size, cls in ((2, first), (3, second)):
        run = lem.train("ppo", cls, run=tmp_path / str(size), progress=False, **fields)
        assert run.policy.spec.observation_size == size
        assert lem.evaluate(run.policy, episodes=1).lengths == [4]
    envs = lem.make_envs(given)
    assert [env.spec.observation_size for env in envs] == [2, 2]
    for env in envs:
        env.close()
    if module == "local":  # each has a name of its own, by which this process finds it
        assert lem.evaluate(lem.load(tmp_path / "2"), episodes=1).lengths == [4]


def test_a_callable_with_arguments():
    assert named.find_callable("test_named:Mine(x=-2.5)")().x == -2.5
    assert named.find_callable("test_named:Mine( x = {'a': [1, None]} )")().x == {"a": [1, None]}
    assert named.find_callable("test_named:Mine")().x == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nowhere:Thing", "nowhere:Thing cannot be found: there is no module nowhere here"),
        ("test_named:Nothing", "test_named has no Nothing"),
        ("test_named:mine", "test_named has no mine: did you mean Mine?"),
        (
            "./test_named.py:Mine",
            "names a file; name its module, without folder and ending, in that folder: test_named:",
        ),
        ("test_named:Mine.y2", "test_named has no Mine.y2."),
        (
            "test_named.py:Mine",
            "names a file; name its module, without folder and ending, in that folder: test_named:Mine.",
        ),
        ("Mine", "'Mine' is no name of an object; it has the form module:name"),
        ("test_named:Mine(x=open('/etc/passwd'))", "cannot be read; it has the form"),
        ("test_named:Mine(x=1", "cannot be read; it has the form"),
        ("test_named:Mine(x=1).__class__", "cannot be read; it has the form"),
        ("test_named:Mine(**{'x': 1})", "cannot be read; it has the form"),
        ("test_named:Mine(x=1)(x=2)", "cannot be read; it has the form"),
        ("test_named:Mine(1)", "need their names"),
        ("math:pi", "math:pi is neither a function nor a class"),
    ],
)
def test_a_wrong_name_is_said(text, said):
    with pytest.raises(UserError) as raised:
        named.find_callable(text)
    assert said in str(raised.value)


def test_a_folder_is_no_module(tmp_path, monkeypatch):
    (tmp_path / "boat").mkdir()
    (tmp_path / "boat" / "boat.py").write_text("class Boat: ...")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="boat:Boat cannot be found: boat is a folder here; run inside of it"):
        named.find("boat:Boat")
