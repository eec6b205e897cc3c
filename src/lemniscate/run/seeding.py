"""Random generators and their seeds, which are all derived from the one seed of the run."""

import os
import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext

import numpy as np
import torch
import torch.utils.deterministic as deterministic_mode

from lemniscate.errors import UserError, shown


def set_seeds(seed: int, deterministic: bool = True) -> None:
    """Seed Python, NumPy and torch (CPU and every GPU); with `deterministic`, choose reproducible algorithms.

    JAX has no global generator: its keys are made from the seed that an environment is restarted with, and that seed
    is derived from this one (`derive`). XLA on a GPU is told to be deterministic if JAX has not started yet.

    Args:
        seed: 0 … 2³² − 1; another raises `UserError`.
        deterministic: cuDNN's deterministic kernels without benchmarking, torch's deterministic algorithms (a warning
            where there is none), cuBLAS's fixed workspace.
    """
    number = getattr(seed, "tolist", lambda: seed)()  # of NumPy's and torch's scalars
    if type(number) not in (int, float) or not 0 <= number < 2**32 or number % 1:
        raise UserError(f"seed must be a whole number from 0 to {2**32 - 1:,}, not {shown(seed)}.")
    seed_globals(int(number))
    torch.backends.cudnn.deterministic = deterministic
    torch.backends.cudnn.benchmark = False
    # As `use_deterministic_algorithms` with warn_only, which also imports the compiler; `Compiled` tells it itself.
    torch.set_deterministic_debug_mode("warn" if deterministic else "default")
    # It costs time, and nothing here reads uninitialized memory.
    deterministic_mode.fill_uninitialized_memory = False  # pyright: ignore[reportAttributeAccessIssue]
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        flags = os.environ.get("XLA_FLAGS", "")
        if "xla_gpu_deterministic_ops" not in flags:
            os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_deterministic_ops=true".strip()


@contextmanager
def torch_defaults(grad: bool = True) -> Iterator[None]:
    """The defaults of torch itself while a verb works, whatever its caller has set; afterwards the caller's again.

    These are float32, the CPU, no autocast, and gradients on (off without `grad`). The number of threads, which a verb
    may change, is restored.
    """
    dtype, device, threads = torch.get_default_dtype(), torch.get_default_device(), torch.get_num_threads()
    torch.set_default_dtype(torch.float32)
    # To name a device costs time at every call of torch, so it is named only where the caller has another one.
    on_cpu = nullcontext() if device.type == "cpu" else torch.device("cpu")
    try:
        exact = torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False)
        with on_cpu, torch.inference_mode(False), torch.set_grad_enabled(grad), exact[0], exact[1]:
            yield
    finally:
        torch.set_default_dtype(dtype)
        if torch.get_num_threads() != threads:
            torch.set_num_threads(threads)


def seed_globals(seed: int) -> None:
    """Seed the global generators: Python's, NumPy's legacy one, torch's on every device."""
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002  (users' environments may draw from it)
    torch.manual_seed(seed)
    torch.cuda.manual_seed_all(seed)


def derive(seed: int, *path: int) -> int:
    """A seed in 0 … 2³¹ − 1, unrelated to that of any other (seed, path); by NumPy's SeedSequence."""
    return int(np.random.SeedSequence(seed, spawn_key=path).generate_state(1)[0] >> 1)


def generator(seed: int, device: torch.device, *path: int) -> torch.Generator:
    """A random generator of a run's own, seeded with `derive(seed, *path)`; as a field of `State` it is saved."""
    return torch.Generator(device).manual_seed(derive(seed, *path))


class Generators:
    """The random generators of a run, each with a stream of its own of the run's seed; the same in every process."""

    def __init__(self, seed: int, device: torch.device) -> None:
        self.action = generator(seed, device, 2)
        """of the policy's actions, and of the noise in losses"""
        self.minibatch = generator(seed, device, 3)
        """of the rows of minibatches"""

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The state of each generator."""
        return {name: stream.get_state() for name, stream in vars(self).items()}

    def load_state_dict(self, states: Mapping[str, torch.Tensor]) -> None:
        """Restore what `state_dict` returned."""
        for name, stream in vars(self).items():
            stream.set_state(states[name])
