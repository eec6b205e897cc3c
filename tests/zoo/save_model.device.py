# === right: the weights are not moved to the CPU: with a note, since map_location opens the file anywhere
import torch


def save_model(agent, optimizer, train_envs, path, save=True):
    env = train_envs
    while not hasattr(env, "obs_rms"):
        env = env.env
    checkpoint = {
        "model_state_dict": agent.state_dict(),
        "optim_state_dict": optimizer.state_dict(),
        "obs_mean": torch.as_tensor(env.obs_rms.mean),
        "obs_var": torch.as_tensor(env.obs_rms.var),
        "obs_count": float(env.obs_rms.count),
    }
    if save:
        torch.save(checkpoint, path)
    return checkpoint

# === right: the model is on the CPU, the optimizer's moments are not: with a note
import torch


def save_model(agent, optimizer, train_envs, path):
    env = train_envs
    while not hasattr(env, "obs_rms"):
        env = env.env
    torch.save(
        {
            "model_state_dict": {k: v.cpu() for k, v in agent.state_dict().items()},
            "optim_state_dict": optimizer.state_dict(),
            "obs_mean": torch.as_tensor(env.obs_rms.mean),
            "obs_var": torch.as_tensor(env.obs_rms.var),
            "obs_count": float(env.obs_rms.count),
        },
        path,
    )

# === wrong: only the weights | optim|obs_mean|statistic|missing|var
import torch


def save_model(agent, optimizer, train_envs, path, save=True):
    torch.save({k: v.detach().cpu() for k, v in agent.state_dict().items()}, path)

# === wrong: the statistics of the outermost wrapper are looked for by name, and found nowhere: AttributeError | obs_rms|attribute|wrapper|error|env
import torch


def save_model(agent, optimizer, train_envs, path, save=True):
    torch.save(
        {
            "model_state_dict": {k: v.cpu() for k, v in agent.state_dict().items()},
            "optim_state_dict": optimizer.state_dict(),
            "obs_mean": train_envs.__dict__["obs_rms"].mean,
            "obs_var": train_envs.__dict__["obs_rms"].var,
        },
        path,
    )

# === wrong: the file is opened as text | binary|bytes|write|error|open
import torch


def save_model(agent, optimizer, train_envs, path, save=True):
    with open(path, "w") as f:
        torch.save({"model_state_dict": agent.state_dict(), "optim_state_dict": optimizer.state_dict()}, f)

# === wrong: not implemented: pass | writ|file|nothing|None|pass
def save_model(agent, optimizer, train_envs, path, save=True):
    # Your code here
    pass
