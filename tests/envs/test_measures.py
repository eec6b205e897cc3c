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


def test_what_is_no_mask_is_none_and_a_final_info_is_of_those_that_ended():
    info = {"a": np.array([1.0, 2.0]), "_a": "x", "b": {"c": np.array([3.0, 4.0])}, "_b": [True, False]}
    info |= {"final_info": {"a": np.array([0.0, 9.0])}, "_final_info": np.array([False, True])}
    found = {name: values.tolist() for name, values in measured(info, (), 2, torch.device("cpu")).items()}
    np.testing.assert_equal(found, {"info/a": [1, 9], "info/b/c": [3, np.nan]})


def test_of_a_dictionary_that_some_gave_only_theirs_count():
    """As Gymnasium's RecordEpisodeStatistics of vectors has them: zeros where no episode ended."""
    info = {"episode": {"r": np.array([0.0, 7.0]), "_l": np.array([True, False]), "l": np.array([3, 0])}}
    info["_episode"] = np.array([False, True])
    found = {name: values.tolist() for name, values in measured(info, (), 2, torch.device("cpu")).items()}
    np.testing.assert_equal(found, {"info/episode/r": [np.nan, 7], "info/episode/l": [3, np.nan]})
