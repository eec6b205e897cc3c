"""Shared fixtures. Everything is small: one thread, few environments, float64 where an oracle is compared."""

import os
from collections import Counter
from pathlib import Path

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SCIPY_ARRAY_API", "1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# A drone's two programs take 20 s to compile, and each process of the tests would compile them anew. Programs are kept
# between runs, too: what they are made of is part of their name. XLA's own caches hold more than one process may share.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")  # half the time to compile
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
os.environ.setdefault("JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES", "none")

import pytest
import torch
from hypothesis import settings

import toy  # noqa: F401  (registers Countdown-v0 and Matching-v0)

settings.register_profile(
    "lemniscate",
    deadline=None,  # no test waits for a clock
    report_multiple_bugs=False,
    derandomize="HYPOTHESIS_RANDOM" not in os.environ,  # HYPOTHESIS_RANDOM=1 make test looks further
    database=None,
)
settings.load_profile("lemniscate")


def pytest_collection_modifyitems(items):
    """Of the cases of a test that is marked `one_in(n)`, all but the first of each n stand beside one of their kind."""
    seen = Counter()
    for item in items:
        if mark := item.get_closest_marker("one_in"):
            if seen[item.function] % mark.args[0]:
                item.add_marker(pytest.mark.long)
            seen[item.function] += 1


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)  # what a test draws does not hang on those before it


@pytest.fixture
def rng():
    return torch.Generator().manual_seed(0)


def tiny(env="Countdown-v0", **fields):
    """A Config that trains in a moment."""
    from lemniscate.algos.ppo import Config

    defaults = {
        "env": env,
        "num_envs": 4,
        "num_steps": 8,
        "total_steps": 256,
        "epochs": 2,
        "minibatch_size": 16,
        "hidden": (16,),
        "evaluate_episodes": 4,
    }
    return Config(**{**defaults, **fields})


def tiny_fields(env="Countdown-v0", **fields):
    """The same as keyword arguments of `lem.train`."""
    config = tiny(env, **fields)
    return {name: getattr(config, name) for name in config.names() if name != "env"}


def tiny_off_policy(**fields):
    """Keyword arguments of `lem.train` for an off-policy algorithm, over in a moment."""
    defaults = {
        "num_envs": 2,
        "log_every": 8,
        "total_steps": 256,
        "learning_starts": 32,
        "buffer_size": 100,  # less than the run: the ring goes round
        "batch_size": 16,
        "hidden": (16,),
        "critic_hidden": (16,),
        "evaluate_episodes": 2,
    }
    return {**defaults, **fields}
