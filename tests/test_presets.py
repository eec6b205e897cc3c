"""Presets are chosen by environment and by name."""

import pytest

from lemniscate import presets
from lemniscate.errors import UserError
from lemniscate.presets.on_policy import FIGURE_EIGHT


@pytest.mark.parametrize("algorithm", presets.PRESETS)
def test_each_environment_gets_its_own_unasked(algorithm):
    assert presets.PRESETS[algorithm][0].name == "default"
    for preset in presets.PRESETS[algorithm][1:]:
        name, config = presets.choose(algorithm, preset.config.env, None)
        assert config.env == preset.config.env
        assert name != "default"
        assert preset.source
        assert preset.date
    assert presets.choose(algorithm, "Acrobot-v1", None)[0] == "default"


def test_one_name_may_serve_several_environments():
    assert presets.choose("ppo", "LunarLander-v3", "course")[1].hidden == (128, 128)
    assert presets.choose("ppo", FIGURE_EIGHT, "course")[1].num_envs == 1024
    assert presets.choose("ppo", None, "course")[1].env == FIGURE_EIGHT
    assert presets.choose("ppo", "LunarLander-v3", None)[0] == "lunar-lander"


def test_an_unknown_one_is_named():
    with pytest.raises(UserError, match="did you mean hopper"):
        presets.choose("ppo", "Hopper-v5", "hoper")
