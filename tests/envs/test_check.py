"""`lemniscate doctor ENV` finds what is wrong, and says it."""

import gymnasium as gym
import numpy as np
import pytest

import environments  # noqa: F401  (registers the copies)
import lemniscate as lem
from lemniscate.api.results import check
from lemniscate.errors import UserError


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


class Double(Fine):
    def look(self):
        return np.zeros(2)


class Outside(Fine):
    def look(self):
        return np.array([0.0, 50.0], dtype=np.float32)


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


class Sound(Fine):
    """Walks by its action, is paid for where it is, and cuts its episodes itself: nothing to remark."""

    def step(self, action):
        self.place = np.clip(self.place + 0.1 * (2 * int(action) - 1), -1, 1)
        self.t += 1
        return self.look(), float(self.place), bool(abs(self.place) == 1), self.t == 30, {}

    def reset(self, *, seed=None, options=None):
        self.place = 0.0
        return super().reset(seed=seed)

    def look(self):
        return np.array([self.place, self.np_random.uniform(-1, 1)], dtype=np.float32)


class Reuses(Sound):
    """Fills one array again and again."""

    def __init__(self):
        self.array = np.zeros(2, dtype=np.float32)

    def look(self):
        self.array[:] = super().look()
        return self.array


class Constant(Sound):
    """Always looks the same, and returns the same array: nobody sees it change."""

    array = np.zeros(2, dtype=np.float32)

    def look(self):
        return self.array


class Strict(Sound):
    """Refuses what its mask rules out."""

    action_space = gym.spaces.Discrete(4, start=2)

    def reset(self, *, seed=None, options=None):
        obs, _ = super().reset(seed=seed)
        return obs, self.draw()

    def step(self, action):
        assert self.mask[action - 2], "this action is not legal now"
        obs, reward, terminated, truncated, _ = super().step(action % 2)
        return obs, reward, terminated, truncated, self.draw()

    def draw(self):
        self.mask = np.zeros(4, dtype=np.int8)
        self.mask[self.np_random.choice(4, 2, replace=False)] = 1
        return {"action_mask": self.mask.copy()}


class Scales(Sound):
    observation_space = gym.spaces.Box(-1e7, 1e7, (2,), np.float32)

    def look(self):
        return super().look() * np.array([1e6, 1e-6], dtype=np.float32)


class Unrewarded(Sound):
    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, 0.0, *rest


class PaidLate(Sound):
    """Pays what was observed two steps before."""

    def reset(self, *, seed=None, options=None):
        self.seen = [0.0, 0.0]
        return super().reset(seed=seed)

    def step(self, action):
        obs, _, *rest = super().step(action)
        self.seen.append(float(obs[1]))
        return obs, self.seen[-3], *rest


class PaidByEpisode(Sound):
    def reset(self, *, seed=None, options=None):
        found = super().reset(seed=seed)
        self.price = self.np_random.uniform()
        return found

    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, self.price, *rest


class Halved(Sound):
    """Uses one number of its action, and writes one of its observation."""

    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def step(self, action):
        return super().step(action[0] > 0)

    def look(self):
        return np.array([self.place, 0.3], dtype=np.float32)


class Pixels(Sound):
    """Images of floats."""

    observation_space = gym.spaces.Box(0, 1, (20, 20, 3), np.float32)

    def look(self):
        return np.full((20, 20, 3), (self.place + 1) / 2, dtype=np.float32)


class Stacked(Sound):
    observation_space = gym.spaces.Box(0, 255, (4, 20, 20), np.uint8)

    def look(self):
        return np.full((4, 20, 20), int(100 * self.place + 100), dtype=np.uint8)


class Long(Sound):
    """Has an argument, and never cuts its episodes."""

    def __init__(self, edge):
        self.edge = edge

    def step(self, action):
        obs, reward, _, _, info = super().step(action)
        return obs, reward, abs(self.place) >= self.edge, False, info


def found(name, **options):
    return [(finding.grade, finding.sentence) for finding in check(f"envs.test_check:{name}", **options)]


def test_a_good_environment():
    findings = found("Sound")
    assert {grade for grade, _ in findings} == {"good"}, findings
    text = " ".join(sentence for _, sentence in findings)
    assert "observes 2 numbers" in text
    assert "one of 2 choices" in text
    assert "episodes ended by its rules and" in text
    assert "the final observation is kept" in text
    assert "Its observations are float32" in text


@pytest.mark.parametrize("name", ["Strict", "Constant"])
def test_masks_and_an_observation_that_never_changes_are_no_fault(name):
    assert not [sentence for grade, sentence in found(name) if grade == "bad" or "copy" in sentence]


def test_an_array_that_is_used_again_is_named_as_that_and_as_nothing_else():
    ((_, sentence),) = [finding for finding in found("Reuses") if finding[0] != "good"]
    assert "into the array that it returned before" in sentence
    assert "return a copy" in sentence


def test_arguments_and_wrappers_are_checked_too():
    assert found("Long") == [("bad", found("Long")[0][1])]
    assert "missing 1 required positional argument: 'edge'" in found("Long")[0][1]
    limit = "gymnasium.wrappers:TimeLimit(max_episode_steps=15)"
    unlimited, limited = (
        found("Long", env_kwargs={"edge": 0.5}),
        found("Long", env_kwargs={"edge": 1}, wrappers=[limit]),
    )
    assert next(sentence for grade, sentence in unlimited if grade == "note").startswith("No time limit was met")
    assert {grade for grade, _ in limited} == {"good"}, limited
    assert any("by the time limit" in sentence and "and 0 by" not in sentence for _, sentence in limited)


class Renamed(gym.ObservationWrapper):
    """Observes a number less."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def observation(self, observation):
        return observation[:1]


def narrow():
    return Renamed(WrongSpace())


class WrongSpace(Sound):
    """Its space is right only when it is wrapped."""

    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)


def test_a_function_is_checked_as_what_it_makes():
    assert "bad" not in {grade for grade, _ in found("narrow")}
    assert "bad" in {grade for grade, _ in found("WrongSpace")}


def test_a_class_and_a_wrapper_are_checked_from_python():
    findings = lem.check(Long, env_kwargs={"edge": 1}, wrappers=[lambda env: gym.wrappers.TimeLimit(env, 15)])
    assert {finding.grade for finding in findings} == {"good"}, findings
    assert str(findings[0]).startswith("✓ Served by gymnasium; observes 2 numbers")
    with pytest.raises(UserError, match="made already"):
        lem.check(Sound())


def test_the_mode_of_a_vector_environment_is_told():
    assert any("the action of that step is ignored" in finding.sentence for finding in check("Countdown-v0"))


@pytest.mark.parametrize(
    ("name", "grade", "said"),
    [
        ("Unseeded", "bad", "cannot be repeated"),
        ("Blind", "note", "Another seed gives the same"),
        ("Nan", "bad", "The reward of environment 0 is nan"),
        ("WrongType", "bad", "Gymnasium's checker: The first element returned by `env.reset()`"),
        ("Double", "bad", "It is float64, the space float32: return obs.astype(np.float32)."),
        ("Outside", "bad", "Its number 1 is 50, outside of [-1, 1]."),
        ("Rich", "note", "train with --scale-rewards (on-policy)"),
        ("Fine", "note", "No time limit was met in"),
        ("Fine", "note", "look whether step() uses its argument"),
        ("Fine", "note", "terminated after exactly 20 steps: if that is a time limit, report it as truncated"),
        ("Fine", "note", "Every reward was 1, whatever was done"),
        ("Unrewarded", "note", "Every reward was 0, whatever was done"),
        ("Scales", "note", "Observations reach 1e+06 in obs[0] and 1e-06 in obs[1]"),
        ("Pixels", "note", "The array obs (20, 20, 3) becomes 1,200 numbers without their places"),
        ("Stacked", "good", "an image of 20 × 20 bytes with 4 channels, from arrays (4, 20, 20)"),
        ("Stillborn", "bad", "Stillborn cannot be made: OSError: no such robot"),
        ("PaidLate", "note", "The row before explains"),
        ("PaidByEpisode", "note", "The reward is the same in every step of an episode"),
        ("Halved", "note", "One of the numbers of an action explains 0."),
        ("Halved", "note", "50% of the observed numbers were never seen to change."),
        ("Breaks", "bad", "It cannot be played with random actions: AttributeError: 'Breaks' object has no attribute"),
        ("Stuck", "bad", "rules out every action of environment 0: its action_mask is all zero."),
    ],
)
@pytest.mark.one_in(2)
def test_what_is_wrong_is_said(name, grade, said):
    assert any(grade == g and said in sentence for g, sentence in found(name)), found(name)


def test_masks_images_and_native_backends_are_played():
    assert any("masked" in sentence for _, sentence in [(f.grade, f.sentence) for f in check("Copy-masked-v0")])
    assert any("an image" in f.sentence for f in check("Copy-image-v0"))
    assert "Served by envpool" in check("CartPole-v1")[0].sentence


def test_a_module_that_is_not_there():
    with pytest.raises(UserError, match="nowhere:Env cannot be found: there is no module nowhere here"):
        list(check("nowhere:Env"))
    with pytest.raises(UserError, match=r"envs\.test_check has no Nothing"):
        list(check("envs.test_check:Nothing"))
