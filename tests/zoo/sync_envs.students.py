# === right: copies of the arrays, the wrapper found by a loop
import gymnasium as gym


def unwrap_norm_env(env):
    while not isinstance(env, gym.wrappers.vector.NormalizeObservation):
        env = env.env
    return env


def sync_envs(train_envs, eval_envs):
    train_rms = unwrap_norm_env(train_envs).obs_rms
    eval_rms = unwrap_norm_env(eval_envs).obs_rms
    eval_rms.mean = train_rms.mean.copy()
    eval_rms.var = train_rms.var.copy()
    eval_rms.count = train_rms.count

# === wrong: the wrong direction: from evaluation to training | direction|wrong way|train|revers|exchang|swap
import gymnasium as gym


def unwrap_norm_env(env):
    while not isinstance(env, gym.wrappers.vector.NormalizeObservation):
        env = env.env
    return env


def sync_envs(train_envs, eval_envs):
    train_rms = unwrap_norm_env(train_envs).obs_rms
    eval_rms = unwrap_norm_env(eval_envs).obs_rms
    train_rms.mean = eval_rms.mean.copy()
    train_rms.var = eval_rms.var.copy()
    train_rms.count = eval_rms.count

# === wrong: the variance is not copied | var
# --- instead of
    train_rms.mean = eval_rms.mean.copy()
    train_rms.var = eval_rms.var.copy()
    train_rms.count = eval_rms.count
# --- here
    eval_rms.mean = train_rms.mean.copy()
    eval_rms.count = train_rms.count

# === wrong: the mean is not copied | mean
# --- instead of
    train_rms.mean = eval_rms.mean.copy()
    train_rms.var = eval_rms.var.copy()
    train_rms.count = eval_rms.count
# --- here
    eval_rms.var = train_rms.var.copy()
    eval_rms.count = train_rms.count

# === wrong: the standard deviation for the variance | var|std|sqrt|root|deviation
import gymnasium as gym


def unwrap_norm_env(env):
    while not isinstance(env, gym.wrappers.vector.NormalizeObservation):
        env = env.env
    return env


def sync_envs(train_envs, eval_envs):
    train_rms = unwrap_norm_env(train_envs).obs_rms
    eval_rms = unwrap_norm_env(eval_envs).obs_rms
    eval_rms.mean = train_rms.mean.copy()
    eval_rms.var = train_rms.var.copy() ** 0.5
    eval_rms.count = train_rms.count

# === wrong: the mean is copied into the variance as well | var|mean
# --- instead of
    eval_rms.var = train_rms.var.copy() ** 0.5
# --- here
    eval_rms.var = train_rms.mean.copy()

# === wrong: local names are set, not the attributes | (not|un)\w* ?(cop|set|chang|sync)|mean|statistic|nothing|local
import gymnasium as gym


def unwrap_norm_env(env):
    while not isinstance(env, gym.wrappers.vector.NormalizeObservation):
        env = env.env
    return env


def sync_envs(train_envs, eval_envs):
    train_rms = unwrap_norm_env(train_envs).obs_rms
    eval_rms = unwrap_norm_env(eval_envs).obs_rms
    mean, var, count = train_rms.mean.copy(), train_rms.var.copy(), train_rms.count
    eval_rms = type(eval_rms)(shape=mean.shape)
    eval_rms.mean, eval_rms.var, eval_rms.count = mean, var, count

# === right: deepcopy of the whole object, the wrapper found by hasattr and recursion
from copy import deepcopy


def sync_envs(train_envs, eval_envs):
    def norm(env):
        return env if "obs_rms" in vars(env) else norm(env.env)

    norm(eval_envs).obs_rms = deepcopy(norm(train_envs).obs_rms)

# === wrong: training gets evaluation's statistics | direction|wrong way|train|revers|exchang|swap
# --- instead of
    norm(eval_envs).obs_rms = deepcopy(norm(train_envs).obs_rms)
# --- here
    norm(train_envs).obs_rms = deepcopy(norm(eval_envs).obs_rms)

# === wrong: set on the outermost wrapper, which does not normalize | wrapper|outer|mean|statistic|norm
# --- instead of
    norm(eval_envs).obs_rms = deepcopy(norm(train_envs).obs_rms)
# --- here
    eval_envs.obs_rms = deepcopy(norm(train_envs).obs_rms)

# === right: the same object in both, which evaluation does not change: with a note
# --- instead of
    norm(eval_envs).obs_rms = deepcopy(norm(train_envs).obs_rms)
# --- here
    norm(eval_envs).obs_rms = norm(train_envs).obs_rms

# === wrong: the attribute is misspelt | attribute|error|obs_rsm|name
# --- instead of
    norm(eval_envs).obs_rms = deepcopy(norm(train_envs).obs_rms)
# --- here
    norm(eval_envs).obs_rms = deepcopy(norm(train_envs).obs_rsm)

# === right: in place, by NumPy's copyto, over names
import numpy as np
from gymnasium.wrappers.vector import NormalizeObservation


def find(env, kind):
    if isinstance(env, kind):
        return env
    if hasattr(env, "env"):
        return find(env.env, kind)
    raise LookupError(f"no {kind.__name__}")


def sync_envs(source, target, names=("mean", "var")):
    a, b = find(source, NormalizeObservation).obs_rms, find(target, NormalizeObservation).obs_rms
    for name in names:
        np.copyto(getattr(b, name), getattr(a, name), casting="same_kind")
    b.count = float(a.count)

# === wrong: copyto with its arguments exchanged | direction|wrong way|train|revers|exchang|swap|mean|statistic
# --- instead of
        np.copyto(getattr(b, name), getattr(a, name), casting="same_kind")
# --- here
        np.copyto(getattr(a, name), getattr(b, name), casting="same_kind")

# === wrong: averaged with what evaluation has seen | averag|exact|mean|statistic|mix
# --- instead of
        np.copyto(getattr(b, name), getattr(a, name), casting="same_kind")
# --- here
        setattr(b, name, 0.5 * (getattr(a, name) + getattr(b, name)))

# === right: the state of the object as a dictionary, the arrays assigned without a copy (the wrapper makes new ones at each update)
def normalizer_of(env):
    layers = [env]
    while hasattr(layers[-1], "env"):
        layers.append(layers[-1].env)
    return next(layer for layer in layers if type(layer).__name__ == "NormalizeObservation")


def sync_envs(train_envs, eval_envs):
    vars(normalizer_of(eval_envs).obs_rms).update(vars(normalizer_of(train_envs).obs_rms))

# === wrong: statistics are merged as if both had been seen | merg|exact|update|mean|var|statistic|count
# --- instead of
    vars(normalizer_of(eval_envs).obs_rms).update(vars(normalizer_of(train_envs).obs_rms))
# --- here
    theirs, mine = normalizer_of(train_envs).obs_rms, normalizer_of(eval_envs).obs_rms
    mine.update_from_moments(theirs.mean, theirs.var, theirs.count)

# === right: a decorated function, statistics handed over by a helper
import functools

from gymnasium.wrappers.vector import NormalizeObservation


def with_normalizers(function):
    @functools.wraps(function)
    def wrapped(*envs):
        layers = []
        for env in envs:
            while not isinstance(env, NormalizeObservation):
                env = env.env
            layers.append(env)
        return function(*layers)

    return wrapped


@with_normalizers
def sync_envs(train_envs, eval_envs):
    rms = train_envs.obs_rms
    eval_envs.obs_rms.mean, eval_envs.obs_rms.var = 1 * rms.mean, 1 * rms.var
    eval_envs.obs_rms.count = rms.count
    eval_envs.update_running_mean = False

# === wrong: training's own statistics are reset after they were copied | train|reset|statistic|zero|chang
# --- instead of
    eval_envs.update_running_mean = False
# --- here
    train_envs.obs_rms = type(rms)(shape=rms.mean.shape)
