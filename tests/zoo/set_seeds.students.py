# === right: the course's, line by line
import random

import numpy as np
import torch


def set_seeds(seed):
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    torch.cuda.manual_seed(seed)
    torch.cuda.manual_seed_all(seed)
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.benchmark = False

# === wrong: NumPy is not seeded | numpy
# --- instead of
    np.random.seed(seed)
# --- here

# === wrong: Python's random is not seeded | python|random
# --- instead of
    random.seed(seed)
# --- here

# === wrong: torch is not seeded, CUDA alone is | torch|manual_seed
# --- instead of
    torch.manual_seed(seed)
# --- here

# === wrong: cuDNN's flags are missing | cudnn|deterministic|benchmark
# --- instead of
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.benchmark = False
# --- here

# === wrong: benchmark is left on | benchmark
# --- instead of
    torch.backends.cudnn.benchmark = False
# --- here
    torch.backends.cudnn.benchmark = True

# === wrong: a fixed seed, 42, in place of the one given | fixed|42|given|seed|ignor|same
# --- instead of
def set_seeds(seed):
# --- here
def set_seeds(seed):
    seed = 42

# === wrong: a new generator is made and thrown away: NumPy's global one is not seeded | numpy
# --- instead of
    np.random.seed(seed)
# --- here
    np.random.default_rng(seed)

# === wrong: a typo: torch.manual_seeds | attribute|manual_seed|error|name
# --- instead of
    torch.manual_seed(seed)
# --- here
    torch.manual_seeds(seed)

# === right: extra optional arguments, strict algorithms only where asked for
import os
import random as py_random

import numpy
import torch as th


def set_seeds(seed: int, strict: bool = False, verbose: bool = False) -> None:
    """Seed everything."""
    os.environ["PYTHONHASHSEED"] = str(seed)
    for seeder in (py_random.seed, numpy.random.seed, th.manual_seed):
        seeder(seed)
    if th.cuda.is_available():
        th.cuda.manual_seed_all(seed)
    th.backends.cudnn.benchmark, th.backends.cudnn.deterministic = False, True
    if strict:
        th.use_deterministic_algorithms(True)
    if verbose:
        print(f"seeded with {seed}")

# === wrong: NumPy and torch get other seeds than the given one | seed|given|numpy|torch|other
# --- instead of
    for seeder in (py_random.seed, numpy.random.seed, th.manual_seed):
        seeder(seed)
# --- here
    for k, seeder in enumerate((py_random.seed, numpy.random.seed, th.manual_seed)):
        seeder(seed * k)

# === wrong: deterministic is set on a wrong name, so it does nothing | deterministic|cudnn
# --- instead of
    th.backends.cudnn.benchmark, th.backends.cudnn.deterministic = False, True
# --- here
    th.backends.cudnn.benchmark, th.backends.cudnn.is_deterministic = False, True

# === wrong: the two flags are exchanged | deterministic|benchmark|cudnn
# --- instead of
    th.backends.cudnn.benchmark, th.backends.cudnn.deterministic = False, True
# --- here
    th.backends.cudnn.benchmark, th.backends.cudnn.deterministic = True, False

# === right: a loop over libraries that are imported inside, and a generator that is returned
def set_seeds(seed):
    import importlib

    for module, function in (("random", "seed"), ("numpy.random", "seed"), ("torch", "manual_seed"), ("torch.cuda", "manual_seed_all")):
        getattr(importlib.import_module(module), function)(int(seed))
    cudnn = importlib.import_module("torch.backends.cudnn")
    setattr(cudnn, "deterministic", True)
    setattr(cudnn, "benchmark", False)
    return importlib.import_module("numpy").random.default_rng(seed)

# === wrong: torch is missing in the list | torch
# --- instead of
    for module, function in (("random", "seed"), ("numpy.random", "seed"), ("torch", "manual_seed"), ("torch.cuda", "manual_seed_all")):
# --- here
    for module, function in (("random", "seed"), ("numpy.random", "seed")):

# === wrong: the seeds are set when the file is loaded, not when the function is called | seed|random|numpy|torch|ignor|given
def set_seeds(seed):
    import importlib

    cudnn = importlib.import_module("torch.backends.cudnn")
    setattr(cudnn, "deterministic", True)
    setattr(cudnn, "benchmark", False)
    return importlib.import_module("numpy").random.default_rng(seed)

# === right: by torch.random, a static method of a class of utilities, with the state of NumPy set
import random

import numpy as np
import torch
from torch.backends import cudnn


class Reproducibility:
    FLAGS = {"deterministic": True, "benchmark": False}

    @staticmethod
    def set_seeds(seed: int = 0):
        random.setstate(random.Random(seed).getstate())
        np.random.set_state(np.random.RandomState(seed).get_state())
        torch.random.manual_seed(seed)
        torch.cuda.manual_seed_all(seed)
        for name, value in Reproducibility.FLAGS.items():
            setattr(cudnn, name, value)

# === wrong: the seed of the clock is used | time|clock|seed|given|ignor|twice|same
# --- instead of
        random.setstate(random.Random(seed).getstate())
        np.random.set_state(np.random.RandomState(seed).get_state())
        torch.random.manual_seed(seed)
# --- here
        random.seed()
        np.random.seed()
        torch.seed()
