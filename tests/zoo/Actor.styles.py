# === right: one Sequential with its own last layer, buffers low and high, an affine map of (tanh + 1) / 2
import torch
from torch import nn


class ToBounds(nn.Module):
    def __init__(self, low, high):
        super().__init__()
        self.register_buffer("low", torch.as_tensor(low).float())
        self.register_buffer("high", torch.as_tensor(high).float())

    def forward(self, x):
        return self.low + (x.tanh() + 1) / 2 * (self.high - self.low)


class Actor(nn.Sequential):
    def __init__(self, env):
        space = env.single_action_space
        super().__init__(
            nn.Flatten(),
            nn.Linear(env.single_observation_space.shape[0], 256),
            nn.ReLU(),
            nn.Linear(256, 256),
            nn.ReLU(),
            nn.Linear(256, space.shape[0]),
            ToBounds(space.low, space.high),
        )

# === wrong: the affine map is without the lower bound | low|bound|bias|range|symmetric|shift
# --- instead of
        return self.low + (x.tanh() + 1) / 2 * (self.high - self.low)
# --- here
        return (x.tanh() + 1) / 2 * (self.high - self.low)

# === wrong: tanh runs from −1, not from 0: the lower half falls out of the bounds | bound|range|outside|low|tanh|half
# --- instead of
        return self.low + (x.tanh() + 1) / 2 * (self.high - self.low)
# --- here
        return self.low + x.tanh() * (self.high - self.low)

# === wrong: clamped to [−1, 1] in place of scaled | clamp|clip|tanh|scal|bound|range
# --- instead of
        return self.low + (x.tanh() + 1) / 2 * (self.high - self.low)
# --- here
        return x.clamp(-1, 1)

# === wrong: tanh twice: the bounds are never reached | tanh|twice|reach|bound|range|scal
# --- instead of
            nn.Linear(256, space.shape[0]),
# --- here
            nn.Linear(256, space.shape[0]),
            nn.Tanh(),

# === wrong: low and high are plain NumPy arrays that the forward pass cannot take | numpy|array|error|type|tensor|buffer
# --- instead of
        self.register_buffer("low", torch.as_tensor(low).float())
        self.register_buffer("high", torch.as_tensor(high).float())
# --- here
        self.low, self.high = list(low), list(high)

# === right: sigmoid in place of tanh, LayerNorm, layers in a ModuleList
import numpy as np
import torch
from torch import nn


class Actor(nn.Module):
    def __init__(self, env, sizes=(400, 300)):
        super().__init__()
        n, m = int(np.prod(env.single_observation_space.shape)), int(np.prod(env.single_action_space.shape))
        widths = [n, *sizes]
        self.layers = nn.ModuleList([nn.Linear(i, o) for i, o in zip(widths, widths[1:])])
        self.norms = nn.ModuleList([nn.LayerNorm(o) for o in sizes])
        self.out = nn.Linear(sizes[-1], m)
        low = torch.from_numpy(np.asarray(env.single_action_space.low, dtype=np.float32))
        high = torch.from_numpy(np.asarray(env.single_action_space.high, dtype=np.float32))
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("width", high - low, persistent=False)

    def forward(self, state):
        h = state.reshape(len(state), -1)
        for layer, norm in zip(self.layers, self.norms):
            h = torch.nn.functional.elu(norm(layer(h)))
        return self.low + self.width * torch.sigmoid(self.out(h))

# === wrong: sigmoid with scale and bias of the tanh: only the upper half | lower|half|bound|range|sigmoid|tanh|reach
# --- instead of
        return self.low + self.width * torch.sigmoid(self.out(h))
# --- here
        return self.low + self.width / 2 + self.width / 2 * torch.sigmoid(self.out(h))

# === wrong: random exploration stands in the network: the action is not a function of the state | noise|random|deterministic|same|twice|explor
# --- instead of
        return self.low + self.width * torch.sigmoid(self.out(h))
# --- here
        action = self.low + self.width * torch.sigmoid(self.out(h))
        return action + 0.1 * self.width * torch.randn_like(action)

# === right: helper method for the scaling, env.single_action_space kept, torch.lerp
import torch
import torch.nn as nn


def fan_in(layer):
    bound = layer.in_features**-0.5
    nn.init.uniform_(layer.weight, -bound, bound)
    nn.init.uniform_(layer.bias, -bound, bound)
    return layer


class Actor(nn.Module):
    def __init__(self, env, *, hidden=128, device="cpu"):
        super().__init__()
        self.space = env.single_action_space
        d = 1
        for s in env.single_observation_space.shape:
            d *= s
        self.trunk = nn.Sequential(fan_in(nn.Linear(d, hidden)), nn.ReLU(), fan_in(nn.Linear(hidden, hidden)), nn.ReLU())
        self.mu = nn.Linear(hidden, self.space.shape[0])
        self.to(device)

    def unsquash(self, u):
        low = torch.tensor(self.space.low, device=u.device, dtype=u.dtype)
        high = torch.tensor(self.space.high, device=u.device, dtype=u.dtype)
        return torch.lerp(low, high, (u + 1) / 2)

    def forward(self, x):
        return self.unsquash(torch.tanh(self.mu(self.trunk(x.float()))))

# === wrong: the bounds are those of a fixed environment, [−2, 2] | bound|fixed|range|scale|action_space|hard|constant
# --- instead of
        low = torch.tensor(self.space.low, device=u.device, dtype=u.dtype)
        high = torch.tensor(self.space.high, device=u.device, dtype=u.dtype)
        return torch.lerp(low, high, (u + 1) / 2)
# --- here
        return 2.0 * u

# === wrong: the result is detached: no gradient reaches the actor | detach|grad|graph|item|numpy
# --- instead of
        return self.unsquash(torch.tanh(self.mu(self.trunk(x.float()))))
# --- here
        return self.unsquash(torch.tanh(self.mu(self.trunk(x.float()))).detach())

# === wrong: no nonlinearity: the trunk is one linear map | linear|relu|activation
# --- instead of
        self.trunk = nn.Sequential(fan_in(nn.Linear(d, hidden)), nn.ReLU(), fan_in(nn.Linear(hidden, hidden)), nn.ReLU())
# --- here
        self.trunk = nn.Sequential(fan_in(nn.Linear(d, hidden)), fan_in(nn.Linear(hidden, hidden)))

# === right: the scaling is a frozen linear layer
import torch
from torch import nn


class Actor(nn.Module):
    def __init__(self, env):
        super().__init__()
        box = env.single_action_space
        obs_size, act_size = env.single_observation_space.shape[0], box.shape[0]
        self.policy = nn.Sequential(nn.Linear(obs_size, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, act_size), nn.Tanh())
        self.affine = nn.Linear(act_size, act_size).requires_grad_(False)
        low, high = torch.tensor(box.low), torch.tensor(box.high)
        self.affine.weight.copy_(torch.diag((high - low) / 2))
        self.affine.bias.copy_((high + low) / 2)

    def forward(self, obs):
        return self.affine(self.policy(obs))
