"""Tuned Configs, as Python values, each with its source and date.

`default` is the Config of an algorithm as it stands: an environment without a preset of its own gets it.
"""

from pathlib import Path

from lemniscate.algos import find
from lemniscate.errors import unknown_name
from lemniscate.presets.off_policy import DDPG, SAC, TD3
from lemniscate.presets.on_policy import A2C, PPO, REINFORCE, REPPO, TRPO
from lemniscate.presets.preset import Preset, read_preset
from lemniscate.run.config import RunConfig

PRESETS: dict[str, list[Preset]] = {
    "reinforce": REINFORCE,
    "a2c": A2C,
    "trpo": TRPO,
    "ppo": PPO,
    "reppo": REPPO,
    "ddpg": DDPG,
    "td3": TD3,
    "sac": SAC,
}


def of(algorithm: str) -> list[Preset]:
    """The presets of an algorithm; those of a module of one's own are its `PRESETS`, if it has any."""
    return PRESETS[algorithm] if algorithm in PRESETS else getattr(find(algorithm), "PRESETS", [])


def names(algorithm: str) -> list[str]:
    """The names of the presets, each once."""
    return ["default", *dict.fromkeys(preset.name for preset in of(algorithm))]


def best(algorithm: str, env_id: str | None) -> str:
    """The preset that an environment gets unless another is named: the first of its own, or the default."""
    own = (preset.name for preset in of(algorithm) if preset.config.env == env_id)
    return next(own, "default")


def choose(algorithm: str, env_id: str | None, name: str | None) -> tuple[str, RunConfig]:
    """The preset asked for, by name or by its file, or the best known for the environment, or the default.

    Returns (its name, its Config).

    Where several environments have a preset of one name, the environment decides. The Config's `env` is `env_id` if one
    is given. Raises `UserError` with the nearest names for an unknown preset.
    """
    name = best(algorithm, env_id) if name is None else name
    if not isinstance(name, str):
        raise unknown_name("preset", name, names(algorithm))
    if name.endswith(".json"):
        config = read_preset(Path(name), algorithm).config
        return Path(name).stem, config if env_id is None else config.replace(env=env_id)
    named = [preset.config for preset in of(algorithm) if preset.name == name]
    if name == "default":
        named = [find(algorithm).Config()]
    if not named:
        raise unknown_name("preset", name, names(algorithm))
    config = next((config for config in named if config.env == env_id), named[0])
    return name, config if env_id is None else config.replace(env=env_id)
