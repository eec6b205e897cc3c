"""What every benchmark writes beside its figures, and where."""

import json
import os
import platform
import subprocess
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
PACKAGES = (
    "torch",
    "gymnasium",
    "envpool",
    "mujoco",
    "numpy",
    "jax",
    "crazyflow",
    "stable-baselines3",
    "sbx-rl",
)


def provenance():
    """Commit, versions and machine."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"
    return {"commit": commit, "versions": versions, "machine": machine, "date": time.strftime("%Y-%m-%d")}


def random_rollout(num_envs):
    """A spec of HalfCheetah's sizes, and a rollout of 128 random steps of it."""
    import torch

    from lemniscate.spec import Box, ObservationPart, Spec
    from lemniscate.types import Rollout

    spec = Spec("x", (ObservationPart((), (17,)),), Box((-1.0,) * 6, (1.0,) * 6))
    no, obs = torch.zeros(128, num_envs, dtype=torch.bool), torch.randn(129, num_envs, 17)
    return spec, Rollout(obs[:-1], torch.randn(128, num_envs, 6), torch.randn(128, num_envs), obs[1:], no, no, ~no)


def append(name, row):
    """One more line of results/name.jsonl."""
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / f"{name}.jsonl").open("a") as file:
        file.write(json.dumps(row) + "\n")


def rows(name):
    """Every line of results/name.jsonl."""
    path = RESULTS / f"{name}.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
