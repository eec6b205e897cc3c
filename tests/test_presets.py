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
    assert presets.choose("ddpg", "Hopper-v5", None)[0] == "hopper"


def test_the_course_has_the_settings_of_its_notebook():
    """Written out, lest a default that changes should change the course."""
    config = presets.choose("ddpg", "Hopper-v5", "course")[1]
    assert (config.total_steps, config.learning_starts, config.buffer_size) == (1_000_000, 25_000, 1_000_000)
    assert (config.batch_size, config.hidden, config.critic_hidden) == (256, (256, 256), (256, 256))
    assert (config.actor_learning_rate, config.critic_learning_rate, config.final_learning_rate) == (3e-4, 3e-4, 1.0)
    assert (config.gamma, config.tau, config.policy_delay) == (0.99, 0.005, 2)
    assert (config.noise, config.noise_std) == ("white", 0.1)
    assert (config.num_envs, config.num_updates, config.update_every) == (1, 1, 1)
    assert (config.architecture, config.activation, config.normalize_observations) == ("mlp", "relu", False)


def test_an_unknown_one_is_named():
    with pytest.raises(UserError, match="did you mean hopper"):
        presets.choose("ppo", "Hopper-v5", "hoper")
