# === right: a helper that moves to the CPU recursively, the course's five entries
import gymnasium as gym
import torch


def to_cpu(x):
    if torch.is_tensor(x):
        return x.detach().cpu()
    if isinstance(x, dict):
        return {k: to_cpu(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return type(x)(to_cpu(v) for v in x)
    return x


def unwrap_norm_env(env):
    while not isinstance(env, gym.wrappers.vector.NormalizeObservation):
        env = env.env
    return env


def save_model(agent, optimizer, train_envs, path, save=True):
    rms = unwrap_norm_env(train_envs).obs_rms
    checkpoint = {
        "model_state_dict": to_cpu(agent.state_dict()),
        "optim_state_dict": to_cpu(optimizer.state_dict()),
        "obs_mean": torch.tensor(rms.mean),
        "obs_var": torch.tensor(rms.var),
        "obs_count": rms.count,
    }
    if save:
        torch.save(checkpoint, path)
    return checkpoint

# === wrong: the optimizer's state is missing | optim
# --- instead of
        "optim_state_dict": to_cpu(optimizer.state_dict()),
# --- here

# === wrong: the variance is missing | var
# --- instead of
        "obs_var": torch.tensor(rms.var),
# --- here

# === wrong: the standard deviation in place of the variance | var|std|deviation|sqrt|root
# --- instead of
        "obs_var": torch.tensor(rms.var),
# --- here
        "obs_var": torch.tensor(rms.var) ** 0.5,

# === wrong: the observations' statistics are missing | obs_mean|obs_var|statistic|mean|normaliz
# --- instead of
        "obs_mean": torch.tensor(rms.mean),
        "obs_var": torch.tensor(rms.var),
        "obs_count": rms.count,
# --- here

# === wrong: the mean is stored in both places | var|mean
# --- instead of
        "obs_var": torch.tensor(rms.var),
# --- here
        "obs_var": torch.tensor(rms.mean),

# === wrong: the agent's weights are missing: the optimizer's state twice | model|weights|agent|optim
# --- instead of
        "model_state_dict": to_cpu(agent.state_dict()),
# --- here
        "model_state_dict": to_cpu(optimizer.state_dict()),

# === wrong: it is not written: save is false by default | writ|file|save|path
# --- instead of
def save_model(agent, optimizer, train_envs, path, save=True):
# --- here
def save_model(agent, optimizer, train_envs, path, save=False):

# === wrong: written under another name than path | path|file|writ|name
# --- instead of
        torch.save(checkpoint, path)
# --- here
        torch.save(checkpoint, str(path) + ".pt")

# === wrong: the statistics of fresh zeros and ones, not those of the envs | obs_mean|statistic|mean|var|zero
# --- instead of
    rms = unwrap_norm_env(train_envs).obs_rms
# --- here
    rms = gym.wrappers.utils.RunningMeanStd(shape=unwrap_norm_env(train_envs).obs_rms.mean.shape)

# === right: nested dictionaries with NumPy arrays, unwrapped by recursion
import numpy as np
import torch


def find_rms(env):
    return env.obs_rms if "obs_rms" in vars(env) else find_rms(env.env)


def save_model(agent, optimizer, train_envs, path):
    rms = find_rms(train_envs)
    stats = {"mean": np.array(rms.mean), "var": np.array(rms.var), "count": float(rms.count)}
    weights = {name: tensor.detach().cpu().clone() for name, tensor in agent.state_dict().items()}
    saved_optimizer = optimizer.state_dict()
    saved_optimizer["state"] = {
        index: {k: v.cpu() if isinstance(v, torch.Tensor) else v for k, v in entry.items()}
        for index, entry in saved_optimizer["state"].items()
    }
    with open(path, "wb") as file:
        torch.save({"agent": weights, "optimizer": saved_optimizer, "normalization": stats}, file)

# === wrong: the whole module is pickled | pickle|module|object|state_dict|class|weights_only
# --- instead of
    weights = {name: tensor.detach().cpu().clone() for name, tensor in agent.state_dict().items()}
# --- here
    weights = agent

# === wrong: only the parameter groups of the optimizer are kept, not its moments | optim|moment|state
# --- instead of
    saved_optimizer["state"] = {
        index: {k: v.cpu() if isinstance(v, torch.Tensor) else v for k, v in entry.items()}
        for index, entry in saved_optimizer["state"].items()
    }
# --- here
    saved_optimizer = saved_optimizer["param_groups"]

# === wrong: only the shapes of the weights are kept | weights|model|agent|shape|tensor
# --- instead of
    weights = {name: tensor.detach().cpu().clone() for name, tensor in agent.state_dict().items()}
# --- here
    weights = {name: tuple(tensor.shape) for name, tensor in agent.state_dict().items()}

# === wrong: only the actor's weights | critic|weights|missing|model|all
# --- instead of
    weights = {name: tensor.detach().cpu().clone() for name, tensor in agent.state_dict().items()}
# --- here
    weights = {name: tensor.detach().cpu().clone() for name, tensor in list(agent.state_dict().items())[:2]}

# === right: hasattr in a loop, a round trip through memory to the CPU, keyword save
import io

import torch


def on_cpu(state):
    memory = io.BytesIO()
    torch.save(state, memory)
    memory.seek(0)
    return torch.load(memory, map_location=torch.device("cpu"), weights_only=True)


def save_model(agent, optimizer, train_envs, path, **extra):
    env = train_envs
    while not hasattr(env, "obs_rms"):
        env = env.env
    mean, var, count = env.obs_rms.mean, env.obs_rms.var, env.obs_rms.count
    torch.save(
        dict(
            model_state_dict=on_cpu(agent.state_dict()),
            optim_state_dict=on_cpu(optimizer.state_dict()),
            obs_mean=torch.from_numpy(mean.copy()).float(),
            obs_var=torch.from_numpy(var.copy()).float(),
            obs_count=int(count),
            **extra,
        ),
        path,
    )

# === wrong: variance and mean are exchanged | var|mean|exchang|swap
# --- instead of
            obs_mean=torch.from_numpy(mean.copy()).float(),
            obs_var=torch.from_numpy(var.copy()).float(),
# --- here
            obs_mean=torch.from_numpy(var.copy()).float(),
            obs_var=torch.from_numpy(mean.copy()).float(),

# === wrong: the optimizer itself is stored, not its state | optim|state_dict|object|pickle|weights_only
# --- instead of
            optim_state_dict=on_cpu(optimizer.state_dict()),
# --- here
            optim_state_dict=optimizer,

# === wrong: the wrapper's attribute is misspelt | attribute|error|name
# --- instead of
    mean, var, count = env.obs_rms.mean, env.obs_rms.var, env.obs_rms.count
# --- here
    mean, var, count = env.obs_rms.means, env.obs_rms.variance, env.obs_rms.count

# === right: copy.deepcopy and .to, a list of statistics in one tensor, pathlib, a note on the version
import copy
from pathlib import Path

import torch
from gymnasium.wrappers.vector import NormalizeObservation


def chain(env):
    while env is not None:
        yield env
        env = getattr(env, "env", None)


def save_model(agent, optimizer, train_envs, path):
    rms = next(e for e in chain(train_envs) if isinstance(e, NormalizeObservation)).obs_rms
    state = copy.deepcopy(optimizer.state_dict())
    for entry in state["state"].values():
        for key in entry:
            if torch.is_tensor(entry[key]):
                entry[key] = entry[key].to("cpu")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoint = {"version": 1, "model_state_dict": {}, "optim_state_dict": state}
    for name, value in agent.state_dict().items():
        checkpoint["model_state_dict"][name] = value.to("cpu")
    for name in ("mean", "var", "count"):
        checkpoint[f"obs_{name}"] = torch.as_tensor(getattr(rms, name))
    torch.save(checkpoint, path)
    return path

# === wrong: the loop over the statistics stops at the mean | var|missing|statistic
# --- instead of
    for name in ("mean", "var", "count"):
# --- here
    for name in ("mean",):

# === wrong: the dictionary is returned, never written | writ|file|save|path
# --- instead of
    torch.save(checkpoint, path)
    return path
# --- here
    return checkpoint

# === wrong: the weights of the agent are zeroed while they are moved | weights|model|zero|value|agent
# --- instead of
        checkpoint["model_state_dict"][name] = value.to("cpu")
# --- here
        checkpoint["model_state_dict"][name] = torch.zeros_like(value, device="cpu")

# === wrong: the agent's parameters only, without its buffers and names: a list | weights|model|state_dict|names?|list
# --- instead of
    for name, value in agent.state_dict().items():
        checkpoint["model_state_dict"][name] = value.to("cpu")
# --- here
    checkpoint["model_state_dict"] = [p.detach().sum().item() for p in agent.parameters()]

# === right: a static method of a class, match and case on the way to the CPU, statistics as lists
import torch


class Checkpoints:
    """All that is about files."""

    @classmethod
    def normalizer(cls, env):
        if hasattr(env, "obs_rms") and hasattr(env, "epsilon"):
            return env
        return cls.normalizer(env.env)

    @classmethod
    def cpu(cls, thing):
        match thing:
            case torch.Tensor():
                return thing.cpu()
            case dict():
                return {key: cls.cpu(value) for key, value in thing.items()}
            case list():
                return [cls.cpu(value) for value in thing]
        return thing

    @staticmethod
    def save_model(agent, optimizer, train_envs, path, save=True):
        rms = Checkpoints.normalizer(train_envs).obs_rms
        out = Checkpoints.cpu({"model_state_dict": agent.state_dict(), "optim_state_dict": optimizer.state_dict()})
        out |= {"obs_mean": rms.mean.tolist(), "obs_var": rms.var.tolist(), "obs_count": float(rms.count)}
        if save:
            torch.save(out, str(path))
        return out

# === wrong: the mean over all observations' dimensions: one number | mean|shape|dimension|obs_mean|number
# --- instead of
        out |= {"obs_mean": rms.mean.tolist(), "obs_var": rms.var.tolist(), "obs_count": float(rms.count)}
# --- here
        out |= {"obs_mean": float(rms.mean.mean()), "obs_var": float(rms.var.mean()), "obs_count": float(rms.count)}
