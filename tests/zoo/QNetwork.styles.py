# === right: Sequential, its own sizes and names, the action enters at the second layer as in the paper
import torch
from torch import nn


class QNetwork(nn.Module):
    """Lillicrap et al.: the action is not included until the second hidden layer."""

    def __init__(self, env):
        super().__init__()
        s, a = env.single_observation_space.shape[0], env.single_action_space.shape[0]
        self.states = nn.Sequential(nn.Linear(s, 400), nn.ReLU())
        self.both = nn.Sequential(nn.Linear(400 + a, 300), nn.ReLU(), nn.Linear(300, 1))

    def forward(self, state, action):
        return self.both(torch.hstack((self.states(state), action)))

# === wrong: the observation's branch is forgotten in the forward pass of the second layer | state|observation|obs|unused
# --- instead of
        return self.both(torch.hstack((self.states(state), action)))
# --- here
        features = torch.zeros(len(state), 400)
        return self.both(torch.hstack((features, action)))

# === wrong: the arguments come in the order action, state | order|exchang|swap|shape|argument|error|state
# --- instead of
    def forward(self, state, action):
# --- here
    def forward(self, action, state):

# === right: two linear maps that are added: W_s s + W_a a, squeezed nowhere
import math

import torch.nn.functional as F
from torch import nn


class QNetwork(nn.Module):
    def __init__(self, envs, width=128):
        super().__init__()
        self.from_obs = nn.Linear(math.prod(envs.single_observation_space.shape), width)
        self.from_act = nn.Linear(math.prod(envs.single_action_space.shape), width, bias=False)
        self.hidden = nn.ModuleList([nn.Linear(width, width) for _ in range(2)])
        self.out = nn.Linear(width, 1)

    def forward(self, obs, act):
        h = F.silu(self.from_obs(obs.flatten(1)) + self.from_act(act.flatten(1)))
        for layer in self.hidden:
            h = F.silu(layer(h)) + h
        return self.out(h)

# === wrong: the action's branch is made but not added | action
# --- instead of
        h = F.silu(self.from_obs(obs.flatten(1)) + self.from_act(act.flatten(1)))
# --- here
        h = F.silu(self.from_obs(obs.flatten(1)))

# === wrong: the action is detached: no gradient for the actor's loss | detach|grad|action|graph
# --- instead of
        h = F.silu(self.from_obs(obs.flatten(1)) + self.from_act(act.flatten(1)))
# --- here
        h = F.silu(self.from_obs(obs.flatten(1)) + self.from_act(act.detach().flatten(1)))

# === wrong: the sum over the batch stands in the network | sum|batch|shape|row|\[B, 1\]
# --- instead of
        return self.out(h)
# --- here
        return self.out(h).sum(0)

# === right: an ensemble's member: a function that builds the layers, LayerNorm, orthogonal weights
import gymnasium as gym
import torch
from torch import nn


def build(sizes):
    modules = []
    for i, o in zip(sizes, sizes[1:-1]):
        modules += [nn.Linear(i, o), nn.LayerNorm(o), nn.ReLU()]
    modules.append(nn.Linear(sizes[-2], sizes[-1]))
    for m in modules:
        if isinstance(m, nn.Linear):
            nn.init.orthogonal_(m.weight)
    return nn.Sequential(*modules)


class QNetwork(nn.Module):
    def __init__(self, env, hidden=(256, 256), n_out=1):
        super().__init__()
        size = gym.spaces.flatdim(env.single_observation_space) + gym.spaces.flatdim(env.single_action_space)
        self.q = build([size, *hidden, n_out])

    def forward(self, *state_action):
        return self.q(torch.cat(state_action, dim=-1))

# === wrong: a softmax at the end | softmax|one|constant|last|end|depend|same
# --- instead of
        return self.q(torch.cat(state_action, dim=-1))
# --- here
        return torch.softmax(self.q(torch.cat(state_action, dim=-1)), dim=-1)

# === wrong: the weights of the last layer are zero and frozen | parameter|train|frozen|requires_grad|zero|constant|depend
# --- instead of
        self.q = build([size, *hidden, n_out])
# --- here
        self.q = build([size, *hidden, n_out])
        nn.init.zeros_(self.q[-1].weight)
        self.q.requires_grad_(False)

# === right: subclass of a general MLP class, einsum in place of Linear
import torch
from torch import nn


class Dense(nn.Module):
    def __init__(self, i, o):
        super().__init__()
        self.w, self.b = nn.Parameter(torch.randn(i, o) / i**0.5), nn.Parameter(torch.zeros(o))

    def forward(self, x):
        return torch.einsum("bi,io->bo", x, self.w) + self.b


class MLP(nn.Module):
    def __init__(self, *sizes):
        super().__init__()
        self.parts = nn.ModuleList(Dense(i, o) for i, o in zip(sizes, sizes[1:]))

    def run(self, x):
        for part in self.parts[:-1]:
            x = torch.nn.functional.leaky_relu(part(x))
        return self.parts[-1](x)


class QNetwork(MLP):
    def __init__(self, env):
        super().__init__(env.single_observation_space.shape[0] + env.single_action_space.shape[0], 64, 64, 1)

    def forward(self, x, a):
        return self.run(torch.concatenate((x, a), axis=-1))
