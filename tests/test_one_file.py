"""PPO in one file against the library's: the same bits from the same settings."""

import ast
import runpy
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import lemniscate as lem

FILE = Path(__file__).parents[1] / "examples" / "ppo_in_one_file.py"
SAME = {
    # what the file does without, and its activation; no checkpoint before the end, where environments would restart
    "backend": "gymnasium",
    "compile": "off",
    "desired_kl": None,
    "recompute_advantages": False,
    "normalize_observations": False,
    "scale_rewards": False,
    "activation": "relu",
    "progress": False,
}
CASES = {
    "defaults": {"total_steps": 2_048},
    "time limits and three actions": {"env": "MountainCar-v0", "num_envs": 4, "total_steps": 2_048, "seed": 5},
    "one environment, many epochs": {
        "num_envs": 1,
        "num_steps": 64,
        "minibatch_size": 16,
        "epochs": 8,
        "gamma": 0.9,
        "total_steps": 320,
    },
    "hardly clipped": {"clip": 10.0, "max_grad_norm": 1e9, "entropy_coef": 0.0, "total_steps": 2_048, "seed": 3},
}


@pytest.fixture(scope="module")
def one_file():
    return SimpleNamespace(**runpy.run_path(str(FILE)))


@pytest.mark.parametrize("fields", CASES.values(), ids=CASES)
def test_the_parameters_end_in_the_same_bits(fields, one_file, tmp_path, capsys):
    config = one_file.Config(**fields)
    networks = one_file.train(config)
    settings = asdict(config) | SAME | {"checkpoint_every": config.total_steps}
    run = lem.train("ppo", run=tmp_path / "run", **settings)
    mine, theirs = ([*module.parameters()] for module in (networks, run.policy.networks))
    assert all(torch.equal(a, b) for a, b in zip(mine, theirs, strict=True))


def test_it_stands_alone_and_is_short():
    text = FILE.read_text()
    imports = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]
    modules = {alias.name for node in imports if isinstance(node, ast.Import) for alias in node.names}
    modules |= {node.module for node in imports if isinstance(node, ast.ImportFrom)}
    assert {name.partition(".")[0] for name in modules} == {"dataclasses", "gymnasium", "numpy", "sys", "torch"}
    assert len(text.splitlines()) <= 150


def test_it_learns(one_file, capsys):
    one_file.train(one_file.Config(total_steps=10_240))
    returns = [float(line.split("return ")[1].split()[0]) for line in capsys.readouterr().out.splitlines()]
    assert len(returns) == 10
    assert np.mean(returns[-3:]) > 1.3 * np.mean(returns[:3])
