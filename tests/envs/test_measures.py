"""Measures that environments give in `info`."""

import numpy as np
import torch

from lemniscate.envs.conversion import measured


def test_what_an_environment_did_not_give_is_nan_and_not_zero():
    info = {"distance": np.array([1.0, 2.0, 0.0]), "_distance": np.array([True, True, False])}
    info["final_info"] = {"distance": np.array([0.0, 5.0, 0.0]), "_distance": np.array([False, True, False])}
    found = measured(info, ("distance", "height"), 3, torch.device("cpu"))
    assert found.keys() == {"distance"}
    np.testing.assert_equal(found["distance"].numpy(), np.float32([1, 5, np.nan]))
