"""`lemniscate check` finds what is wrong, and says it."""

import gymnasium as gym
import numpy as np
import pytest

import environments  # noqa: F401  (registers the copies)
from lemniscate.envs.check import check


class Fine(gym.Env):
    """Nothing is wrong with it."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.look(), {}

    def step(self, action):
        self.t += 1
        return self.look(), self.pay(), self.t == 20, False, {}

    def look(self):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def pay(self):
        return 1.0


class Unseeded(Fine):
    def look(self):
        return np.random.default_rng().uniform(-1, 1, 2).astype(np.float32)


class Blind(Fine):
    def look(self):
        return np.zeros(2, dtype=np.float32)


class Nan(Fine):
    def pay(self):
        return float("nan") if self.t > 7 else 1.0


class WrongType(Fine):
    def look(self):
        return [5.0, 5.0]


class Rich(Fine):
    def pay(self):
        return 1e4


class Stillborn(Fine):
    def __init__(self):
        raise OSError("no such robot")


class Breaks(Fine):
    def pay(self):
        return 1.0 if self.t < 15 else self.bolts


class Stuck(Fine):
    """Rules every action out."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0], {"action_mask": [0, 0]}


def found(name):
    return [(finding.grade, finding.sentence) for finding in check(f"envs.test_check:{name}")]


def test_a_good_environment():
    findings = found("Fine")
    assert not [sentence for grade, sentence in findings if grade == "bad"]
    text = " ".join(sentence for _, sentence in findings)
    assert "observes 2 numbers" in text
    assert "one of 2 choices" in text
    assert "has no time limit" in text
    assert "100 episodes ended by its rules" in text
    assert "the final observation is kept" in text
    assert "Its observations are float32" in text


def test_the_mode_of_a_vector_environment_is_told():
    assert any("the action of that step is ignored" in finding.sentence for finding in check("Countdown-v0"))


@pytest.mark.parametrize(
    ("name", "grade", "said"),
    [
        ("Unseeded", "bad", "cannot be repeated"),
        ("Blind", "note", "Another seed gives the same"),
        ("Nan", "bad", "The reward of environment 0 is nan"),
        ("WrongType", "bad", "Gymnasium's checker: The first element returned by `env.reset()`"),
        ("Rich", "note", "train with --scale-rewards"),
        ("Stillborn", "bad", "It cannot be made: OSError: no such robot."),
        ("Breaks", "bad", "It cannot be played with random actions: AttributeError: 'Breaks' object has no attribute"),
        ("Stuck", "bad", "rules out every action of environment 0: its action_mask is all zero."),
    ],
)
def test_what_is_wrong_is_said(name, grade, said):
    assert any(grade == g and said in sentence for g, sentence in found(name)), found(name)


def test_masks_images_and_native_backends_are_played():
    assert any("masked" in sentence for _, sentence in [(f.grade, f.sentence) for f in check("Copy-masked-v0")])
    assert any("an image" in f.sentence for f in check("Copy-image-v0"))
    assert "Served by envpool" in next(check("CartPole-v1")).sentence


def test_a_module_that_is_not_there():
    from lemniscate.errors import UserError

    with pytest.raises(UserError, match="nowhere:Env cannot be found: there is no module nowhere here"):
        list(check("nowhere:Env"))
    with pytest.raises(UserError, match=r"envs\.test_check has no Nothing"):
        list(check("envs.test_check:Nothing"))
