"""Randomness with names. One run seed; everything else is derived from it."""

import os
import random

import numpy as np
import torch
import torch.utils.deterministic as deterministic_mode


def set_seeds(seed: int, deterministic: bool = True) -> None:
    """Seed Python, NumPy and torch (CPU and every GPU); with `deterministic`, choose reproducible algorithms.

    JAX has no global generator: its keys are made from the seed that an environment is restarted with, and that seed
    is derived from this one (`derive`). XLA on a GPU is told to be deterministic if JAX has not started yet.

    Args:
        seed: 0 … 2³² − 1.
        deterministic: cuDNN's deterministic kernels without benchmarking, torch's deterministic algorithms (a warning
            where there is none), cuBLAS's fixed workspace.
    """
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002  (the legacy generator too: other people's environments use it)
    torch.manual_seed(seed)
    torch.cuda.manual_seed_all(seed)
    torch.backends.cudnn.deterministic = deterministic
    torch.backends.cudnn.benchmark = False
    torch.use_deterministic_algorithms(deterministic, warn_only=True)
    # It costs time, and nothing here reads uninitialized memory.
    deterministic_mode.fill_uninitialized_memory = False  # pyright: ignore[reportAttributeAccessIssue]
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        flags = os.environ.get("XLA_FLAGS", "")
        if "xla_gpu_deterministic_ops" not in flags:
            os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_deterministic_ops=true".strip()


def derive(seed: int, *path: int) -> int:
    """A seed in 0 … 2³¹ − 1 for one use, far from those of every other (seed, path): NumPy's SeedSequence."""
    return int(np.random.SeedSequence((seed, *path)).generate_state(1)[0] >> 1)


def generator(seed: int, device: torch.device, *path: int) -> torch.Generator:
    """A named random generator: part of `State`, hence of every checkpoint."""
    return torch.Generator(device).manual_seed(derive(seed, *path))
