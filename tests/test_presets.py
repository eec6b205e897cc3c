"""Presets are chosen by environment and by name."""

import subprocess
import sys

import pytest

from lemniscate import presets
from lemniscate.algos import ALGORITHMS, find, ppo
from lemniscate.errors import UserError
from lemniscate.presets import Preset, read_preset, read_toml

FIGURE_EIGHT = "DroneFigureEightTrajectory-v0"


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_each_environment_gets_its_own_unless_another_is_named(algorithm):
    for preset in presets.of(algorithm):
        name, config = presets.choose(algorithm, preset.config.env, None)
        assert config.env == preset.config.env
        assert name != "default"
        assert preset.source
        assert preset.date


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_unknown_environment_gets_the_defaults_of_the_config(algorithm):
    for name in (None, "default"):
        config = find(algorithm).Config(env="MountainCar-v0")
        assert presets.choose(algorithm, "MountainCar-v0", name) == ("default", config)
    assert presets.names(algorithm)[0] == "default"


def test_the_settings_of_the_paper_are_a_preset():
    config = presets.choose("ppo", "Walker2d-v5", "paper")[1]
    assert config.env == "Walker2d-v5"
    assert (config.num_steps, config.epochs, config.minibatch_size, config.learning_rate) == (256, 10, 64, 3e-4)
    assert (config.gamma, config.gae_lambda, config.clip, config.desired_kl) == (0.99, 0.95, 0.2, None)


def test_one_name_may_be_of_several_environments():
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
    assert (config.action_noise, config.noise_std) == ("white", 0.1)
    assert (config.num_envs, config.num_updates, config.update_every) == (1, 1, 1)
    assert (config.network, config.activation, config.normalize_observations) == ("mlp", "relu", False)


def test_an_unknown_name_is_an_error_with_the_nearest_one():
    with pytest.raises(UserError, match="did you mean hopper"):
        presets.choose("ppo", "Hopper-v5", "hoper")


def test_a_stored_preset_is_ready_to_be_pasted_whatever_its_provenance(tmp_path):
    config = ppo.Config(env="CartPole-v1", hidden=(16,), gamma=0.98, network="layer_norm", desired_kl=None)
    config = config.replace(env_kwargs={"gravity": None, "name": 'the "second"'}, wrappers=("module:name(key=1)",))
    stored = Preset("mine", config, "lemniscate tune: " + ", ".join(["gamma=.9:.999"] * 40), "2026-11")
    stored.write(tmp_path / "preset.json", "ppo")
    text = read_preset(tmp_path / "preset.json", "ppo").to_toml()
    assert read_toml("ppo", f"{text}\n{text}") == [stored, stored]


def test_only_the_presets_of_the_algorithm_that_is_chosen_are_read():
    program = (
        "import sys; from lemniscate import presets; presets.choose('ppo', 'Ant-v5', None);"
        "print(sorted(name for name in sys.modules if name.startswith('lemniscate.algos.')))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "['lemniscate.algos.ppo']\n"


def test_a_stored_preset_is_chosen_by_its_file(tmp_path):
    config = ppo.Config(env="CartPole-v1", gamma=0.98)
    file = tmp_path / "preset.json"
    Preset("mine", config, "by hand", "2026-11").write(file, "ppo")
    assert presets.choose("ppo", None, str(file))[1] == config
    assert presets.choose("ppo", "MountainCar-v0", str(file))[1] == config.replace(env="MountainCar-v0")
    with pytest.raises(UserError, match="is a preset of ppo, not of sac"):
        presets.choose("sac", None, str(file))
    with pytest.raises(UserError, match=r"There is no preset: .*elsewhere\.json does not exist"):
        presets.choose("ppo", None, str(tmp_path / "elsewhere.json"))
