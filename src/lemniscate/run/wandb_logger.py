"""The logger of Weights & Biases (extra `wandb`)."""

import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from lemniscate.envs.vec_env import Episodes
from lemniscate.run.loggers import NO_EPISODES, Metrics
from lemniscate.system.console import say
from lemniscate.system.files import open_regular, replace_file


class WeightsAndBiases:
    """A run of Weights & Biases (extra `wandb`).

    Without a key or a network it is recorded offline, and a line says how to upload it later. `WANDB_PROJECT`,
    `WANDB_NAME`, `WANDB_TAGS` and `WANDB_MODE` of the environment have their usual meaning.
    """

    def __init__(self, path: Path, config: Mapping[str, Any], step: int) -> None:
        self._wandb: Any = import_module("wandb")
        given, mode = os.environ, os.environ.get("WANDB_MODE", "online")
        if mode == "online" and not given.get("WANDB_API_KEY") and not self._wandb.login(prompt=False):
            mode = "offline"
        options = {
            "project": given.get("WANDB_PROJECT", "lemniscate"),
            "name": given.get("WANDB_NAME", path.name),
            "tags": [str(config["env"]), *filter(None, given.get("WANDB_TAGS", "").split(","))],
            "config": dict(config),
            "dir": str(path),
            "id": _stable_id(path),
            "settings": self._wandb.Settings(init_timeout=20, silent=True),
        }
        try:
            self._run = self._wandb.init(mode=mode, resume="allow" if mode == "online" else None, **options)
        except (self._wandb.errors.CommError, self._wandb.errors.AuthenticationError):
            mode = "offline"
            self._wandb.teardown()
            self._run = self._wandb.init(mode=mode, resume=None, **options)
        if mode == "offline":
            say(f"W&B records offline; upload later with: wandb sync {path}/wandb/offline-run-*")

    def write(self, step: int, metrics: Metrics, episodes: Episodes = NO_EPISODES) -> None:
        """Log one row."""
        self._run.log(dict(metrics), step=step)

    def close(self, pictures: list[Path]) -> None:
        """Upload the pictures and finish."""
        images = {file.stem: self._wandb.Image(str(file)) for file in pictures if file.suffix == ".png"}
        if images:
            self._run.log(images)
        self._run.finish()


def _stable_id(path: Path) -> str:
    """The W&B id of a run directory, kept in a file so that a resumed run continues its own curve."""
    file = path / "wandb-id"
    if not os.path.lexists(file):
        replace_file(file, os.urandom(6).hex().encode())
    with open_regular(file) as text:
        return text.read(100).decode(errors="replace")
