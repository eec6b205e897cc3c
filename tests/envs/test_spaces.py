import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

import lemniscate as lem
from lemniscate.envs import registry
from lemniscate.envs.conversion import flatten_observation, physical_action, scale_action
from lemniscate.envs.spaces import ActionMasks, action_kind, is_image, notices, observation_parts
from lemniscate.envs.vector_view import action_space
from lemniscate.errors import UserError
from lemniscate.spec import Box, Discrete, Spec


@given(st.floats(-10, 10, width=32), st.floats(0.125, 10, width=32), st.floats(-3, 3, width=32))
def test_the_unit_interval_maps_onto_the_bounds(low, span, action):
    box = Box((low,), (low + span,))
    at = lambda a: scale_action(np.array([[a]]), box).item()  # noqa: E731
    assert at(-1.0) == pytest.approx(low, abs=1e-5)
    assert at(1.0) == pytest.approx(low + span, abs=1e-5)
    assert at(0.0) == pytest.approx(low + span / 2, abs=1e-5)
    assert low - 1e-5 <= at(action) <= low + span + 1e-5
    if -1 <= action <= 1:
        assert at(action) == pytest.approx(low + (action + 1) / 2 * span, abs=1e-5)


def test_an_infinite_bound_leaves_the_unit_and_a_policy_that_begins_around_zero_reaches_both_sides():
    box = Box((-math.inf, 10.0, -math.inf, -2.0), (math.inf, math.inf, -3.0, 2.0))
    at = lambda a: scale_action(np.full((1, 4), a), box)[0].tolist()  # noqa: E731
    assert at(0.0) == [0.0, 11.0, -4.0, 0.0]
    assert at(0.5) == [0.5, 11.5, -3.5, 1.0]
    assert at(5.0) == [5.0, 16.0, -3.0, 2.0]
    assert at(-5.0) == [-5.0, 10.0, -9.0, -2.0]


@given(
    st.floats(-100, 100), st.floats(0.01, 100), st.sampled_from([np.float32, np.float64]), st.floats(-3, 3, width=32)
)
def test_the_environment_accepts_every_action_that_is_sent(low, span, dtype, action):
    """Also at the ends, where rounding could lead outside."""
    space = spaces.Box(np.array([low], dtype), np.array([low + span], dtype), dtype=dtype)
    kind = action_kind(space, "x")
    for chosen in (-1.0, 1.0, action):
        assert space.contains(physical_action(np.array([[chosen]], dtype=np.float32), kind)[0])


def test_physical_actions():
    box = physical_action(np.array([[0.0, 2.0]]), Box((0.0, -4.0), (1.0, 4.0)))
    assert box.tolist() == [[0.5, 4.0]]
    assert physical_action(np.array([0, 2]), Discrete(3, start=-1)).tolist() == [-1, 1]


EVERY_ACTION = [
    spaces.Box(-2, 2, (3,)),
    spaces.Box(-2, 2, (2, 2)),
    spaces.Box(np.float32([-1, 0, -np.inf]), np.float32([3, np.inf, np.inf])),
    spaces.Discrete(4, start=-2),
    spaces.MultiDiscrete([2, 3], start=[5, -1]),
    spaces.MultiDiscrete([[2, 3], [4, 2]]),
    spaces.MultiBinary(4),
    spaces.MultiBinary([2, 3]),
]


@pytest.mark.parametrize("space", EVERY_ACTION, ids=str)
def test_what_a_policy_chooses_is_in_the_space(space):
    kind = action_kind(space, "x")
    rng = np.random.default_rng(0)
    for _ in range(20):
        if isinstance(space, spaces.Box):
            chosen = rng.normal(0, 2, (1, kind.size)).astype(np.float32)
        elif isinstance(space, spaces.Discrete):
            chosen = rng.integers(kind.n, size=1)
        else:
            chosen = rng.integers(getattr(kind, "nvec", 2), size=(1, getattr(kind, "n", None) or len(kind.nvec)))
        physical = physical_action(chosen, kind)[0]
        assert space.contains(
            physical if isinstance(space, spaces.Box | spaces.Discrete) else physical.astype(space.dtype)
        )


EVERY_OBSERVATION = [
    spaces.Box(-1, 1, (2, 3)),
    spaces.Box(0, 255, (4,), np.uint8),
    spaces.Box(-5, 5, (), np.int64),
    spaces.Discrete(3, start=1),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiBinary([2, 2]),
    spaces.Dict({"b": spaces.Box(-1, 1, (2,)), "a": spaces.Discrete(2)}),
    spaces.Tuple([spaces.Discrete(2), spaces.Dict({"z": spaces.Box(-1, 1, (1, 2)), "y": spaces.Tuple([spaces.Discrete(3)])})]),
]  # fmt: skip


@pytest.mark.parametrize("space", EVERY_OBSERVATION, ids=str)
def test_observations_are_flattened_as_gymnasium_does(space):
    """But by the batch, and as float32."""
    space.seed(0)
    parts = observation_parts(space, "x")
    samples = [space.sample() for _ in range(5)]
    from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

    batch = concatenate(space, samples, create_empty_array(space, 5))
    assert batch_space(space, 5).contains(batch)
    flat = flatten_observation(parts, batch)
    expected = np.stack([spaces.flatten(space, sample) for sample in samples])
    assert flat.dtype == np.float32
    assert flat.shape == (5, sum(part.size for part in parts))
    np.testing.assert_allclose(flat, expected.astype(np.float32))
    np.testing.assert_allclose(np.concatenate([flatten_observation(parts, s) for s in samples]), flat)


def test_a_number_outside_its_space_is_not_taken_for_another():
    parts = observation_parts(spaces.Discrete(3, start=1), "x")
    for wrong in (0, 4):
        with pytest.raises(ValueError, match=f"obs is {wrong}, which is not in its space"):
            flatten_observation(parts, wrong)


def test_parts_are_named_by_their_path():
    parts = observation_parts(EVERY_OBSERVATION[-1], "x")
    assert [(part.name, part.size) for part in parts] == [("0", 2), ("1/y/0", 3), ("1/z", 2)]


def test_images_stay_bytes():
    image = spaces.Box(0, 255, (4, 5, 3), np.uint8)
    assert is_image(image)
    assert not is_image(spaces.Box(0, 255, (60,), np.uint8))
    assert not is_image(spaces.Box(0, 1, (4, 5, 3), np.float32))
    flat = flatten_observation(observation_parts(image, "x"), image.sample()[None], image=True)
    assert flat.dtype == np.uint8
    assert flat.shape == (1, 60)


def test_a_grey_picture_of_two_dimensions_is_an_image_and_a_small_or_narrow_table_of_bytes_is_not():
    (part,) = observation_parts(spaces.Box(0, 255, (20, 24), np.uint8), "x")
    assert (part.shape, part.own_shape, part.axes, part.image) == ((20, 24, 1), (20, 24), (0, 1), True)
    for table in (spaces.Box(0, 255, (16, 40), np.uint8), spaces.Box(0, 9, (20, 24), np.uint8)):
        assert not is_image(table)


def test_pictures_in_a_dictionary_are_laid_out_as_alone_and_keep_their_values():
    alone = spaces.Box(0, 255, (3, 20, 24), np.uint8)
    space = spaces.Dict({"camera": alone, "joints": spaces.Box(-1, 1, (2,)), "inner": spaces.Tuple((alone,))})
    parts, sample = observation_parts(space, "x"), space.sample()
    assert [(part.name, part.image) for part in parts] == [("camera", True), ("inner/0", True), ("joints", False)]
    flat, one = flatten_observation(parts, sample), flatten_observation(observation_parts(alone, "x"), sample["camera"])
    assert flat.dtype == np.float32
    np.testing.assert_array_equal(flat[:, :1440], one)
    np.testing.assert_array_equal(flat[:, -2:], sample["joints"][None])


def test_other_spaces_get_a_sentence():
    with pytest.raises(UserError, match="myenv observes a Sequence, whose size is not fixed"):
        observation_parts(spaces.Sequence(spaces.Discrete(2)), "myenv")
    with pytest.raises(UserError, match="what can be acted in is"):
        action_kind(spaces.Dict({"a": spaces.Discrete(2)}), "myenv")


def test_a_mask_that_is_given_for_some_environments_is_theirs_alone():
    masks = ActionMasks(Spec("Env-v0", (), Discrete(2, masked=True)), 3)
    info = {"action_mask": np.array([[0, 1], [1, 0], [0, 1]]), "_action_mask": np.array([False, True, True])}
    flat, everyone = np.zeros((3, 1)), np.ones(3, dtype=bool)
    assert masks.append_to(flat, flat, info).tolist() == [[0, 1, 1], [0, 1, 0], [0, 0, 1]]
    assert masks.append_to(flat, flat, {}).tolist() == [[0, 1, 1], [0, 1, 0], [0, 0, 1]], "until another is given"
    assert masks.append_to(flat, flat, {"action_mask": None}).tolist() == [[0, 1, 1]] * 3, "None permits everything"
    masks.append_to(flat, flat, info)
    masks.require_choice(masks.append_to(flat, flat, {}), everyone)
    none_left = masks.append_to(flat, flat, {"action_mask": np.array([[1, 1], [1, 1], [0, 0]])})
    masks.require_choice(none_left, np.array([True, True, False]))
    with pytest.raises(UserError, match="rules out every action of environment 2"):
        masks.require_choice(none_left, everyone)


def test_whole_numbers_are_rounded_and_clipped():
    kind = action_kind(spaces.Box(np.array([0, -3]), np.array([4, 3]), dtype=np.int8), "myenv")
    rows = physical_action(np.float32([[-1, -1], [0, 0.1], [0.3, 0.6], [9, 9]]), kind)
    assert rows.dtype == np.int8
    assert rows.tolist() == [[0, -3], [2, 0], [3, 2], [4, 3]]
    assert scale_action(np.float32([[0.2]]), Box((0.0,), (1.0,))).item() == pytest.approx(0.6)


@pytest.mark.parametrize("bound", [np.inf, 1e300, float(np.finfo(np.float32).max)])
def test_the_largest_number_is_no_bound(bound):
    kind = action_kind(spaces.Box(-bound, bound, (1,), np.float64), "myenv")
    assert (kind.low, kind.high) == ((-np.inf,), (np.inf,))
    whole = action_kind(spaces.Box(-np.inf, np.inf, (1,), np.int64), "myenv")
    assert (whole.low, whole.high) == ((-np.inf,), (np.inf,))
    assert "have no bound" in notices(Spec("myenv", (), kind))[0]
    with pytest.raises(
        UserError, match=r"has actions without bounds.*give its Box a finite low and high, of everyday size"
    ):
        Spec("myenv", (), whole).bounded_box()


@pytest.mark.parametrize(
    ("space", "sentence"),
    [
        (
            spaces.Discrete(10**9),
            r"myenv observes Discrete\(1000000000\), whose 1,000,000,000 choices are each an input",
        ),
        (spaces.MultiDiscrete([10**6, 2]), r"whose 1,000,002 choices"),
        (spaces.Dict({"a": spaces.Box(0, 1, (0,))}), "observes nothing: its observation_space, Dict.*, has no numbers"),
        (spaces.Tuple([]), "observes nothing"),
    ],
)
def test_a_space_without_numbers_or_with_too_many_is_named(space, sentence):
    with pytest.raises(UserError, match=sentence):
        observation_parts(space, "myenv")


@pytest.mark.parametrize(
    ("space", "sentence"),
    [
        (spaces.Discrete(10**9), r"myenv acts by Discrete\(1000000000\), whose 1,000,000,000 choices"),
        (spaces.MultiDiscrete([2**31, 2**31]), r"whose 4,294,967,296 choices"),
        (spaces.Box(-1, 1, (0,)), "myenv has no actions: its action_space is Box"),
        (spaces.MultiDiscrete(np.zeros((0,), dtype=np.int64)), "myenv has no actions"),
    ],
)
def test_actions_that_nothing_can_choose_from_are_named(space, sentence):
    with pytest.raises(UserError, match=sentence):
        action_kind(space, "myenv")


def test_a_part_without_numbers_is_left_out():
    space = spaces.Dict({"a": spaces.Box(0, 1, (0,)), "b": spaces.Box(0, 1, (2,))})
    (part,) = observation_parts(space, "myenv")
    assert part.path == ("b",)


class Far(gym.Env):
    """Numbers of 64 bits, whose changes float32 holds or not."""

    action_space = spaces.Discrete(2)

    def __init__(self, start, by, kind):
        self.start, self.by = np.array(start, kind), np.array(by, kind)
        self.observation_space = spaces.Dict({"far": spaces.Box(-np.inf, np.inf, self.start.shape, kind)})

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return {"far": self.start}, {}

    def step(self, action):
        self.t += 1
        return {"far": self.start + self.t * self.by}, 0.0, False, self.t == 20, {}


@pytest.mark.parametrize(
    ("start", "by", "kind", "lost"),
    [
        ([1.7e9, 0], [1, 1], np.float64, True),
        ([0.0, 5_813_000], [1, 0.05], np.float64, True),
        ([2**40], [1], np.int64, True),
        ([5_813_000.0], [1.0], np.float64, False),
        ([1.25], [1e-9], np.float64, False),
        ([1.7e9], [1e4], np.float64, False),
        ([1e4], [0.1], np.float32, False),
    ],
)
def test_digits_that_float32_loses_are_said(start, by, kind, lost):
    env = registry.make(lambda: Far(start, by, kind), 2)
    env.restart(0)
    for _ in range(200):
        env.step(torch.zeros(2, dtype=torch.int64))
    assert len(env.backend.notices) == lost
    assert all(
        "too large for the digits of float32: 21 different values became" in said for said in env.backend.notices
    )


@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async"])
@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint8])
def test_a_choice_is_of_the_type_of_its_space(kind, backend):
    class Strict(gym.Env):
        observation_space = spaces.Box(-1, 1, (2,), np.float32)
        action_space = spaces.Discrete(3, start=2, dtype=kind)

        def reset(self, *, seed=None, options=None):
            return np.zeros(2, np.float32), {}

        def step(self, action):
            return np.zeros(2, np.float32), float(self.action_space.contains(action)), False, True, {}

    env = registry.make(Strict, 2, backend=backend)
    env.restart(0)
    assert env.step(torch.tensor([0, 2])).reward.tolist() == [1, 1]
    env.close()
    assert lem.evaluate(lambda obs: 3, Strict, episodes=2).mean_return == 1
    assert action_space(env.spec.action) == Strict.action_space
