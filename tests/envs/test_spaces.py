import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lemniscate.envs.spaces import action_kind, flatten_observation, observation_layout, physical_action, scale_action
from lemniscate.errors import UserError
from lemniscate.types import Box, Discrete


@given(st.floats(-10, 10), st.floats(0.1, 10), st.floats(-3, 3))
def test_the_unit_interval_maps_onto_the_bounds(low, span, action):
    low, high = torch.tensor([low], dtype=torch.float64), torch.tensor([low + span], dtype=torch.float64)
    at = lambda a: scale_action(torch.tensor([a], dtype=torch.float64), low, high)  # noqa: E731
    torch.testing.assert_close(at(-1.0), low)
    torch.testing.assert_close(at(1.0), high)
    torch.testing.assert_close(at(0.0), (low + high) / 2)
    assert low - 1e-9 <= at(action) <= high + 1e-9
    if -1 <= action <= 1:
        torch.testing.assert_close(at(action), low + (action + 1) / 2 * span)


def test_an_infinite_bound_is_not_scaled_to():
    low, high = torch.tensor([-math.inf, 0.0, -2.0]), torch.tensor([math.inf, math.inf, 2.0])
    scaled = scale_action(torch.tensor([5.0, -5.0, 0.5]), low, high)
    assert scaled.tolist() == [5.0, 0.0, 1.0]


def test_physical_actions():
    box = physical_action(torch.tensor([[0.0, 2.0]]), Box((0.0, -4.0), (1.0, 4.0)))
    assert box.tolist() == [[0.5, 4.0]]
    assert physical_action(torch.tensor([0, 2]), Discrete(3, start=-1)).tolist() == [-1, 1]


def test_a_dict_is_flattened_in_the_order_of_its_layout():
    space = gym.spaces.Dict({"b": gym.spaces.Box(-1, 1, (2,)), "a": gym.spaces.Box(-1, 1, (1, 2))})
    obs = {"a": np.array([[[1.0, 2.0]]]), "b": np.array([[3.0, 4.0]])}
    layout = observation_layout(space, "x")
    flat = flatten_observation(space, obs)
    expected = np.concatenate([obs[name].reshape(1, -1) for name, _ in layout], axis=1)
    assert dict(layout) == {"a": 2, "b": 2}
    assert flat.tolist() == expected.tolist()


def test_a_discrete_observation_is_one_hot():
    space = gym.spaces.Discrete(3, start=1)
    assert flatten_observation(space, np.array([1, 3])).tolist() == [[1, 0, 0], [0, 0, 1]]


def test_other_spaces_get_a_sentence():
    with pytest.raises(UserError, match="myenv observes Tuple"):
        observation_layout(gym.spaces.Tuple([gym.spaces.Discrete(2)]), "myenv")
    with pytest.raises(UserError, match="myenv takes"):
        action_kind(gym.spaces.MultiBinary(3), "myenv")
