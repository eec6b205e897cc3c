# === right: the course's way back
import gymnasium as gym
import torch


def unwrap_norm_env(env):
    while not isinstance(env, gym.wrappers.vector.NormalizeObservation):
        env = env.env
    return env


def load_model(agent, optimizer, train_envs, path):
    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    agent.load_state_dict(checkpoint["model_state_dict"])
    optimizer.load_state_dict(checkpoint["optim_state_dict"])
    rms = unwrap_norm_env(train_envs).obs_rms
    rms.mean = checkpoint["obs_mean"].numpy()
    rms.var = checkpoint["obs_var"].numpy()
    rms.count = checkpoint["obs_count"]

# === wrong: the optimizer's state is not set | optim
# --- instead of
    optimizer.load_state_dict(checkpoint["optim_state_dict"])
# --- here

# === wrong: the agent's weights are not set | model|weights|agent
# --- instead of
    agent.load_state_dict(checkpoint["model_state_dict"])
# --- here

# === wrong: the variance is not set | var
# --- instead of
    rms.var = checkpoint["obs_var"].numpy()
# --- here

# === wrong: the count is not set: the next batch of observations outweighs all that was learned | count|number
# --- instead of
    rms.count = checkpoint["obs_count"]
# --- here

# === wrong: the standard deviation is stored as variance | var|std|sqrt|root|deviation
# --- instead of
    rms.var = checkpoint["obs_var"].numpy()
# --- here
    rms.var = checkpoint["obs_var"].sqrt().numpy()

# === wrong: mean and variance are exchanged | mean|var|exchang|swap
# --- instead of
    rms.mean = checkpoint["obs_mean"].numpy()
    rms.var = checkpoint["obs_var"].numpy()
# --- here
    rms.mean = checkpoint["obs_var"].numpy()
    rms.var = checkpoint["obs_mean"].numpy()

# === wrong: another key than the file has | KeyError|key|optimizer_state_dict|name
# --- instead of
    optimizer.load_state_dict(checkpoint["optim_state_dict"])
# --- here
    optimizer.load_state_dict(checkpoint["optimizer_state_dict"])

# === wrong: the statistics are set on the normalizer itself, where nobody reads them | mean|var|statistic|obs_rms
# --- instead of
    rms = unwrap_norm_env(train_envs).obs_rms
# --- here
    rms = unwrap_norm_env(train_envs)

# === wrong: the path is ignored: a fixed file name | file|path|found|name
# --- instead of
    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
# --- here
    checkpoint = torch.load("ppo_checkpoint_ex06.pt", map_location="cpu", weights_only=True)

# === right: statistics copied into the arrays that are there, by a recursion, with defaults
import numpy as np
import torch


def normalizer(env):
    return env if hasattr(env, "obs_rms") and "obs_rms" in vars(env) else normalizer(env.env)


def load_model(agent, optimizer, train_envs, path, device="cpu", strict=True):
    with open(path, "rb") as file:
        saved = torch.load(file, map_location=torch.device(device), weights_only=False)
    agent.load_state_dict(saved["model_state_dict"], strict=strict)
    agent.to(device)
    optimizer.load_state_dict(saved["optim_state_dict"])
    rms = normalizer(train_envs).obs_rms
    np.copyto(rms.mean, np.asarray(saved["obs_mean"]))
    np.copyto(rms.var, np.asarray(saved["obs_var"]))
    rms.count = float(saved.get("obs_count", 1e-4))
    return saved

# === wrong: the mean is added to the one that is there | mean|add|statistic
# --- instead of
    np.copyto(rms.mean, np.asarray(saved["obs_mean"]))
# --- here
    rms.mean += np.asarray(saved["obs_mean"])

# === wrong: state_dict() is called where load_state_dict belongs: nothing is loaded | load_state_dict|weights|model|agent|(not|un)\w* ?(set|load|chang)
# --- instead of
    agent.load_state_dict(saved["model_state_dict"], strict=strict)
# --- here
    agent.state_dict().update(saved["model_state_dict"])

# === wrong: the count is always taken for new: the key is misspelt in .get | count|number
# --- instead of
    rms.count = float(saved.get("obs_count", 1e-4))
# --- here
    rms.count = float(saved.get("count", 1e-4))

# === wrong: another agent is loaded and thrown away | agent|weights|model|copy
# --- instead of
        saved = torch.load(file, map_location=torch.device(device), weights_only=False)
# --- here
        saved = torch.load(file, map_location=torch.device(device), weights_only=False)
    import copy

    agent = copy.deepcopy(agent)
# --- instead of
    agent.to(device)
# --- here

# === right: each parameter copied by name, the statistics by setattr, a new RunningMeanStd
import torch
from gymnasium.wrappers.utils import RunningMeanStd
from gymnasium.wrappers.vector import NormalizeObservation


def load_model(model, opt, envs, file):
    data = torch.load(file, map_location=lambda storage, location: storage, weights_only=True)
    own = model.state_dict()
    with torch.no_grad():
        for key, tensor in data["model_state_dict"].items():
            own[key].copy_(tensor)
    opt.load_state_dict(data["optim_state_dict"])
    layer = envs
    while not isinstance(layer, NormalizeObservation):
        layer = layer.env
    fresh = RunningMeanStd(shape=layer.single_observation_space.shape)
    for part in ("mean", "var"):
        setattr(fresh, part, data[f"obs_{part}"].cpu().numpy().astype("float64"))
    fresh.count = data["obs_count"]
    layer.obs_rms = fresh
    return model, opt, envs

# === wrong: the copy goes the wrong way: the file's tensors get the model's | direction|wrong way|copy|weights|model|agent
# --- instead of
            own[key].copy_(tensor)
# --- here
            tensor.copy_(own[key])

# === wrong: the new statistics are made but not put into the wrapper | statistic|mean|obs_rms|normaliz
# --- instead of
    layer.obs_rms = fresh
# --- here

# === wrong: the biases are skipped | bias|weights|model|agent|parameter
# --- instead of
            own[key].copy_(tensor)
# --- here
            if "bias" not in key:
                own[key].copy_(tensor)

# === wrong: the learning rate is kept but the moments are thrown away: only param_groups are loaded | optim|moment|state
# --- instead of
    opt.load_state_dict(data["optim_state_dict"])
# --- here
    opt.param_groups[0].update({k: v for k, v in data["optim_state_dict"]["param_groups"][0].items() if k != "params"})

# === right: a small class with load_model as a class method, one line for each thing
# solution: Store.load_model
from operator import attrgetter

import torch


class Store:
    @classmethod
    def load_model(cls, agent, optimizer, train_envs, path):
        state = torch.load(path, weights_only=True, map_location="cpu")
        for target, key in ((agent, "model_state_dict"), (optimizer, "optim_state_dict")):
            target.load_state_dict(state[key])
        env = train_envs
        while "NormalizeObservation" not in [c.__name__ for c in type(env).__mro__]:
            env = env.env
        rms = attrgetter("obs_rms")(env)
        rms.mean, rms.var, rms.count = state["obs_mean"].numpy().copy(), state["obs_var"].numpy().copy(), state["obs_count"]

# === wrong: agent and optimizer are exchanged | exchang|swap|error|key|optim|agent
# --- instead of
        for target, key in ((agent, "model_state_dict"), (optimizer, "optim_state_dict")):
# --- here
        for target, key in ((optimizer, "model_state_dict"), (agent, "optim_state_dict")):

# === wrong: count is the variance's number of entries | count|number
# --- instead of
        rms.mean, rms.var, rms.count = state["obs_mean"].numpy().copy(), state["obs_var"].numpy().copy(), state["obs_count"]
# --- here
        rms.mean, rms.var, rms.count = state["obs_mean"].numpy().copy(), state["obs_var"].numpy().copy(), state["obs_var"].numel()
